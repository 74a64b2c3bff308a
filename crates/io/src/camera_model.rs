//! Camera models of files: a pinhole and its distortion.

use std::path::Path;

use splat_core::Camera;

use crate::IoError;
use crate::resample::resize_camera;

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
    pub(crate) fn apply(&self, u: f64, v: f64) -> (f64, f64) {
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

    /// Derivatives of [`Self::apply`] as rows, by central differences.
    fn jacobian(&self, u: f64, v: f64) -> [[f64; 2]; 2] {
        let h = 1e-6 * (1.0 + u.abs() + v.abs());
        let (right, left) = (self.apply(u + h, v), self.apply(u - h, v));
        let (below, above) = (self.apply(u, v + h), self.apply(u, v - h));
        let d = |a: f64, b: f64| (a - b) / (2.0 * h);
        [
            [d(right.0, left.0), d(below.0, above.0)],
            [d(right.1, left.1), d(below.1, above.1)],
        ]
    }

    /// How much larger the lens makes areas at (u, v); not over zero where it folds the picture over.
    pub(crate) fn area_scale(&self, u: f64, v: f64) -> f64 {
        let [[a, b], [c, d]] = self.jacobian(u, v);
        a * d - b * c
    }

    /// Whether nothing is folded between the axis and a point, and the point is not thrown to its other side.
    fn is_unfolded_up_to(&self, (u, v): (f64, f64), (du, dv): (f64, f64)) -> bool {
        const STEPS: u32 = 16;
        let mut shares = (1..=STEPS).map(|i| f64::from(i) / f64::from(STEPS));
        u * du + v * dv >= 0.0 && shares.all(|share| self.area_scale(share * u, share * v) > 0.0)
    }

    /// The point that [`Self::apply`] puts at (du, dv), by Newton's method with halved steps. None where there is none, or
    /// none that is found without a fold on the way.
    pub(crate) fn undo(&self, (du, dv): (f64, f64)) -> Option<(f64, f64)> {
        const ITERATIONS: usize = 60;
        let residual = |(u, v): (f64, f64)| {
            let (x, y) = self.apply(u, v);
            (x - du, y - dv)
        };
        let size = |(x, y): (f64, f64)| x.hypot(y);
        let mut at = (du, dv);
        let mut off = residual(at);
        for _ in 0..ITERATIONS {
            if size(off) < 1e-12 * (1.0 + size((du, dv))) {
                break;
            }
            let [[a, b], [c, d]] = self.jacobian(at.0, at.1);
            let det = a * d - b * c;
            let step = ((d * off.0 - b * off.1) / det, (a * off.1 - c * off.0) / det);
            let tried = (0..20).map(|halvings| {
                let share = 0.5f64.powi(halvings);
                let there = (at.0 - share * step.0, at.1 - share * step.1);
                (there, residual(there))
            });
            let mut better = tried.filter(|(_, there)| size(*there) < size(off));
            let Some(next) = better.next() else { break };
            (at, off) = next;
        }
        // Written so that what is not a number is refused.
        let found = size(off) < 1e-9 * (1.0 + size((du, dv)));
        (found && self.is_unfolded_up_to(at, (du, dv))).then_some(at)
    }

    fn coefficients(&self) -> Vec<f64> {
        match self {
            Self::Radial {
                num,
                den,
                tangential,
            } => [&num[..], den, tangential].concat(),
            Self::Fisheye { k } => k.to_vec(),
            Self::Fov { omega } => vec![*omega],
        }
    }
}

/// A pinhole and what its lens adds.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Lens {
    pub(crate) model: String,
    pub(crate) camera: Camera,
    pub(crate) distortion: Distortion,
}

impl Lens {
    /// A pinhole without distortion.
    pub(crate) fn pinhole(camera: Camera) -> Self {
        Self {
            model: "PINHOLE".into(),
            camera,
            distortion: Distortion::NONE,
        }
    }

    /// Checks the numbers. `who` has them, for messages.
    pub(crate) fn checked(self, who: &str, path: &Path) -> Result<Self, IoError> {
        let fault = fault(&self.camera).or_else(|| {
            let lost = self.distortion.coefficients();
            let lost = lost.into_iter().find(|v| !v.is_finite());
            lost.map(|v| format!("the lens coefficient {v} is not a finite number"))
        });
        match fault {
            Some(fault) => Err(IoError::malformed(path, format!("{who}: {fault}"))),
            None => Ok(self),
        }
    }

    /// The lens before the same picture at another size.
    pub(crate) fn resized(&self, width: usize, height: usize) -> Self {
        Self {
            camera: resize_camera(&self.camera, width, height),
            ..self.clone()
        }
    }

    /// Largest displacement against the pinhole (px), over a grid that includes border and corners. Not a number where some
    /// point has no image.
    pub(crate) fn largest_displacement(&self) -> f64 {
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
        lens.largest_displacement()
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
        assert!((fov - 100.0 * ((2.0 * r * 0.4f64.tan()).atan() / 0.8 - r).abs()).abs() < 1e-9);
        assert!(displacement(radial(f64::NAN, 0.0)).is_nan(), "not ignored");
    }

    #[test]
    fn coefficients_that_are_no_numbers_are_refused() {
        for distortion in [
            radial(f64::NAN, 0.0),
            radial(0.0, f64::INFINITY),
            Distortion::Fisheye { k: [f64::NAN; 4] },
            Distortion::Fov { omega: f64::NAN },
        ] {
            let lens = Lens {
                distortion,
                ..Lens::pinhole(Camera::pinhole([20, 10], [10.0, 10.0], [10.0, 5.0]))
            };
            let error = lens.checked("camera 1", Path::new("cameras.bin"));
            let told = error.expect_err("no number").to_string();
            assert!(
                told.contains("camera 1") && told.contains("coefficient"),
                "{told}"
            );
        }
    }

    #[test]
    fn what_was_distorted_is_undone() {
        let brown = Distortion::Radial {
            num: [-0.28, 0.11, -0.02, 0.0],
            den: [0.0; 3],
            tangential: [1e-3, -2e-3],
        };
        let rational = Distortion::Radial {
            num: [0.5, -0.1, 0.02, 0.0],
            den: [0.8, 0.05, 0.01],
            tangential: [0.0; 2],
        };
        for lens in [
            Distortion::NONE,
            brown,
            rational,
            radial(0.2, 0.05),
            Distortion::Fisheye {
                k: [0.02, -0.01, 0.003, -0.001],
            },
            Distortion::Fov { omega: 0.9 },
        ] {
            for i in -8..=8 {
                for j in -6..=6 {
                    let (u, v) = (0.1 * f64::from(i), 0.1 * f64::from(j));
                    let (x, y) = lens.undo(lens.apply(u, v)).expect("an inverse");
                    assert!((x - u).hypot(y - v) < 1e-9, "{lens:?} at {u} {v}: {x} {y}");
                }
            }
        }
        // r - 0.5 r³ comes to 0.544 at most, at r = 0.816.
        let folded = radial(-0.5, 0.0);
        for beyond in [0.6, 1.0, 12.0, 1e3] {
            assert!(folded.undo((beyond, 0.1)).is_none(), "{beyond}");
        }
        assert!(folded.area_scale(0.9, 0.0) < 0.0 && folded.area_scale(0.7, 0.0) > 0.0);
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
