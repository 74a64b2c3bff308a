//! A view as files of cameras have it.

use std::path::Path;

use glam::DAffine3;
use splat_core::{Camera, CameraModel};

use crate::IoError;

/// A picture's camera.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportedView {
    /// The picture's file, relative to where pictures are looked for, with `/` between folders. COLMAP's readers take no spaces.
    pub file: String,
    /// Intrinsics.
    pub camera: Camera,
    /// The camera's pose, OpenCV axes.
    pub cam_from_world: DAffine3,
    /// Time in units of training frames.
    pub time: f32,
    /// Whether it is for scoring only.
    pub is_test: bool,
}

/// An error for a camera that no reader would take. A model that these files do not know stops the build here.
pub(super) fn check(view: &ExportedView, path: &Path) -> Result<(), IoError> {
    let ExportedView {
        file,
        camera,
        cam_from_world,
        time,
        ..
    } = view;
    let CameraModel::Pinhole = camera.model;
    let numbers = [camera.fx, camera.fy, camera.cx, camera.cy, f64::from(*time)];
    if numbers.iter().all(|v| v.is_finite()) && cam_from_world.is_finite() {
        return Ok(());
    }
    Err(IoError::not_a_number(
        path,
        format!("a number of the camera of {file}"),
        "leave the view out",
    ))
}
