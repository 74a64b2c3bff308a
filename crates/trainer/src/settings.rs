//! Everything that can be chosen about a training run, with its default.

use crate::TrainError;
use serde::{Deserialize, Serialize};

/// All settings of a training run.
///
/// Lengths that scenes give a scale are relative to the scene's size S (median z-depth of the
/// training pixels); moments are iterations of a run of 40,000 and shrink with shorter ones
/// (see [`crate::schedule::Schedule`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Number of training iterations, at least 200.
    pub iterations: usize,
    /// Seed of every random choice.
    pub seed: u64,
    /// Gaussians and density control.
    pub gaussians: GaussianSettings,
    /// Motion bases.
    pub motion: MotionSettings,
    /// The blur model.
    pub blur: BlurSettings,
    /// The blur model `camera`.
    pub camera: CameraSettings,
    /// Unseen views.
    pub unseen: UnseenSettings,
    /// Weights of the losses.
    pub loss: LossSettings,
    /// Learning rates.
    pub learning_rates: LearningRates,
    /// Iterations between checkpoints that the program writes; 0 for only at the end.
    pub checkpoint_every: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            iterations: 40_000,
            seed: 1,
            gaussians: GaussianSettings::default(),
            motion: MotionSettings::default(),
            blur: BlurSettings::default(),
            camera: CameraSettings::default(),
            unseen: UnseenSettings::default(),
            loss: LossSettings::default(),
            learning_rates: LearningRates::default(),
            checkpoint_every: 1000,
        }
    }
}

/// Gaussians: how many, and how their number changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GaussianSettings {
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// The active degree rises by one every so many iterations.
    pub sh_degree_every: usize,
    /// Static Gaussians at the start: at most so many…
    pub max_initial_static: usize,
    /// … and at most so many for each pixel of a frame.
    pub initial_static_per_pixel: f64,
    /// Static Gaussians start this far from the dynamic mask, in pixels of a picture 256 wide.
    pub mask_margin: f64,
    /// Pixels between which depth jumps by more than this, relatively and beyond their surface's slope, lie on a depth
    /// edge ([`unseen_views::depth_edges`]): no Gaussian starts there, and unseen views are not warped from there.
    pub depth_edge: f64,
    /// Opacity at the start.
    pub initial_opacity: f64,
    /// Density control starts after this iteration (of 40,000).
    pub control_from: usize,
    /// Density control ends at this iteration (of 40,000).
    pub control_until: usize,
    /// Iterations between steps of density control (of 40,000; never under 25 or the number of frames).
    pub control_every: usize,
    /// Mean screen-space gradient from which a Gaussian is cloned or split (in units of half the picture, at a height of 288).
    pub gradient_threshold: f64,
    /// Gaussians above this scale are split, those below cloned, in units of S.
    pub split_scale: f64,
    /// Gaussians above this scale are removed once `prune_scale_from` has passed, in units of S.
    pub prune_scale: f64,
    /// See `prune_scale` (of 40,000).
    pub prune_scale_from: usize,
    /// Gaussians below this opacity are removed.
    pub prune_opacity: f64,
    /// At most so many Gaussians for each pixel of a frame; 0 for no limit.
    pub max_per_pixel: f64,
    /// Iterations between resets of the opacity, in runs of 10,000 iterations or more; 0 for never.
    pub opacity_reset_every: usize,
    /// Near plane in units of S.
    pub near: f64,
}

impl Default for GaussianSettings {
    fn default() -> Self {
        Self {
            sh_degree: 3,
            sh_degree_every: 1000,
            max_initial_static: 100_000,
            initial_static_per_pixel: 2.0,
            mask_margin: 3.0,
            depth_edge: 0.05,
            initial_opacity: 0.7,
            control_from: 500,
            control_until: 15_000,
            control_every: 100,
            gradient_threshold: 2e-4,
            split_scale: 0.01,
            prune_scale: 0.1,
            prune_scale_from: 3000,
            prune_opacity: 0.005,
            max_per_pixel: 3.0,
            opacity_reset_every: 3000,
            near: 0.01,
        }
    }
}

/// Motion bases and dynamic Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionSettings {
    /// Number of motion bases N_b.
    pub num_bases: usize,
    /// At most so many 2D tracks are lifted.
    pub max_tracks: usize,
    /// Steps of the first fit of the bases to the tracks.
    pub first_fit_steps: usize,
    /// Whether dynamic Gaussians are densified once (paper, N_d).
    pub densify: bool,
    /// When dynamic Gaussians are densified (of 40,000).
    pub densify_at: usize,
    /// A frame adds at most so many dynamic Gaussians then.
    pub densify_per_frame: usize,
}

impl Default for MotionSettings {
    fn default() -> Self {
        Self {
            num_bases: 20,
            max_tracks: 40_000,
            first_fit_steps: 1000,
            densify: true,
            densify_at: 2500,
            densify_per_frame: 1000,
        }
    }
}

/// What explains blur.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BlurKind {
    /// The paper's: BP-Net predicts a kernel and an intensity for every pixel.
    #[default]
    Kernels,
    /// The camera itself: its path while the shutter is open, and its lens.
    Camera,
}

/// The blur model; all but the first two are those of BP-Net.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlurSettings {
    /// Whether blur is modelled.
    pub enabled: bool,
    /// By what.
    pub model: BlurKind,
    /// Side K of the blur kernels, odd, 1 to 15.
    pub kernel_size: usize,
    /// Blur starts after this iteration (of 40,000), never before `min(250, n / 4)`.
    pub from: usize,
    /// For `min(hold, n / 8)` iterations from its start on the blur model is applied but not stepped; 0 for no hold.
    pub hold: usize,
    /// Whether the scene feature extractor is trained.
    pub train_extractor: bool,
    /// Skip connections of the scene features (paper, "shortcut").
    pub shortcut: bool,
    /// Features, kernels and intensities are computed on a picture so many times smaller, 1 to 4.
    pub downscale: usize,
    /// Whether the head starts at a mild blur; else as a framework initialises it.
    pub mild_start: bool,
    /// Rows and columns of the cells whose mean kernel shift the gauge holds at zero.
    pub gauge_cells: [usize; 2],
}

impl Default for BlurSettings {
    fn default() -> Self {
        Self {
            enabled: true,
            model: BlurKind::Kernels,
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
    /// Whether the camera moves while its shutter is open.
    pub path: bool,
    /// Whether it has a lens with an aperture and a focus.
    pub lens: bool,
    /// Whether the given poses are refined.
    pub offsets: bool,
    /// Degree of the paths, 1 to 3.
    pub path_degree: usize,
    /// A frame is averaged from at most so many renders, 2 to 64.
    pub samples: usize,
    /// Distance of the samples from each other in the image, px.
    pub spacing_px: f64,
    /// How a picture's values stand for light.
    pub transfer: TransferKind,
    /// Length of every path at the start, in pixels of a picture 256 wide.
    pub start_px: f64,
    /// Radius of the lens at the start, in units of S.
    pub aperture: f64,
    /// Time for which the shutter is open at the start, in units of frames.
    pub shutter: f64,
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self {
            path: true,
            lens: true,
            offsets: true,
            path_degree: 2,
            samples: 8,
            spacing_px: 0.75,
            transfer: TransferKind::Srgb,
            start_px: 2.0,
            aperture: 0.01,
            shutter: 0.6,
        }
    }
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

/// Unseen views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct UnseenSettings {
    /// Whether unseen views are used.
    pub enabled: bool,
    /// Unseen views start after this iteration (of 40,000).
    pub from: usize,
    /// Every so many iterations is an unseen view (paper, N_u; not scaled).
    pub every: usize,
    /// Largest perpendicular offset in units of S; each view draws from [0.5, 1] of it.
    pub offset: f64,
    /// Sharpness of the soft z-buffer.
    pub sharpness: f64,
    /// Views with a smaller share of valid pixels are dropped.
    pub min_valid: f64,
}

impl Default for UnseenSettings {
    fn default() -> Self {
        Self {
            enabled: true,
            from: 3000,
            every: 5,
            offset: 0.05,
            sharpness: 50.0,
            min_valid: 0.6,
        }
    }
}

/// Weights of the losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossSettings {
    /// Share of 1 − SSIM in the photometric loss (paper, β).
    pub ssim: f64,
    /// Disparity L1.
    pub depth: f64,
    /// Dynamic mask L1.
    pub mask: f64,
    /// Kernel-centre loss L_spa.
    pub kernel_center: f64,
    /// L_spa starts after this iteration (of 40,000), never before blur's start + `min(500, n / 4)`.
    pub kernel_center_from: usize,
    /// Mean blur intensity, never before L_spa's start.
    pub intensity: f64,
    /// The gauge on the kernels' common shift.
    pub gauge: f64,
    /// Four times smaller sharp render against the blurry frame.
    pub downsample: f64,
    /// The downsample loss starts so many iterations (of 40,000) after blur.
    pub downsample_after: usize,
    /// Second differences of the bases.
    pub bases_acceleration: f64,
    /// Second differences of the dynamic means.
    pub means_acceleration: f64,
    /// Motion along the viewing ray.
    pub along_ray: f64,
}

impl Default for LossSettings {
    fn default() -> Self {
        Self {
            ssim: 0.2,
            depth: 0.075,
            mask: 0.075,
            kernel_center: 0.001,
            kernel_center_from: 5500,
            intensity: 0.0,
            gauge: 0.1,
            downsample: 0.0,
            downsample_after: 1000,
            bases_acceleration: 0.1,
            means_acceleration: 1.0,
            along_ray: 1.0,
        }
    }
}

/// Learning rates of the parameter groups.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LearningRates {
    /// Means at the start, in units of S.
    pub means: f64,
    /// Means at the end, in units of S.
    pub means_final: f64,
    /// The means' decay takes so many iterations (of 40,000).
    pub means_decay: usize,
    /// Spherical harmonics of degree 0.
    pub sh_dc: f64,
    /// Spherical harmonics of higher degrees.
    pub sh_rest: f64,
    /// Opacity logits.
    pub opacity: f64,
    /// Log-scales.
    pub scales: f64,
    /// Quaternions.
    pub rotations: f64,
    /// Motion coefficients at the start.
    pub coefficients: f64,
    /// Motion bases (translations in units of S) at the start.
    pub bases: f64,
    /// Bases and coefficients at the end, as a share of the start. A basis of one frame learns from that frame alone, but Adam's
    /// step goes on through the iterations between its visits: at a rate that stays large movers tremble by a third of a pixel.
    pub motion_final_share: f64,
    /// BP-Net, extractor and embeddings at the start.
    pub blur: f64,
    /// The same at the end of a run of 40,000 iterations or more, as a share of the start.
    pub blur_final_share: f64,
    /// The decay to it takes so many iterations (of 40,000).
    pub blur_decay: usize,
    /// The same at the end of a shorter run, over its whole length.
    pub blur_short_run_share: f64,
    /// In short runs the blur model learns faster by `min(this, s^-1/2)`, s = iterations / 40,000. Motion does not: what it
    /// learns faster than the blur model it takes from it, as per-frame shifts in the place of kernels.
    pub short_run_boost: f64,
    /// The camera's paths: rotation vectors, rad. Translations, in units of S, learn at a fifth of it.
    pub camera_path: f64,
    /// Offsets from the given poses, likewise.
    pub camera_offset: f64,
    /// Disparities of focus (S / distance).
    pub camera_focus: f64,
    /// Radius of the lens, in units of S.
    pub camera_aperture: f64,
    /// Time for which the shutter is open, in units of frames.
    pub camera_shutter: f64,
    /// All of these at the end, as a share of the start.
    pub camera_final_share: f64,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: 1.6e-4,
            means_final: 1.6e-6,
            means_decay: 30_000,
            sh_dc: 2.5e-3,
            sh_rest: 1.25e-4,
            opacity: 0.05,
            scales: 5e-3,
            rotations: 1e-3,
            coefficients: 1e-2,
            bases: 1.6e-4,
            motion_final_share: 0.01,
            blur: 5e-4,
            blur_final_share: 0.02,
            blur_decay: 35_000,
            blur_short_run_share: 0.1,
            short_run_boost: 4.0,
            camera_path: 3e-3,
            camera_offset: 6e-4,
            camera_focus: 2e-2,
            camera_aperture: 1e-3,
            camera_shutter: 5e-3,
            camera_final_share: 0.05,
        }
    }
}

impl Settings {
    /// The paper's text where it differs from the defaults: motion and blur learn at constant rates, no
    /// hold, no gauge, the blur model's head as a framework initialises it (the paper says nothing about it).
    #[must_use]
    pub fn paper() -> Self {
        let mut settings = Self::default();
        settings.learning_rates.motion_final_share = 1.0;
        settings.learning_rates.blur_final_share = 1.0;
        settings.learning_rates.blur_short_run_share = 1.0;
        settings.blur.hold = 0;
        settings.blur.mild_start = false;
        settings.loss.gauge = 0.0;
        settings
    }

    /// Checks every range.
    ///
    /// # Errors
    /// Names the first setting that is out of its range, and the range.
    pub fn validate(&self) -> Result<(), TrainError> {
        let check = |ok: bool, key: &str, allowed: &str| {
            if ok {
                Ok(())
            } else {
                Err(TrainError::setting(key, format!("must be {allowed}")))
            }
        };
        check(
            self.iterations >= 200,
            "iterations",
            "200 or more (a shorter run has no room for the schedule)",
        )?;
        let g = &self.gaussians;
        check(g.sh_degree <= 3, "gaussians.sh_degree", "0 to 3")?;
        check(
            g.sh_degree_every > 0,
            "gaussians.sh_degree_every",
            "positive",
        )?;
        check(g.control_every > 0, "gaussians.control_every", "positive")?;
        check(
            g.max_initial_static > 0,
            "gaussians.max_initial_static",
            "positive",
        )?;
        check(
            g.initial_opacity > 0.0 && g.initial_opacity < 1.0,
            "gaussians.initial_opacity",
            "between 0 and 1, both excluded",
        )?;
        check(
            (0.0..1.0).contains(&g.prune_opacity),
            "gaussians.prune_opacity",
            "0 or more and under 1",
        )?;
        check(
            (0.0..=256.0).contains(&g.mask_margin),
            "gaussians.mask_margin",
            "0 to 256 (pixels of a picture 256 wide)",
        )?;
        let k = self.blur.kernel_size;
        check(k % 2 == 1 && k <= 15, "blur.kernel_size", "odd, 1 to 15")?;
        check(
            (1..=bpnet::MAX_DOWNSCALE).contains(&self.blur.downscale),
            "blur.downscale",
            "1 to 4",
        )?;
        check(
            self.blur.gauge_cells.iter().all(|n| (1..=64).contains(n)),
            "blur.gauge_cells",
            "two numbers, 1 to 64",
        )?;
        let c = &self.camera;
        check(
            (1..=3).contains(&c.path_degree),
            "camera.path_degree",
            "1 to 3",
        )?;
        check((2..=64).contains(&c.samples), "camera.samples", "2 to 64")?;
        if let TransferKind::Power(gamma) = c.transfer {
            let key = "camera.transfer.power";
            check((1.0..=4.0).contains(&gamma), key, "1 to 4")?;
        }
        check(self.motion.num_bases > 0, "motion.num_bases", "positive")?;
        check(self.unseen.every > 0, "unseen.every", "positive")?;
        check(self.loss.ssim <= 1.0, "loss.ssim", "0 to 1")?;
        let l = &self.learning_rates;
        let positive = [
            (
                g.initial_static_per_pixel,
                "gaussians.initial_static_per_pixel",
            ),
            (g.gradient_threshold, "gaussians.gradient_threshold"),
            (g.split_scale, "gaussians.split_scale"),
            (g.prune_scale, "gaussians.prune_scale"),
            (g.depth_edge, "gaussians.depth_edge"),
            (g.near, "gaussians.near"),
            (l.means, "learning_rates.means"),
            (l.means_final, "learning_rates.means_final"),
            (l.motion_final_share, "learning_rates.motion_final_share"),
            (l.blur_final_share, "learning_rates.blur_final_share"),
            (
                l.blur_short_run_share,
                "learning_rates.blur_short_run_share",
            ),
            (l.short_run_boost, "learning_rates.short_run_boost"),
            (c.spacing_px, "camera.spacing_px"),
            (l.camera_final_share, "learning_rates.camera_final_share"),
        ];
        for (value, key) in positive {
            check(value.is_finite() && value > 0.0, key, "a positive number")?;
        }
        let w = &self.loss;
        let not_negative = [
            (g.max_per_pixel, "gaussians.max_per_pixel"),
            (self.unseen.offset, "unseen.offset"),
            (self.unseen.sharpness, "unseen.sharpness"),
            (self.unseen.min_valid, "unseen.min_valid"),
            (w.ssim, "loss.ssim"),
            (w.depth, "loss.depth"),
            (w.mask, "loss.mask"),
            (w.kernel_center, "loss.kernel_center"),
            (w.intensity, "loss.intensity"),
            (w.gauge, "loss.gauge"),
            (w.downsample, "loss.downsample"),
            (w.bases_acceleration, "loss.bases_acceleration"),
            (w.means_acceleration, "loss.means_acceleration"),
            (w.along_ray, "loss.along_ray"),
            (l.sh_dc, "learning_rates.sh_dc"),
            (l.sh_rest, "learning_rates.sh_rest"),
            (l.opacity, "learning_rates.opacity"),
            (l.scales, "learning_rates.scales"),
            (l.rotations, "learning_rates.rotations"),
            (l.coefficients, "learning_rates.coefficients"),
            (l.bases, "learning_rates.bases"),
            (l.blur, "learning_rates.blur"),
            (c.start_px, "camera.start_px"),
            (c.aperture, "camera.aperture"),
            (c.shutter, "camera.shutter"),
            (l.camera_path, "learning_rates.camera_path"),
            (l.camera_offset, "learning_rates.camera_offset"),
            (l.camera_focus, "learning_rates.camera_focus"),
            (l.camera_aperture, "learning_rates.camera_aperture"),
            (l.camera_shutter, "learning_rates.camera_shutter"),
        ];
        for (value, key) in not_negative {
            check(
                value.is_finite() && value >= 0.0,
                key,
                "zero or a positive number",
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_survive_toml_and_json() {
        let settings = Settings::paper();
        assert_eq!(
            toml::from_str::<Settings>(&toml::to_string(&settings).expect("toml")).expect("toml"),
            settings
        );
        assert_eq!(
            serde_json::from_str::<Settings>(&serde_json::to_string(&settings).expect("json"))
                .expect("json"),
            settings
        );
    }

    #[test]
    fn a_misspelt_setting_is_an_error() {
        let error = toml::from_str::<Settings>("[blur]\nkernel = 9\n").expect_err("unknown key");
        assert!(error.to_string().contains("kernel"), "{error}");
    }

    #[test]
    fn values_out_of_range_are_named() {
        let mistake = |change: fn(&mut Settings)| {
            let mut settings = Settings::default();
            change(&mut settings);
            settings.validate().expect_err("out of range").to_string()
        };
        assert!(mistake(|s| s.blur.kernel_size = 8).contains("blur.kernel_size"));
        assert!(mistake(|s| s.iterations = 199).contains("iterations"));
        assert!(mistake(|s| s.loss.depth = f64::NAN).contains("loss.depth"));
        assert!(Settings::default().validate().is_ok());
        assert!(Settings::paper().validate().is_ok());
    }
}
