//! What kernels in main memory share: the float types they compute with ([`Real`]), the machine's vectors of them
//! ([`Vectors`], [`vectorized`]), and, with the feature `burn`, the way from a backend's tensors to slices and back
//! ([`HostBackend`]).
//!
//! It stands below all crates of this workspace that have kernels, and knows none of them.

mod buffers;
mod real;
#[cfg(feature = "burn")]
mod tensors;
mod vectors;

pub use buffers::filled;
pub use real::Real;
#[cfg(feature = "burn")]
pub use tensors::{HostBackend, HostFloat, register, tensor};
pub use vectors::{Vectors, vectorized};
