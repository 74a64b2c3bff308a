//! Cameras, Gaussians, and the splatting op with its hand-written backward.
//!
//! Without the default feature `burn` this crate is cameras, plain Gaussian arrays and the slice
//! kernels ([`cpu`]), and that is all that file formats and viewers need. With it, [`prepare`],
//! [`rasterize`], [`render`] and [`expose`] do the same on Burn tensors, with gradients.
//!
//! ```
//! use splat_core::cpu::{View, project, rasterize};
//! use splat_core::{Camera, Gaussians, glam::DAffine3};
//!
//! let gaussians = Gaussians {
//!     means: vec![[0.0, 0.0, 2.0]],
//!     quats: vec![[1.0, 0.0, 0.0, 0.0]],
//!     log_scales: vec![[-1.0; 3]],
//!     opacity_logits: vec![2.0],
//!     sh: vec![1.0, 0.0, 0.0],
//!     sh_degree: 0,
//! }
//! .checked()?;
//! let camera = Camera::pinhole([64, 48], [50.0, 50.0], [32.0, 24.0]);
//! let view = View::new(&camera, &DAffine3::IDENTITY, gaussians.sh_degree);
//! let image = rasterize(&project(&gaussians.slices(), &view)?, &[], 0)?;
//! assert!(image.color().all(|[red, green, _]| red >= green));
//! # Ok::<(), splat_core::SplatError>(())
//! ```

#[cfg(feature = "burn")]
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod backends;
mod camera;
pub mod cpu;
#[cfg(feature = "cube")]
mod cube;
mod error;
#[cfg(feature = "burn")]
mod expose;
mod gaussians;
#[cfg(feature = "burn")]
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod ops;
#[cfg(feature = "burn")]
mod render;
#[cfg(feature = "burn")]
mod splats;
mod stages;

#[cfg(feature = "cube")]
pub use backends::cube::LARGEST_TABLE;
pub use camera::{Camera, CameraModel, camera_center, pose_rows};
/// How pictures stand for light.
pub use cpu::Transfer;
pub use error::SplatError;
#[cfg(feature = "burn")]
pub use expose::{Exposed, Exposure, Movers, expose};
pub use gaussians::Gaussians;
/// Poses and points in this crate's signatures.
pub use glam;
#[cfg(feature = "burn")]
pub use render::{Extra, Prepared, Rendered, prepare, rasterize, render};
#[cfg(feature = "burn")]
pub use splats::{Splats, Viewpoint};
pub use stages::{InImage, Stages};
