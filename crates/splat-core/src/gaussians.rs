//! Plain arrays of Gaussians, as files and viewers hold them.

/// A set of Gaussians in storage space (what the 3DGS PLY format holds).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Means in scene units, `[N]`.
    pub means: Vec<[f32; 3]>,
    /// Rotations as quaternions (w, x, y, z), not normalised, `[N]`.
    pub quats: Vec<[f32; 4]>,
    /// Natural logarithms of the scales (scene units), `[N]`.
    pub log_scales: Vec<[f32; 3]>,
    /// Logits of the opacities, `[N]`.
    pub opacity_logits: Vec<f32>,
    /// Spherical harmonics, [N, (degree + 1)², 3] row-major: coefficient-major, channel last.
    pub sh: Vec<f32>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
}

impl Gaussians {
    /// Number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }
}
