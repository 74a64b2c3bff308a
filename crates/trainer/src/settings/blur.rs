//! Settings of the blur models.

use super::when::When;
use serde::{Deserialize, Serialize};

/// Where a path and a lens blur a frame, it is averaged from twice as many renders, but for that from no more than so many: a disc
/// drawn along a path covers more than either. (RESULTS.md, "Twice as many renders for both".)
const MOST_FOR_BOTH: usize = 16;

/// What explains blur.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BlurKind {
    /// Nothing where frames are alike in sharpness, else the camera.
    #[default]
    Auto,
    /// Nothing: frames are taken to be sharp.
    Off,
    /// The paper's: BP-Net predicts a kernel and an intensity for every pixel.
    Kernels,
    /// The camera itself: its path while the shutter is open, and its lens.
    Camera,
    /// The camera, and kernels for what it leaves.
    Both,
}

/// The blur model; all but the first are those of BP-Net.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlurSettings {
    /// What explains blur.
    pub model: BlurKind,
    /// Side K of the blur kernels, odd, 1 to 15.
    pub kernel_size: usize,
    /// Kernels start after this iteration (of 40,000), never before `min(250, n / 4)`; on top of the camera not before half of
    /// the run.
    pub from: usize,
    /// For `min(hold, n / 8)` iterations from its start on the blur model is applied but not stepped; 0 for no hold.
    pub hold: usize,
    /// Whether the scene feature extractor is trained.
    pub train_extractor: bool,
    /// Skip connections of the scene features (paper, "shortcut").
    pub shortcut: bool,
    /// Features, kernels and intensities are computed on a picture so many times smaller, 1 to 4.
    pub downscale: usize,
    /// Whether the head starts at a mild blur, on top of the camera at hardly any; else as a framework initialises it.
    pub mild_start: bool,
    /// Rows and columns of the cells whose mean kernel shift the gauge holds at zero.
    pub gauge_cells: [usize; 2],
}

impl Default for BlurSettings {
    fn default() -> Self {
        Self {
            model: BlurKind::Auto,
            kernel_size: 9,
            from: 3500,
            hold: 200,
            train_extractor: true,
            shortcut: true,
            downscale: 1,
            mild_start: true,
            gauge_cells: [4, 8],
        }
    }
}

/// The camera as a blur model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraSettings {
    /// When the camera moves while its shutter is open: by default unless a trial finds that paths do not pay.
    pub path: When,
    /// When it has a lens with an aperture and a focus: by default unless a trial finds that it does not pay.
    pub lens: When,
    /// What makes discs of what is out of focus.
    pub disc: DiscKind,
    /// Degree of the paths, 1 to 3.
    pub path_degree: usize,
    /// A frame is averaged from at most so many renders, 2 to 64, and from twice as many, up to 16, where a path and points of a lens
    /// blur it, once the first trial has left both in.
    pub samples: usize,
    /// Distance of the samples from each other along a path, px.
    pub spacing_px: f64,
    /// Distance of the samples from each other on a disc, px.
    pub lens_spacing_px: f64,
    /// How a picture's values stand for light.
    pub transfer: TransferKind,
    /// Length of every path at the start, in pixels of a picture 256 wide.
    pub start_px: f64,
    /// Radius of the lens at the start, in units of S. It is held until every frame has found its focus and a path.
    pub aperture: f64,
    /// Time for which the shutter is open at the start, in units of frames.
    pub shutter: f64,
}

impl CameraSettings {
    /// Whether a part of it is to be there whatever a scene requires.
    #[must_use]
    pub fn is_asked_for(&self) -> bool {
        [self.path, self.lens].contains(&When::Always)
    }

    /// From how many renders a frame is averaged at most where a path and a lens blur it.
    #[must_use]
    pub fn most_samples(&self) -> usize {
        self.samples.max(MOST_FOR_BOTH.min(2 * self.samples))
    }
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self {
            path: When::Auto,
            lens: When::Auto,
            disc: DiscKind::Points,
            path_degree: 2,
            samples: 8,
            spacing_px: 1.5,
            lens_spacing_px: 0.75,
            transfer: TransferKind::Srgb,
            start_px: 2.0,
            aperture: 0.0125,
            shutter: 0.6,
        }
    }
}

/// What makes discs of what is out of focus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DiscKind {
    /// The scene is seen from many points of the lens.
    #[default]
    Points,
    /// Gaussians grow by the disc at their depth, so that one render has them.
    Grown,
    /// Layers of depth of a sharp render are blurred, one over the other; there are no paths then.
    Layers,
}

/// How a picture's values stand for light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TransferKind {
    /// sRGB's curve.
    Srgb,
    /// A power.
    Power(f64),
    /// They are light.
    Linear,
}

impl From<TransferKind> for splat_core::Transfer {
    fn from(kind: TransferKind) -> Self {
        match kind {
            TransferKind::Srgb => Self::Srgb,
            TransferKind::Power(gamma) => Self::Power(gamma),
            TransferKind::Linear => Self::Linear,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_both_blur_has_twice_as_many_renders_up_to_sixteen_and_never_fewer() {
        for (samples, most) in [(2, 4), (4, 8), (8, 16), (9, 16), (16, 16), (64, 64)] {
            let camera = CameraSettings {
                samples,
                ..CameraSettings::default()
            };
            assert_eq!(camera.most_samples(), most, "{samples}");
        }
    }
}
