//! Cameras, Gaussians, and the splatting op with its hand-written backward.
//!
//! Without the default feature `burn` this crate is cameras, plain Gaussian arrays and the slice
//! kernels ([`cpu`]), and that is all that file formats and viewers need. With it, [`prepare`],
//! [`rasterize`] and [`render`] do the same on Burn tensors, with gradients.

mod camera;
pub mod cpu;
mod error;
mod gaussians;
#[cfg(feature = "burn")]
mod host;
#[cfg(feature = "burn")]
mod ops;
#[cfg(feature = "burn")]
mod render;

pub use camera::{Camera, CameraModel, camera_center, pose_rows};
pub use error::SplatError;
pub use gaussians::Gaussians;
#[cfg(feature = "burn")]
pub use render::{Prepared, RenderOptions, Rendered, Splats, prepare, rasterize, render};
