//! Camera models of files: a pinhole and its distortion.

use std::path::Path;

use splat_core::Camera;

use crate::IoError;

/// How a lens moves points of the plane z = 1, (u, v), before the focal length is applied.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Distortion {
    /// Radial `(1 + Σ num_i r^2i) / (1 + Σ den_i r^2i)` and tangential p1, p2 (Brown, OpenCV).
    Radial {
        num: [f64; 4],
        den: [f64; 3],
        tangential: [f64; 2],
    },
    /// OpenCV's fisheye: angle θ from the axis goes to radius `θ (1 + Σ k_i θ^2i)`.
    Fisheye { k: [f64; 4] },
    /// COLMAP's FOV model (Devernay and Faugeras) with parameter ω.
    Fov { omega: f64 },
}

impl Distortion {
    pub(crate) const NONE: Self = Self::Radial {
        num: [0.0; 4],
        den: [0.0; 3],
        tangential: [0.0; 2],
    };

    /// Where the lens puts the point that a pinhole would put at (u, v).
    fn apply(&self, u: f64, v: f64) -> (f64, f64) {
        let r2 = u * u + v * v;
        let r = r2.sqrt();
        // Σ c_i x^i, i from 1.
        let series = |c: &[f64], x: f64| c.iter().rev().fold(0.0, |sum, c| (sum + c) * x);
        match self {
            Self::Radial {
                num,
                den,
                tangential: [p1, p2],
            } => {
                let radial = (1.0 + series(num, r2)) / (1.0 + series(den, r2));
                (
                    u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
                    v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v),
                )
            }
            _ if r < 1e-12 => (u, v),
            Self::Fisheye { k } => {
                let theta = r.atan();
                let scale = theta * (1.0 + series(k, theta * theta)) / r;
                (u * scale, v * scale)
            }
            Self::Fov { omega } if omega.abs() < 1e-12 => (u, v),
            Self::Fov { omega } => {
                let scale = (2.0 * r * (omega / 2.0).tan()).atan() / (omega * r);
                (u * scale, v * scale)
            }
        }
    }
}

/// A pinhole and what its lens adds.
#[derive(Clone, Debug)]
pub(crate) struct Lens {
    pub(crate) model: String,
    pub(crate) camera: Camera,
    pub(crate) distortion: Distortion,
}

impl Lens {
    /// Checks the numbers and that there is no distortion worth a thousandth of a pixel.
    /// `who` has it, for messages.
    pub(crate) fn into_pinhole(self, who: &str, path: &Path) -> Result<Camera, IoError> {
        if let Some(fault) = fault(&self.camera) {
            return Err(IoError::malformed(path, format!("{who}: {fault}")));
        }
        let pixels = self.largest_displacement();
        // Written so that a coefficient that is not a number is refused too.
        if pixels < 1e-3 {
            return Ok(self.camera);
        }
        Err(IoError::Distortion {
            model: self.model,
            pixels,
            path: path.into(),
        })
    }

    /// Largest displacement against the pinhole (px), over a grid that includes border and corners.
    fn largest_displacement(&self) -> f64 {
        const STEPS: usize = 64;
        let c = &self.camera;
        let mut largest = 0.0f64;
        for j in 0..=STEPS {
            for i in 0..=STEPS {
                let u = (c.width as f64 * i as f64 / STEPS as f64 - c.cx) / c.fx;
                let v = (c.height as f64 * j as f64 / STEPS as f64 - c.cy) / c.fy;
                let (du, dv) = self.distortion.apply(u, v);
                let moved = (c.fx * (du - u)).hypot(c.fy * (dv - v));
                if moved.is_nan() {
                    return f64::NAN;
                }
                largest = largest.max(moved);
            }
        }
        largest
    }
}

/// What is wrong with a camera's numbers, if anything.
fn fault(c: &Camera) -> Option<String> {
    if c.width == 0 || c.height == 0 {
        return Some(format!("size {}x{} has no pixels", c.width, c.height));
    }
    // Far beyond any lens, and far from overflow when the camera is scaled.
    for f in [c.fx, c.fy] {
        if f.is_nan() {
            return Some(format!("focal length {f} is not a number"));
        }
        if f <= 0.0 {
            return Some(format!("focal length {f} is not over zero"));
        }
        if !(1e-3..=1e9).contains(&f) {
            return Some(format!(
                "focal length {f} is no lens's: 0.001 to 1e9 pixels are"
            ));
        }
    }
    // Written so that what is not a number is refused too.
    let near = -1e9..=1e9;
    let lost = [c.cx, c.cy].into_iter().find(|v| !near.contains(v));
    lost.map(|v| format!("the centre's coordinate {v} is not within 1e9 pixels of the picture"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn displacement(distortion: Distortion) -> f64 {
        let lens = Lens {
            model: "X".into(),
            camera: Camera::pinhole([200, 100], [100.0, 100.0], [100.0, 50.0]),
            distortion,
        };
        let pixels = lens.largest_displacement();
        match lens.into_pinhole("camera 1", Path::new("cameras.bin")) {
            Ok(_) => assert!(pixels < 1e-3, "{pixels}"),
            Err(IoError::Distortion { pixels: told, .. }) => {
                assert!(told == pixels || pixels.is_nan(), "{told} is not {pixels}");
            }
            Err(e) => panic!("{e}"),
        }
        pixels
    }

    fn radial(k1: f64, k2: f64) -> Distortion {
        Distortion::Radial {
            num: [k1, k2, 0.0, 0.0],
            den: [0.0; 3],
            tangential: [0.0; 2],
        }
    }

    #[test]
    fn displacement_at_the_corner_by_hand() {
        assert_eq!(displacement(Distortion::NONE), 0.0);
        // The corner is at (u, v) = (1, 0.5), r² = 1.25, |(u, v)| = sqrt(1.25).
        let r = 1.25f64.sqrt();
        assert!((displacement(radial(0.1, 0.0)) - 100.0 * 0.1 * r.powi(3)).abs() < 1e-9);
        assert!((displacement(radial(0.0, -0.02)) - 100.0 * 0.02 * r.powi(5)).abs() < 1e-9);
        let rational = Distortion::Radial {
            num: [0.1, 0.0, 0.0, 0.0],
            den: [0.1, 0.0, 0.0],
            tangential: [0.0; 2],
        };
        assert!(
            displacement(rational) < 1e-9,
            "numerator and denominator cancel"
        );
        // A fisheye whose coefficients are all zero is no pinhole: r goes to atan r.
        let fisheye = displacement(Distortion::Fisheye { k: [0.0; 4] });
        assert!((fisheye - 100.0 * (r - r.atan())).abs() < 1e-9);
        let fov = displacement(Distortion::Fov { omega: 0.8 });
        assert!(
            (fov - 100.0 * ((2.0 * r * 0.4f64.tan()).atan() / 0.8 - r).abs()) < 1e-9 || fov > 1.0
        );
        assert!(
            displacement(radial(f64::NAN, 0.0)).is_nan(),
            "refused, not ignored"
        );
    }

    #[test]
    fn tangential_by_hand() {
        let d = Distortion::Radial {
            num: [0.0; 4],
            den: [0.0; 3],
            tangential: [0.01, 0.02],
        };
        // OpenCV: u + 2 p1 u v + p2 (r² + 2 u²), v + p1 (r² + 2 v²) + 2 p2 u v.
        let (u, v) = d.apply(0.5, -0.25);
        let r2 = 0.3125;
        assert!((u - (0.5 + 2.0 * 0.01 * -0.125 + 0.02 * (r2 + 0.5))).abs() < 1e-12);
        assert!((v - (-0.25 + 0.01 * (r2 + 0.125) + 2.0 * 0.02 * -0.125)).abs() < 1e-12);
    }
}
