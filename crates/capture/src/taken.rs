//! What the camera did in one frame, in plain numbers.

use crate::motion::RIGID;

/// What the camera did in one frame; see [`Capture`](crate::Capture) for the units.
#[derive(Clone, Debug, PartialEq)]
pub struct Taken {
    /// Coefficients of its path, [6 D].
    pub path: Vec<f64>,
    /// Disparity of focus, S / distance.
    pub focus: f64,
    /// Radius of the lens, scene sizes.
    pub aperture: f64,
    /// How long the shutter was open, in units of frames.
    pub shutter: f64,
}

impl Taken {
    /// Length of the path in the image at the depth S, px; `focal_px` is the focal length.
    ///
    /// What turns around the optical axis is not counted.
    #[must_use]
    pub fn path_px(&self, focal_px: f64) -> f64 {
        // A turn of (x, y) moves what is ahead by (-y, x), a translation of one scene size at depth S by 1.
        let at = |s: f64| -> [f64; 2] {
            let mut place = [0.0; 2];
            for (k, step) in self.path.chunks_exact(RIGID).enumerate() {
                let power = s.powi(k as i32 + 1);
                place[0] += power * (step[1] + step[3]);
                place[1] += power * (step[4] - step[0]);
            }
            place
        };
        let parts = 8;
        let moment = |k: usize| k as f64 / parts as f64 - 0.5;
        (0..parts)
            .map(|k| {
                let ([x0, y0], [x1, y1]) = (at(moment(k)), at(moment(k + 1)));
                focal_px * (x1 - x0).hypot(y1 - y0)
            })
            .sum()
    }

    /// Diameter of the disc that a point at depth S / `disparity` becomes, px.
    #[must_use]
    pub fn disc_px(&self, focal_px: f64, disparity: f64) -> f64 {
        2.0 * focal_px * (self.aperture * (self.focus - disparity)).abs()
    }
}
