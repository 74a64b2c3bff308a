//! What the camera did while it took a frame, for pictures and figures.

use serde::{Deserialize, Serialize};
use std::fmt;

/// What the camera did in one frame, for pictures and figures.
#[derive(Clone, Debug, PartialEq)]
pub struct TakenView {
    /// Its figures.
    pub frame: CameraFrame,
    /// Time for which the shutter was open, in units of frames.
    pub shutter: f64,
    /// Radius of the lens, scene units.
    pub aperture: f64,
    /// What points become at a few depths from near to far, and at each on the left, in the middle and on the right.
    pub spots: Vec<Spot>,
}

/// What a point becomes while the shutter is open.
#[derive(Clone, Debug, PartialEq)]
pub struct Spot {
    /// Its depth, scene units.
    pub depth: f64,
    /// Where the sharp picture has it, px to the right of the optical axis.
    pub right_px: f64,
    /// Where its light falls, px from where the sharp picture has it (x, y).
    pub places: Vec<[f64; 2]>,
}

impl TakenView {
    /// How far the light of any spot strays, px.
    #[must_use]
    pub fn reach_px(&self) -> f64 {
        let places = self.spots.iter().flat_map(|spot| &spot.places);
        places.fold(0.0, |far, [x, y]| far.max(x.hypot(*y)))
    }
}

/// Figures of [`BlurModel::Camera`](crate::BlurModel::Camera) over all training frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraFigures {
    /// Time for which the shutter is open, in units of frames; 0 where every frame is one render, for which it makes no difference.
    pub shutter: f64,
    /// Radius of the lens, scene units.
    pub aperture: f64,
    /// Every training frame.
    pub frames: Vec<CameraFrame>,
}

impl CameraFigures {
    /// Of some views; `None` of none.
    pub(crate) fn of(views: &[TakenView]) -> Option<Self> {
        let first = views.first()?;
        let is_exposed = views.iter().any(|view| view.frame.samples > 1);
        Some(Self {
            shutter: if is_exposed { first.shutter } else { 0.0 },
            aperture: first.aperture,
            frames: views.iter().map(|view| view.frame).collect(),
        })
    }
}

impl fmt::Display for CameraFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mean = |value: fn(&CameraFrame) -> f64| {
            self.frames.iter().map(value).sum::<f64>() / self.frames.len() as f64
        };
        write!(
            f,
            "shutter {:.2} frames, aperture {:.4}, mean path {:.2} px, mean disc {:.2} px, {:.1} samples a frame",
            self.shutter,
            self.aperture,
            mean(|frame| frame.blur_px),
            mean(|frame| frame.disc_px),
            mean(|frame| frame.samples as f64),
        )
    }
}

/// What the camera did in one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraFrame {
    /// Length of its path at the depth S, px.
    pub blur_px: f64,
    /// Depth that is in focus, scene units.
    pub focus: f64,
    /// Diameter of the disc of what lies nearest or farthest, px, whichever is larger.
    pub disc_px: f64,
    /// Renders that the frame was averaged from.
    pub samples: usize,
    /// PSNR of what the camera is said to have seen against the frame, dB.
    pub psnr: Option<f64>,
}

impl CameraFrame {
    /// Neither a path nor a lens blurs it.
    pub(super) fn is_sharp(&self) -> bool {
        self.blur_px + self.disc_px == 0.0
    }
}
