//! COLMAP sparse models, binary and text (<https://colmap.github.io/format.html>).

mod binary;
mod model;
mod text;

use std::path::{Path, PathBuf};

pub(crate) use model::Model;
#[cfg(test)]
pub(crate) use model::ModelImage;

use crate::IoError;

/// The folder under `colmap` that holds a model, if any.
pub(crate) fn find_model(colmap: &Path) -> Option<PathBuf> {
    let candidates = [colmap.join("sparse"), colmap.join("sparse/0")];
    candidates
        .into_iter()
        .find(|folder| folder.join("images.bin").is_file() || folder.join("images.txt").is_file())
}

/// Reads a model; where both are there, the binary form. A model without points is fine.
pub(crate) fn read_model(folder: &Path) -> Result<Model, IoError> {
    let extension = if folder.join("images.bin").is_file() {
        "bin"
    } else {
        "txt"
    };
    let binary = extension == "bin";
    let file = |stem: &str| folder.join(format!("{stem}.{extension}"));
    let (cameras_path, images_path, points_path) =
        (file("cameras"), file("images"), file("points3D"));
    let points = match (points_path.is_file(), binary) {
        (false, _) => Vec::new(),
        (true, true) => binary::read_points(&points_path)?,
        (true, false) => text::read_points(&points_path)?,
    };
    let (cameras, images) = if binary {
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
