//! nerfstudio's `transforms.json` (<https://docs.nerf.studio/quickstart/data_conventions.html>), as this crate's loader reads it.

use std::path::Path;

use glam::{DAffine3, DMat4, DVec4};
use serde_json::{Value, json};

use super::view::{ExportedView, check};
use crate::{IoError, write_json};

/// Writes cameras as `transforms.json`, atomically: camera-to-world with OpenGL axes, intrinsics and split per frame, and time
/// from 0 at the first training view to 1 at the last. `points` is a PLY beside it, of points to start from.
///
/// # Errors
/// [`IoError::NotANumber`], [`IoError::Access`].
pub fn write_transforms(
    path: &Path,
    views: &[ExportedView],
    points: Option<&str>,
) -> Result<(), IoError> {
    views.iter().try_for_each(|view| check(view, path))?;
    let training = views.iter().filter(|view| !view.is_test);
    let times = training.map(|view| f64::from(view.time));
    let (first, last) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(first, last), t| {
        (first.min(t), last.max(t))
    });
    let length = if last > first { last - first } else { 1.0 };
    let first = if first.is_finite() { first } else { 0.0 };
    let frames: Vec<Value> = views
        .iter()
        .map(|view| {
            let camera = &view.camera;
            json!({
                "file_path": view.file,
                "transform_matrix": world_from_gl(&view.cam_from_world),
                "time": (f64::from(view.time) - first) / length,
                "split": if view.is_test { "test" } else { "train" },
                "w": camera.width, "h": camera.height,
                "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            })
        })
        .collect();
    // No camera model is a pinhole to all readers; Brush refuses nerfstudio's name for it.
    let mut transforms = json!({ "frames": frames });
    if let Some(points) = points {
        transforms["ply_file_path"] = json!(points);
    }
    write_json(path, &transforms)
}

/// The rows of OpenGL's camera to world.
fn world_from_gl(cam_from_world: &DAffine3) -> [[f64; 4]; 4] {
    let gl = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
    let world_from_gl = DMat4::from(cam_from_world.inverse()) * gl;
    world_from_gl.transpose().to_cols_array_2d()
}
