//! What a camera collects while its shutter is open: an average of renders in light.

use super::blocks::BLOCK;
use super::gradients::Gradients;
use super::project::Projection;
use super::raster::RasterState;
use super::transfer::Transfer;
use super::types::{SplatSlices, View};
use crate::error::SplatError;

/// Blended channels of a sample: colour alone.
pub(super) const COLORS: usize = 3;

/// Gaussians, and from where the light of one picture came: n samples of equal weight.
#[derive(Clone, Copy, Debug)]
pub struct Exposure<'a, T> {
    /// The Gaussians in the middle of the exposure. Their `left_rotations` take no part.
    pub splats: SplatSlices<'a, T>,
    /// Camera and pose in the middle of the exposure: all samples see a Gaussian in the colour in which its middle is
    /// seen from there.
    pub middle: &'a View,
    /// The samples' poses, any affine map, [n, 3, 4] with n > 0.
    pub poses: &'a [T],
    /// Means of rows [0, F) in each sample, scene units, [n, F, 3]; may be empty.
    pub moving_means: &'a [T],
    /// Matrices multiplied from the left of their rotation, [n, F, 3, 3].
    pub left_rotations: &'a [T],
    /// How the picture's values stand for light.
    pub transfer: Transfer,
}

impl<'a, T> Exposure<'a, T> {
    /// Number n of samples.
    #[must_use]
    pub fn num_samples(&self) -> usize {
        self.poses.len() / 12
    }

    /// Number F of Gaussians that move in the exposure.
    #[must_use]
    pub fn num_moving(&self) -> usize {
        let samples = self.num_samples();
        self.moving_means
            .len()
            .checked_div(3 * samples)
            .unwrap_or(0)
    }

    /// Where the moving rows are in sample `i`.
    pub(super) fn moved(&self, i: usize) -> Moved<'a, T> {
        let rows = self.num_moving();
        Moved {
            rows,
            means: &self.moving_means[3 * rows * i..3 * rows * (i + 1)],
            left_rotations: &self.left_rotations[9 * rows * i..9 * rows * (i + 1)],
        }
    }

    /// The Gaussians without left rotations.
    pub(super) fn resting(&self) -> SplatSlices<'a, T>
    where
        T: Copy,
    {
        SplatSlices {
            left_rotations: &[],
            ..self.splats
        }
    }

    /// Checks every length.
    pub(super) fn check(&self) -> Result<(), SplatError> {
        let (n, rows) = (self.num_samples(), self.num_moving());
        let shape = |tensor, found, expected| {
            Err(SplatError::Shape {
                tensor,
                found: vec![found],
                expected,
            })
        };
        if n == 0 || !self.poses.len().is_multiple_of(12) {
            return shape("poses", self.poses.len(), "[n, 3, 4] with n > 0".to_owned());
        }
        let (means, most) = (self.moving_means.len(), self.splats.len());
        if means != n * rows * 3 || rows > most {
            let expected = format!("[{n}, F, 3] with F <= {most}");
            return shape("moving_means", means, expected);
        }
        let left = self.left_rotations.len();
        if left != n * rows * 9 {
            return shape("left_rotations", left, format!("[{n}, {rows}, 3, 3]"));
        }
        Ok(())
    }
}

/// Rows [0, F) in one sample.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moved<'a, T> {
    /// F.
    pub(super) rows: usize,
    /// [F, 3].
    pub(super) means: &'a [T],
    /// [F, 3, 3].
    pub(super) left_rotations: &'a [T],
}

/// A picture and what its backward pass needs.
#[derive(Clone, Debug)]
pub struct Exposed<T> {
    /// Colour on a black background, not clamped above 1, [H, W, 3].
    pub color: Vec<T>,
    /// Largest radius of every Gaussian over the samples (three standard deviations of its longer axis), px, `[N]`; 0
    /// for Gaussians that no sample draws.
    pub radii: Vec<f32>,
    /// For [`super::expose_backward`].
    pub state: ExposedState<T>,
}

/// What the backward pass needs of an exposure beside its inputs.
#[derive(Clone, Debug)]
pub struct ExposedState<T> {
    pub(super) samples: Vec<Sample<T>>,
    /// The picture by tiles: [tiles, blocks, 3] of 16 pixels.
    pub(super) picture: Vec<[T; BLOCK]>,
}

/// One render of an exposure.
#[derive(Clone, Debug)]
pub(super) struct Sample<T> {
    pub(super) projection: Projection<T>,
    pub(super) raster: RasterState<T>,
    /// Its colours by tiles: [tiles, blocks, 3] of 16 pixels.
    pub(super) blended: Vec<[T; BLOCK]>,
}

/// Gradients of all inputs of an exposure, in the inputs' shapes.
#[derive(Clone, Debug)]
pub struct ExposureGradients<T> {
    /// Of the Gaussians in the middle of the exposure and of the pose there: for rows [0, F) means have only what comes
    /// through the colours. `left_rotations` and `features` are empty; `screen` is the sum over the samples.
    pub middle: Gradients<T>,
    /// [n, 3, 4].
    pub poses: Vec<T>,
    /// [n, F, 3].
    pub moving_means: Vec<T>,
    /// [n, F, 3, 3].
    pub left_rotations: Vec<T>,
}
