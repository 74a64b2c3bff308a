//! COLMAP sparse models, binary and text (<https://colmap.github.io/format.html>).

mod binary;
mod model;
mod text;

use std::path::{Path, PathBuf};

pub(crate) use model::Model;
#[cfg(test)]
pub(crate) use model::ModelImage;

use crate::{IoError, SparsePoint};

/// The folder under `colmap` that holds a model, if any.
pub(crate) fn find_model(colmap: &Path) -> Option<PathBuf> {
    let candidates = [colmap.join("sparse"), colmap.join("sparse/0")];
    candidates
        .into_iter()
        .find(|folder| folder.join("images.bin").is_file() || folder.join("images.txt").is_file())
}

/// Reads a model; where both are there, the binary form. A model without points is fine.
pub(crate) fn read_model(folder: &Path) -> Result<Model, IoError> {
    let points = read_points(folder)?;
    let (cameras_path, images_path) = (file(folder, "cameras"), file(folder, "images"));
    let (cameras, images) = if is_binary(folder) {
        (
            binary::read_cameras(&cameras_path)?,
            binary::read_images(&images_path)?,
        )
    } else {
        (
            text::read_cameras(&cameras_path)?,
            text::read_images(&images_path)?,
        )
    };
    Ok(Model {
        cameras,
        images,
        points,
        cameras_path,
        images_path,
    })
}

/// The points of a model alone, whatever its cameras are; none where it has no file of them.
pub(crate) fn read_points(folder: &Path) -> Result<Vec<SparsePoint>, IoError> {
    let path = file(folder, "points3D");
    match (path.is_file(), is_binary(folder)) {
        (false, _) => Ok(Vec::new()),
        (true, true) => binary::read_points(&path),
        (true, false) => text::read_points(&path),
    }
}

fn is_binary(folder: &Path) -> bool {
    folder.join("images.bin").is_file()
}

/// A model's file of this kind, in the form that it is read in.
fn file(folder: &Path, stem: &str) -> PathBuf {
    let extension = if is_binary(folder) { "bin" } else { "txt" };
    folder.join(format!("{stem}.{extension}"))
}
