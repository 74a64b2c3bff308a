//! Plain arrays of Gaussians, as files and viewers hold them.

use crate::cpu::SplatSlices;
use crate::error::SplatError;

/// A set of Gaussians in storage space (what the 3DGS PLY format holds).
///
/// The arrays are open to read and to edit. [`Self::check`] says whether they fit each other; tensors, files and training ask it first.
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

    /// These, if their arrays fit each other.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn checked(self) -> Result<Self, SplatError> {
        self.check()?;
        Ok(self)
    }

    /// Whether all arrays have a row for each Gaussian, and SH coefficients of their degree.
    ///
    /// # Errors
    /// Names the array that does not fit.
    pub fn check(&self) -> Result<(), SplatError> {
        let shape = |tensor, found, expected| {
            Err(SplatError::Shape {
                tensor,
                found: vec![found],
                expected,
            })
        };
        let lengths = [
            ("means", self.means.len()),
            ("quats", self.quats.len()),
            ("log_scales", self.log_scales.len()),
            ("opacity_logits", self.opacity_logits.len()),
        ];
        // What all say but one, which is then at fault.
        let mut sorted = lengths.map(|(_, length)| length);
        sorted.sort_unstable();
        let n = sorted[1];
        if let Some((name, length)) = lengths.into_iter().find(|(_, length)| *length != n) {
            return shape(name, length, format!("[{n}]"));
        }
        self.slices().check(self.sh_degree)?;
        let width = 3 * (self.sh_degree + 1).pow(2);
        if self.sh.len() != n * width {
            return shape("sh", self.sh.len(), format!("[{n}, {width}]"));
        }
        Ok(())
    }

    /// As the slice kernels take them.
    #[must_use]
    pub fn slices(&self) -> SplatSlices<'_, f32> {
        SplatSlices {
            means: self.means.as_flattened(),
            quats: self.quats.as_flattened(),
            left_rotations: &[],
            log_scales: self.log_scales.as_flattened(),
            opacity_logits: &self.opacity_logits,
            sh: &self.sh,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_that_does_not_fit_is_named() {
        let good = Gaussians {
            means: vec![[0.0; 3]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            log_scales: vec![[0.0; 3]; 2],
            opacity_logits: vec![0.0; 2],
            sh: vec![0.0; 24],
            sh_degree: 1,
        };
        assert_eq!(good.clone().checked(), Ok(good.clone()));
        assert_eq!(Gaussians::default().check(), Ok(()));
        type Edit = fn(&mut Gaussians);
        let edits: [(&str, Edit); 8] = [
            ("means", |g| g.means.truncate(1)),
            ("quats", |g| g.quats.truncate(1)),
            ("log_scales", |g| g.log_scales.clear()),
            ("opacity_logits", |g| g.opacity_logits.truncate(1)),
            ("sh", |g| g.sh.truncate(23)),
            ("sh", |g| g.sh_degree = 0),
            ("SH degree 2", |g| g.sh_degree = 2),
            ("SH degree 4", |g| g.sh_degree = 4),
        ];
        for (name, edit) in edits {
            let mut bad = good.clone();
            edit(&mut bad);
            let message = bad.checked().unwrap_err().to_string();
            assert!(message.contains(name), "{name}: {message}");
        }
        let mut bad = Gaussians::default();
        bad.sh.push(0.0);
        assert!(bad.check().is_err(), "coefficients of no Gaussian");
    }
}
