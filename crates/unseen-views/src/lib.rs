//! Camera poses around a camera's path and forward warping into them.
//!
//! Views that no camera took keep a scene honest where the training views alone leave it free: a
//! frame with depth is warped to a pose beside the path and serves there as a picture to learn from.
//!
//! Paths to show a scene from, [`Orbit`] and [`PoseSpline`], are poses too.
//!
//! Plain slices, no tensors: the warp's inputs are data, so it needs no gradient.
//!
//! Conventions: camera axes x right, y down, z forward; the centre of pixel (i, j) is at
//! (i + 0.5, j + 0.5); depth is z-depth in scene units; poses are named `cam_from_world`.

mod camera_path;
mod depth_edges;
mod error;
mod orbit;
mod pose_spline;
mod warp;

pub use camera_path::{parallel_pose, perpendicular_pose};
pub use depth_edges::depth_edges;
pub use error::WarpError;
pub use glam;
pub use orbit::Orbit;
pub use pose_spline::PoseSpline;
pub use warp::{Source, WarpOptions, Warped, warp};
