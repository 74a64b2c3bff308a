//! Who computes the ops: kernels in main memory, and the graph around any backend.

mod autodiff;
#[cfg(any(feature = "flex", feature = "ndarray"))]
mod cpu;
#[cfg(feature = "cube")]
pub(crate) mod cube;
