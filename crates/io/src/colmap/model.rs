//! A sparse model, and what both of its forms have in common.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DQuat, DVec3};
use splat_core::Camera;

use crate::camera_model::{Distortion, Lens};
use crate::plan::{Picture, PlannedView};
use crate::{IoError, SparsePoint};

/// What is used of a sparse model.
pub(crate) struct Model {
    pub(crate) cameras: BTreeMap<u32, Lens>,
    pub(crate) images: Vec<ModelImage>,
    pub(crate) points: Vec<SparsePoint>,
    /// The file with the cameras, for messages.
    pub(crate) cameras_path: PathBuf,
    /// The file with the images, for messages.
    pub(crate) images_path: PathBuf,
}

impl Model {
    /// The view of one of its images. The numbers of cameras that no view has may be what they like; their kinds have to be
    /// known, for a binary file cannot be read on past a camera of another.
    pub(crate) fn view(
        &self,
        posed: &ModelImage,
        name: &str,
        image: PathBuf,
        time: f32,
    ) -> Result<PlannedView, IoError> {
        let lens = self.cameras.get(&posed.camera_id).ok_or_else(|| {
            let (name, id) = (&posed.name, posed.camera_id);
            let what = format!("image {name} has camera {id}, which is not there");
            IoError::malformed(&self.images_path, what)
        })?;
        let who = format!("camera {}", posed.camera_id);
        Ok(PlannedView {
            name: name.into(),
            image: Picture::File(image),
            lens: lens.clone().checked(&who, &self.cameras_path)?,
            camera_file: self.cameras_path.clone(),
            cam_from_world: posed.cam_from_world,
            time,
        })
    }
}

/// One posed image of a model.
pub(crate) struct ModelImage {
    pub(crate) name: String,
    pub(crate) camera_id: u32,
    pub(crate) cam_from_world: DAffine3,
}

/// COLMAP's camera models that end in a formula we know: id, name, number of parameters.
const MODELS: [(i32, &str, usize); 10] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
];

/// The name and number of parameters of a model, by COLMAP's number.
pub(super) fn model_by_id(id: i32, path: &Path) -> Result<(&'static str, usize), IoError> {
    MODELS
        .iter()
        .find(|m| m.0 == id)
        .map(|m| (m.1, m.2))
        .ok_or_else(|| unknown_model(&format!("number {id}"), path))
}

fn unknown_model(model: &str, path: &Path) -> IoError {
    IoError::malformed(
        path,
        format!(
            "camera model {model} is not supported; undistort the images first \
             (for example `colmap image_undistorter`)"
        ),
    )
}

/// A camera from its file's parameters.
pub(super) fn lens(
    model: &str,
    size: (u64, u64),
    params: &[f64],
    path: &Path,
) -> Result<Lens, IoError> {
    let known = MODELS.iter().find(|m| m.1 == model);
    let Some(&(_, _, count)) = known else {
        return Err(unknown_model(model, path));
    };
    if params.len() != count {
        return Err(IoError::malformed(
            path,
            format!("{model} has {count} parameters, {} are there", params.len()),
        ));
    }
    let (Ok(width), Ok(height)) = (u32::try_from(size.0), u32::try_from(size.1)) else {
        return Err(IoError::malformed(
            path,
            format!("camera has size {}x{}", size.0, size.1),
        ));
    };
    let two_focals = matches!(
        model,
        "PINHOLE" | "OPENCV" | "OPENCV_FISHEYE" | "FULL_OPENCV" | "FOV"
    );
    let (focal, rest) = if two_focals {
        ((params[0], params[1]), &params[2..])
    } else {
        ((params[0], params[0]), &params[1..])
    };
    let (center, k) = ((rest[0], rest[1]), &rest[2..]);
    let at = |i: usize| k.get(i).copied().unwrap_or(0.0);
    let radial = |num: [f64; 4], den, tangential| Distortion::Radial {
        num,
        den,
        tangential,
    };
    let distortion = match model {
        "SIMPLE_RADIAL" | "RADIAL" => radial([at(0), at(1), 0.0, 0.0], [0.0; 3], [0.0; 2]),
        "OPENCV" => radial([at(0), at(1), 0.0, 0.0], [0.0; 3], [at(2), at(3)]),
        "FULL_OPENCV" => radial(
            [at(0), at(1), at(4), 0.0],
            [at(5), at(6), at(7)],
            [at(2), at(3)],
        ),
        "OPENCV_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => Distortion::Fisheye {
            k: [at(0), at(1), at(2), at(3)],
        },
        "FOV" => Distortion::Fov { omega: at(0) },
        _ => Distortion::NONE,
    };
    Ok(Lens {
        model: model.into(),
        camera: Camera::pinhole(
            [width as usize, height as usize],
            [focal.0, focal.1],
            [center.0, center.1],
        ),
        distortion,
    })
}

/// A camera's pose from COLMAP's quaternion (w, x, y, z) and translation; both are camera from world.
pub(super) fn cam_from_world(
    quat: [f64; 4],
    translation: [f64; 3],
    name: &str,
    path: &Path,
) -> Result<DAffine3, IoError> {
    let [w, x, y, z] = quat;
    let quat = DQuat::from_xyzw(x, y, z, w);
    let translation = DVec3::from_array(translation);
    // The length is infinite where squares overflow.
    if !translation.is_finite() || !(1e-6..f64::INFINITY).contains(&quat.length()) {
        return Err(IoError::malformed(
            path,
            format!("image {name} has no usable camera pose"),
        ));
    }
    Ok(DAffine3::from_mat3_translation(
        DMat3::from_quat(quat.normalize()),
        translation,
    ))
}

/// A point, if its position is a position.
pub(super) fn point(position: [f64; 3], rgb: [u8; 3], path: &Path) -> Result<SparsePoint, IoError> {
    let position = DVec3::from_array(position);
    if !position.is_finite() {
        return Err(IoError::not_a_number(
            path,
            "a point's position",
            "make the model again, or leave the point out",
        ));
    }
    Ok(SparsePoint {
        position,
        color: rgb.map(|c| f32::from(c) / 255.0),
    })
}
