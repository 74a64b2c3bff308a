//! Inputs of the kernels.

use glam::DAffine3;

use crate::camera::{Camera, pose_rows};
use crate::error::SplatError;

/// The Gaussians as borrowed row-major arrays.
///
/// N is the number of opacity logits; the other lengths must fit it.
#[derive(Clone, Copy, Debug)]
pub struct SplatSlices<'a, T> {
    /// Means in the world, scene units, [N, 3].
    pub means: &'a [T],
    /// Quaternions (w, x, y, z), any length, [N, 4].
    pub quats: &'a [T],
    /// Matrices multiplied from the left of the rotation of rows [0, F), [F, 3, 3], F <= N; may be empty.
    pub left_rotations: &'a [T],
    /// Natural logarithms of the scales, [N, 3].
    pub log_scales: &'a [T],
    /// Logits of the opacities, `[N]`.
    pub opacity_logits: &'a [T],
    /// Spherical harmonics, [N, B, 3] with B = (stored degree + 1)².
    pub sh: &'a [T],
}

impl<T> SplatSlices<'_, T> {
    /// Number of Gaussians N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.opacity_logits.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.opacity_logits.is_empty()
    }

    /// Number of SH coefficients B per channel (0 when there is no Gaussian).
    #[must_use]
    pub fn sh_coefficients(&self) -> usize {
        self.sh.len().checked_div(3 * self.len()).unwrap_or(0)
    }

    /// Number of rows F that have a left rotation.
    #[must_use]
    pub fn num_left(&self) -> usize {
        self.left_rotations.len() / 9
    }

    /// Checks every length, and that the active SH degree is stored.
    pub(crate) fn check(&self, sh_degree: usize) -> Result<(), SplatError> {
        let n = self.len();
        for (tensor, found, width) in [
            ("means", self.means.len(), 3),
            ("quats", self.quats.len(), 4),
            ("log_scales", self.log_scales.len(), 3),
        ] {
            if found != n * width {
                return Err(shape_error(tensor, found, format!("[{n}, {width}]")));
            }
        }
        let left = self.left_rotations.len();
        if !left.is_multiple_of(9) || left / 9 > n {
            return Err(shape_error(
                "left_rotations",
                left,
                format!("[F, 3, 3] with F <= {n}"),
            ));
        }
        if n == 0 {
            return if sh_degree > 3 {
                Err(SplatError::ShDegree {
                    active: sh_degree,
                    stored: 3,
                })
            } else {
                Ok(())
            };
        }
        let b = self.sh_coefficients();
        let stored = match b {
            1 => 0,
            4 => 1,
            9 => 2,
            16 => 3,
            _ => usize::MAX,
        };
        if stored == usize::MAX || self.sh.len() != n * b * 3 {
            return Err(shape_error(
                "sh",
                self.sh.len(),
                format!("[{n}, B, 3] with B of 1, 4, 9 or 16"),
            ));
        }
        if sh_degree > stored {
            return Err(SplatError::ShDegree {
                active: sh_degree,
                stored,
            });
        }
        Ok(())
    }
}

fn shape_error(tensor: &'static str, found: usize, expected: String) -> SplatError {
    SplatError::Shape {
        tensor,
        found: vec![found],
        expected,
    }
}

/// From where the Gaussians are seen, and how.
#[derive(Clone, Debug)]
pub struct View {
    /// Intrinsics, size and near plane.
    pub camera: Camera,
    /// Rows of the rigid transform [R | t] from the world to the camera, [3, 4].
    pub cam_from_world: [f64; 12],
    /// SH bands up to this degree are used, 0 to 3.
    pub sh_degree: usize,
}

impl View {
    /// A view from a pose.
    #[must_use]
    pub fn new(camera: &Camera, cam_from_world: &DAffine3, sh_degree: usize) -> Self {
        Self {
            camera: camera.clone(),
            cam_from_world: pose_rows(cam_from_world),
            sh_degree,
        }
    }
}

impl Camera {
    /// It must be usable.
    pub(crate) fn check(&self) -> Result<(), SplatError> {
        let c = self;
        let bad = |reason: String| Err(SplatError::Camera { reason });
        let sides = 1..=65_535;
        if !sides.contains(&c.width) || !sides.contains(&c.height) {
            return bad(format!(
                "the image is {} x {} px, each side must be 1 to 65535",
                c.width, c.height
            ));
        }
        for (name, value) in [("fx", c.fx), ("fy", c.fy), ("near", c.near)] {
            if !(value.is_finite() && value > 0.0) {
                return bad(format!("{name} is {value}, it must be positive and finite"));
            }
        }
        for (name, value) in [("cx", c.cx), ("cy", c.cy)] {
            if !value.is_finite() {
                return bad(format!("{name} is {value}, it must be finite"));
            }
        }
        Ok(())
    }
}
