//! The adapters between Burn's tensors and the slices that the kernel works on.

mod autodiff;
#[cfg(any(feature = "flex", feature = "ndarray"))]
mod cpu;
#[cfg(feature = "cube")]
mod cube;
mod fit;
