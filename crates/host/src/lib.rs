//! What kernels in main memory share: the float types they compute with ([`Real`]), the machine's vectors of them
//! ([`Vectors`], [`vectorized`]), large buffers ([`filled`]), and, with the feature `burn`, the way from a backend's tensors to slices and back
//! ([`HostBackend`]), products of small matrices ([`product`]), and the question whether a tensor is all numbers ([`first_not_finite`]). The feature `cube` adds
//! what kernels on a GPU share.
//!
//! ```
//! use host::{Real, vectorized};
//!
//! /// One source for both widths: f32 is what runs, f64 its reference.
//! fn rms<T: Real>(values: &[T]) -> T {
//!     let square = |sum: T, v: &T| sum + *v * *v;
//!     (values.iter().fold(T::ZERO, square) / T::of(values.len() as f64)).sqrt()
//! }
//! assert_eq!(vectorized(|| rms(&[3.0_f32, 4.0, 5.0, 0.0])), 12.5_f32.sqrt());
//! assert_eq!(vectorized(|| rms(&[3.0_f64, 4.0, 5.0, 0.0])), 12.5_f64.sqrt());
//! ```
//!
//! It stands below all crates of this workspace that have kernels, and knows none of them.

mod buffers;
#[cfg(feature = "cube")]
pub mod cube;
#[cfg(feature = "burn")]
mod finite;
#[cfg(feature = "burn")]
mod product;
#[cfg(feature = "burn")]
mod read;
mod real;
#[cfg(feature = "burn")]
mod tensors;
mod vectors;

pub use buffers::filled;
#[cfg(feature = "burn")]
pub use finite::{all_zero, count_not_finite, first_not_finite};
#[cfg(feature = "burn")]
pub use product::{product, products};
#[cfg(feature = "burn")]
pub use read::{WAIT, read, said, try_read, waiting};
pub use real::Real;
#[cfg(feature = "burn")]
pub use tensors::{HostBackend, HostFloat, pass_back, tensor};
pub use vectors::{Vectors, vectorized};
