//! COLMAP's sparse model as text (<https://colmap.github.io/format.html#text-format>).

use std::fmt::Write as _;
use std::path::Path;

use glam::DQuat;

use super::view::{ExportedView, check};
use crate::{IoError, SparsePoint, write_atomic};

/// Writes cameras and points as `cameras.txt`, `images.txt` and `points3D.txt` into a folder, each atomically. Views with the same
/// intrinsics share a camera. Points have no tracks.
///
/// # Errors
/// [`IoError::Invalid`] for a file's name with a space or a line's end in it, which the format cannot hold;
/// [`IoError::NotANumber`]; [`IoError::Access`].
pub fn write_colmap(
    folder: &Path,
    views: &[ExportedView],
    points: &[SparsePoint],
) -> Result<(), IoError> {
    let mut cameras: Vec<[f64; 6]> = Vec::new();
    let images_path = folder.join("images.txt");
    let mut images = String::from(
        "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line without 2D points\n",
    );
    for (index, view) in views.iter().enumerate() {
        check(view, &images_path)?;
        if view.file.is_empty() || view.file.contains(char::is_whitespace) {
            let what = format!("a COLMAP text model cannot hold the name '{}'", view.file);
            return Err(IoError::invalid(&images_path, what));
        }
        let c = &view.camera;
        let camera = [c.width as f64, c.height as f64, c.fx, c.fy, c.cx, c.cy];
        let known = cameras.iter().position(|other| *other == camera);
        let known = known.unwrap_or_else(|| {
            cameras.push(camera);
            cameras.len() - 1
        });
        let quat = DQuat::from_mat3(&view.cam_from_world.matrix3).normalize();
        let t = view.cam_from_world.translation;
        line(
            &mut images,
            format_args!(
                "{} {} {} {} {} {} {} {} {} {}\n",
                index + 1,
                quat.w,
                quat.x,
                quat.y,
                quat.z,
                t.x,
                t.y,
                t.z,
                known + 1,
                view.file
            ),
        );
    }
    let mut lenses = String::from("# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n");
    for (index, [width, height, fx, fy, cx, cy]) in cameras.iter().enumerate() {
        let id = index + 1;
        line(
            &mut lenses,
            format_args!("{id} PINHOLE {width} {height} {fx} {fy} {cx} {cy}"),
        );
    }
    let points_path = folder.join("points3D.txt");
    let mut cloud = String::from("# POINT3D_ID X Y Z R G B ERROR, without a track\n");
    for (index, point) in points.iter().enumerate() {
        if !point.position.is_finite() {
            let what = format!("point {index}");
            return Err(IoError::not_a_number(&points_path, what, "leave it out"));
        }
        let [x, y, z] = point.position.to_array();
        let [r, g, b] = point.color_bytes();
        line(
            &mut cloud,
            format_args!("{} {x} {y} {z} {r} {g} {b} 0", index + 1),
        );
    }
    let files = [
        (folder.join("cameras.txt"), lenses),
        (images_path, images),
        (points_path, cloud),
    ];
    for (path, text) in files {
        write_atomic(&path, |out| out.write_all(text.as_bytes()))?;
    }
    Ok(())
}

fn line(text: &mut String, content: std::fmt::Arguments<'_>) {
    writeln!(text, "{content}").expect("a string takes text");
}
