//! Cameras, Gaussians, and the splatting op with its hand-written backward.
//!
//! Without the default feature `burn` this crate is cameras, plain Gaussian arrays and the slice
//! kernels, and that is all that file formats and viewers need.

mod camera;
mod gaussians;

pub use camera::{Camera, CameraModel, camera_center, pose_rows};
pub use gaussians::Gaussians;
