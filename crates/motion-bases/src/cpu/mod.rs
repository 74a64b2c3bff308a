//! The kernel on slices, generic over f32 and f64: f32 is what runs, f64 its reference.
//!
//! Work is cut into pieces of a fixed size, whatever the number of threads, and partial sums are
//! added in the order of the pieces: results have the same bits with any number of threads.

pub(crate) mod fit;
mod frame;
pub(crate) mod lanes;
pub(crate) mod moved;
pub(crate) mod moved_backward;
mod vec3;
