//! Kernels on slices, generic over f32 and f64: f32 is what runs, f64 its reference.
//!
//! Work is cut into pieces of a fixed size, whatever the number of threads, and partial sums are
//! added in the order of the pieces: results have the same bits with any number of threads.

pub(crate) mod adam;
pub(crate) mod depth;
pub(crate) mod detail;
pub(crate) mod mask;
pub(crate) mod reduce;
pub(crate) mod ssim;

/// Values per parallel task of what goes value by value.
const BLOCK: usize = 1 << 15;
