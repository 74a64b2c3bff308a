//! What the camera did in one frame, in plain numbers.

use crate::motion::{RIGID, shift_of};

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
        let at = |s: f64| shift_of(self.sum_of(|power| s.powi(power)));
        let parts = 8;
        let moment = |k: usize| k as f64 / parts as f64 - 0.5;
        (0..parts)
            .map(|k| {
                let ([x0, y0], [x1, y1]) = (at(moment(k)), at(moment(k + 1)));
                focal_px * (x1 - x0).hypot(y1 - y0)
            })
            .sum()
    }

    /// The mean of its motion over the exposure: a turn (rad) and a translation (scene sizes).
    #[must_use]
    pub fn mean_motion(&self) -> [f64; RIGID] {
        // The mean of s^k from -1/2 to 1/2.
        self.sum_of(|power| {
            if power % 2 == 0 {
                0.5_f64.powi(power) / f64::from(power + 1)
            } else {
                0.0
            }
        })
    }

    /// Bends the path, so that [`Self::mean_motion`] grows by `motion`; the middle of the exposure stays where it is.
    ///
    /// # Panics
    /// Where the path is straight (of degree 1): it has no mean but its middle.
    pub fn bend(&mut self, motion: [f64; RIGID]) {
        // The mean of s² is 1/12.
        for (bend, by) in self.path[RIGID..2 * RIGID].iter_mut().zip(motion) {
            *bend += 12.0 * by;
        }
    }

    /// The sum of the path's coefficients, each times a weight of its power of s.
    fn sum_of(&self, weight: impl Fn(i32) -> f64) -> [f64; RIGID] {
        let mut sum = [0.0; RIGID];
        for (power, coefficients) in (1..).zip(self.path.chunks_exact(RIGID)) {
            for (sum, coefficient) in sum.iter_mut().zip(coefficients) {
                *sum += weight(power) * coefficient;
            }
        }
        sum
    }

    /// Diameter of the disc that a point at depth S / `disparity` becomes, px.
    #[must_use]
    pub fn disc_px(&self, focal_px: f64, disparity: f64) -> f64 {
        2.0 * focal_px * (self.aperture * (self.focus - disparity)).abs()
    }
}
