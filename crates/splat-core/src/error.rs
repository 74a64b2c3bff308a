//! What can be wrong with the inputs of a render.

use thiserror::Error;

/// Why a scene could not be rendered. Every message says what is wrong and where.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum SplatError {
    /// An input holds NaN or an infinity.
    #[error("{tensor} is not finite in row {row}: every input of a render must be finite")]
    NotFinite {
        /// Name of the input.
        tensor: &'static str,
        /// First row (Gaussian, or row of the matrix) that is not finite.
        row: usize,
    },
    /// An input has the wrong shape.
    #[error("{tensor} has the shape {found:?}, but {expected} is needed")]
    Shape {
        /// Name of the input.
        tensor: &'static str,
        /// Its shape.
        found: Vec<usize>,
        /// The shape that fits the other inputs.
        expected: String,
    },
    /// More SH bands are asked for than are stored, or more than 3.
    #[error(
        "SH degree {active} is asked for, but the coefficients reach degree {stored} (3 at most)"
    )]
    ShDegree {
        /// Degree asked for.
        active: usize,
        /// Degree that the stored coefficients have.
        stored: usize,
    },
    /// The camera cannot be rendered with.
    #[error("bad camera: {reason}")]
    Camera {
        /// Which number is wrong and what it must be.
        reason: String,
    },
    /// The Gaussians cover more tiles than indices can count.
    #[error(
        "the Gaussians overlap {count} tiles in total, over the limit of 2^32 - 1: use fewer or smaller Gaussians"
    )]
    TooManyTiles {
        /// Number of pairs of a Gaussian and a tile.
        count: usize,
    },
    /// A table would not fit into the device's buffers.
    #[error(
        "{table} need {bytes} bytes, but a buffer of this device holds {limit}: use fewer or smaller Gaussians, smaller pictures, fewer samples of an exposure, or the CPU"
    )]
    TooLarge {
        /// What the table holds.
        table: &'static str,
        /// Its size.
        bytes: u64,
        /// The largest that the device has.
        limit: u64,
    },
    /// More features than the device's kernels can blend.
    #[error(
        "{found} features are to be blended, but this device blends {limit} at most: use the CPU"
    )]
    TooManyFeatures {
        /// Number of features.
        found: usize,
        /// The largest number.
        limit: usize,
    },
    /// The device does not answer.
    #[error("the device failed: {reason}")]
    Device {
        /// What it said.
        reason: String,
    },
    /// Inputs mix float types, or are neither f32 nor f64.
    #[error(
        "{tensor} is {found}, but every input must have the same type, f32 or f64 (means: {expected})"
    )]
    Dtype {
        /// Name of the input.
        tensor: &'static str,
        /// Its type.
        found: String,
        /// The type of the means.
        expected: String,
    },
}
