//! The file: what it says of all frames and of each.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use serde::Deserialize;
use serde_json::{Map, Value};
use splat_core::Camera;

use crate::IoError;
use crate::camera_model::{Distortion, Lens};
use crate::json::read_json;
use crate::picture::read_size;
use crate::plan::{Picture, PlannedView};
use crate::rotation::{camera_at, nearest_rotation};

#[derive(Deserialize)]
pub(super) struct Transforms {
    /// The file itself.
    #[serde(skip)]
    pub(super) path: PathBuf,
    /// All else: intrinsics.
    #[serde(flatten)]
    others: Map<String, Value>,
    pub(super) depth_unit_scale_factor: Option<f64>,
    pub(super) train_filenames: Option<Vec<String>>,
    pub(super) test_filenames: Option<Vec<String>>,
    pub(super) ply_file_path: Option<String>,
    pub(super) frames: Vec<Entry>,
}

/// A frame.
#[derive(Deserialize)]
pub(super) struct Entry {
    pub(super) file_path: String,
    pub(super) depth_file_path: Option<String>,
    pub(super) mask_path: Option<String>,
    pub(super) time: Option<f64>,
    pub(super) split: Option<String>,
    transform_matrix: Vec<Vec<f64>>,
    /// All else: intrinsics.
    #[serde(flatten)]
    others: Map<String, Value>,
}

impl Transforms {
    pub(super) fn read(path: PathBuf) -> Result<Self, IoError> {
        let transforms: Self = read_json(&path)?;
        Ok(Self { path, ..transforms })
    }

    /// The view of a frame with its own picture.
    pub(super) fn view(
        &self,
        root: &Path,
        entry: &Entry,
        name: String,
        time: f32,
    ) -> Result<PlannedView, IoError> {
        let image = root.join(&entry.file_path);
        Ok(PlannedView {
            name,
            lens: self
                .lens(entry, &image)?
                .checked(&entry.file_path, &self.path)?,
            image: Picture::File(image),
            camera_file: self.path.clone(),
            cam_from_world: cam_from_world(entry, &self.path)?,
            time,
        })
    }

    fn lens(&self, entry: &Entry, image: &Path) -> Result<Lens, IoError> {
        let path = &self.path;
        let is_there = |value: &&Value| !value.is_null();
        let find = |key: &str| {
            let own = entry.others.get(key).filter(is_there);
            own.or(self.others.get(key).filter(is_there))
        };
        let wrong = |key: &str, wanted: &str| {
            let what = format!("`{key}` of {} is not {wanted}", entry.file_path);
            IoError::malformed(path, what)
        };
        let get = |key: &str| -> Result<Option<f64>, IoError> {
            let number = |value: &Value| value.as_f64().ok_or_else(|| wrong(key, "a number"));
            find(key).map(number).transpose()
        };
        let or_zero = |key: &str| -> Result<f64, IoError> { Ok(get(key)?.unwrap_or(0.0)) };
        let side = |value: f64| (1.0..=1e6).contains(&value).then_some(value as usize);
        let (width, height) = match (get("w")?, get("h")?) {
            (Some(w), Some(h)) => side(w).zip(side(h)).ok_or_else(|| {
                IoError::malformed(path, format!("{} has w {w} and h {h}", entry.file_path))
            })?,
            _ => read_size(image)?,
        };
        let by_angle = |angle: f64| 0.5 * width as f64 / (0.5 * angle).tan();
        let Some(fx) = get("fl_x")?.or(get("camera_angle_x")?.map(by_angle)) else {
            let name = &entry.file_path;
            let what = format!("{name} has no fl_x, and there is none for all frames");
            return Err(IoError::malformed(path, what));
        };
        let model = match find("camera_model") {
            Some(value) => {
                let name = value.as_str();
                name.ok_or_else(|| wrong("camera_model", "a name"))?
            }
            None => "OPENCV",
        };
        let [k1, k2, k3, k4] = [
            or_zero("k1")?,
            or_zero("k2")?,
            or_zero("k3")?,
            or_zero("k4")?,
        ];
        let tangential = [or_zero("p1")?, or_zero("p2")?];
        let distortion = match model {
            "OPENCV_FISHEYE" => Distortion::Fisheye {
                k: [k1, k2, k3, k4],
            },
            "FULL_OPENCV" => Distortion::Radial {
                num: [k1, k2, k3, 0.0],
                den: [k4, or_zero("k5")?, or_zero("k6")?],
                tangential,
            },
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "RADIAL" | "SIMPLE_RADIAL" => {
                Distortion::Radial {
                    num: [k1, k2, k3, k4],
                    den: [0.0; 3],
                    tangential,
                }
            }
            other => {
                let what = "is not supported; undistort the images first";
                return Err(IoError::malformed(
                    path,
                    format!("camera model {other} {what}"),
                ));
            }
        };
        Ok(Lens {
            model: model.into(),
            camera: Camera::pinhole(
                [width, height],
                [fx, get("fl_y")?.unwrap_or(fx)],
                [
                    get("cx")?.unwrap_or(width as f64 / 2.0),
                    get("cy")?.unwrap_or(height as f64 / 2.0),
                ],
            ),
            distortion,
        })
    }
}

/// OpenCV's camera from world, of OpenGL's world from camera.
fn cam_from_world(entry: &Entry, path: &Path) -> Result<DAffine3, IoError> {
    let rows = &entry.transform_matrix;
    let usable = (3..=4).contains(&rows.len()) && rows.iter().all(|row| row.len() == 4);
    let no_pose = |why: &str| {
        let what = format!("transform_matrix of {} {why}", entry.file_path);
        Err(IoError::malformed(path, what))
    };
    if !usable {
        return no_pose("is not 4x4 or 3x4");
    }
    let column = |c: usize| DVec3::new(rows[0][c], rows[1][c], rows[2][c]);
    let matrix = DMat3::from_cols(column(0), column(1), column(2));
    let center = column(3);
    let last_row_wrong = rows.len() == 4 && rows[3] != [0.0, 0.0, 0.0, 1.0];
    if !matrix.is_finite() || !center.is_finite() || last_row_wrong {
        return no_pose("is no rigid transform");
    }
    let Some(rotation) = nearest_rotation(matrix) else {
        return no_pose("has no rotation in its first three columns (scaled or mirrored)");
    };
    // y and z change sign between the axes.
    let world_from_cam = DMat3::from_cols(rotation.x_axis, -rotation.y_axis, -rotation.z_axis);
    Ok(camera_at(center, world_from_cam))
}
