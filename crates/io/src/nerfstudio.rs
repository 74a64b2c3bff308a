//! nerfstudio's `transforms.json` (<https://docs.nerf.studio/quickstart/data_conventions.html>).
//!
//! - Poses are camera-to-world with OpenGL axes (x right, y up, z back); they become OpenCV's.
//! - Intrinsics stand at the top or on a frame, where they win.
//! - `depth_file_path`: a 16-bit PNG or an array, in units of `depth_unit_scale_factor` (0.001).
//! - `mask_path`: in this format black pixels are to be left out. What has to be left out of a static
//!   reconstruction is what moves, so **black is dynamic** and everything else is static.
//! - The split is `split` on each frame, or `train_filenames` and `test_filenames`.
//! - The format has no tracks; those of the other layout are read where they are there, under the
//!   frames' file stems.
//! - Training frames are ordered by `time`, without it by file name. A training frame's time is its
//!   index. A test view's is interpolated between the training frames' `time`; without it, a test view
//!   has the time of the training frame of the same file name, else it lies half-way between its
//!   neighbours in the order of names.

use std::collections::BTreeSet;
use std::path::Path;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::Deserialize;
use splat_core::Camera;

use crate::bytes::read_file;
use crate::camera_model::{Distortion, Lens};
use crate::error::list_names;
use crate::folder::{natural_order, stem_of};
use crate::picture::read_size;
use crate::scene::{DepthFile, Plan, PlannedFrame, PlannedView};
use crate::shape_of_motion::other_images;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions, SceneFormat, ply};

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    intrinsics: Intrinsics,
    depth_unit_scale_factor: Option<f64>,
    train_filenames: Option<Vec<String>>,
    test_filenames: Option<Vec<String>>,
    ply_file_path: Option<String>,
    frames: Vec<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    file_path: String,
    depth_file_path: Option<String>,
    mask_path: Option<String>,
    time: Option<f64>,
    split: Option<String>,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

#[derive(Clone, Default, Deserialize)]
struct Intrinsics {
    camera_model: Option<String>,
    camera_angle_x: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

pub(crate) fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let path = root.join("transforms.json");
    let data = read_file(&path)?;
    let transforms: Transforms = serde_json::from_slice(&data)
        .map_err(|e| IoError::malformed(&path, format!("not nerfstudio's transforms.json: {e}")))?;
    let scale = transforms.depth_unit_scale_factor.unwrap_or(1e-3);
    if !scale.is_finite() || scale <= 0.0 {
        let what = format!("depth_unit_scale_factor is {scale}");
        return Err(IoError::malformed(&path, what));
    }

    let mut notes = Vec::new();
    let (mut training, mut test) = split(&transforms, &path, &mut notes)?;
    let by_name = |a: &&Entry, b: &&Entry| natural_order(&a.file_path, &b.file_path);
    training.sort_by(by_name);
    test.sort_by(by_name);
    let test_times = order_by_time(&mut training, &test, &path)?;
    let dynamic = training.iter().any(|e| e.mask_path.is_some()) && !options.static_scene;
    let has_depth = all_or_none(&training, "depth_file_path", |e| &e.depth_file_path, &path)?;
    let has_masks = all_or_none(&training, "mask_path", |e| &e.mask_path, &path)?;
    if has_masks && dynamic {
        notes.push("mask_path, as in nerfstudio: black pixels are what moves".into());
    }

    let names = names(&training, &path)?;
    let images = match &options.images {
        None => training.iter().map(|e| root.join(&e.file_path)).collect(),
        Some(other) => other_images(&root.join(other), &names, &mut notes)?,
    };
    let mut frames = Vec::with_capacity(training.len());
    for (i, (entry, image)) in training.iter().zip(images).enumerate() {
        let mut view = view(root, &path, &transforms, entry, names[i].clone(), i as f32)?;
        view.image = image;
        frames.push(PlannedFrame {
            view,
            depth: has_depth.then(|| DepthFile::Depth {
                path: root.join(entry.depth_file_path.as_deref().unwrap_or_default()),
                scale,
            }),
            mask: entry.mask_path.as_ref().map(|mask| root.join(mask)),
        });
    }
    let mut views = Vec::with_capacity(test.len());
    for ((entry, name), time) in test.iter().zip(self::names(&test, &path)?).zip(test_times) {
        views.push(view(root, &path, &transforms, entry, name, time)?);
    }
    let points = match &transforms.ply_file_path {
        Some(file) => ply::read_points(&root.join(file))?,
        None => Vec::new(),
    };
    Ok(Plan {
        format: SceneFormat::Nerfstudio,
        frames,
        test: views,
        points,
        inverted_masks: true,
        masks_at: path,
        tracks: TrackFiles::new(&root.join("flow3d_preprocessed")),
        notes,
    })
}

/// File stems; whole paths where a stem is there twice.
fn names(entries: &[&Entry], path: &Path) -> Result<Vec<String>, IoError> {
    let are_unique = |names: &[String]| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    let stems: Vec<_> = entries
        .iter()
        .map(|e| stem_of(&e.file_path).to_string())
        .collect();
    if are_unique(&stems) {
        return Ok(stems);
    }
    let whole = |e: &&Entry| {
        let path = e.file_path.trim_start_matches("./");
        let without = path.rsplit_once('.').map_or(path, |(front, _)| front);
        without.replace(['/', '\\'], "_")
    };
    let names: Vec<_> = entries.iter().map(whole).collect();
    if !are_unique(&names) {
        let what = "two frames have the same file_path but for its ending or its separators";
        return Err(IoError::names(path, what));
    }
    Ok(names)
}

/// Training frames and test views.
fn split<'a>(
    transforms: &'a Transforms,
    path: &Path,
    notes: &mut Vec<String>,
) -> Result<(Vec<&'a Entry>, Vec<&'a Entry>), IoError> {
    let entries = &transforms.frames;
    let known: BTreeSet<_> = entries.iter().map(|e| e.file_path.as_str()).collect();
    if known.len() != entries.len() {
        return Err(IoError::malformed(
            path,
            "two frames have the same file_path",
        ));
    }
    let (to_train, to_test) = (&transforms.train_filenames, &transforms.test_filenames);
    let listed = |list: &Option<Vec<String>>| -> Result<BTreeSet<String>, IoError> {
        let names: BTreeSet<_> = list.iter().flatten().cloned().collect();
        match names.iter().find(|n| !known.contains(n.as_str())) {
            Some(name) => Err(IoError::names(
                path,
                format!("{name} is in train_filenames or test_filenames, and no frame has it"),
            )),
            None => Ok(names),
        }
    };
    let (in_train, in_test) = (listed(to_train)?, listed(to_test)?);
    if let Some(both) = in_train.intersection(&in_test).next() {
        let what = format!("{both} is in train_filenames and in test_filenames");
        return Err(IoError::names(path, what));
    }

    let (mut training, mut test, mut skipped) = (Vec::new(), Vec::new(), 0);
    for entry in entries {
        let name = &entry.file_path;
        let by_list = match (in_train.contains(name), in_test.contains(name)) {
            (true, _) => Some("train"),
            (_, true) => Some("test"),
            // With one list, the rest is the other part; with two, it is neither.
            _ if to_train.is_some() && to_test.is_some() => Some("neither"),
            _ if to_train.is_some() => Some("test"),
            _ if to_test.is_some() => Some("train"),
            _ => None,
        };
        let by_frame = entry.split.as_deref();
        if let (Some(a), Some(b)) = (by_frame, by_list)
            && a != b
        {
            let what = format!("{name} has split {a}, and by the lists of files it is {b}");
            return Err(IoError::names(path, what));
        }
        match by_frame.or(by_list).unwrap_or("train") {
            "train" => training.push(entry),
            "test" => test.push(entry),
            "val" | "neither" => skipped += 1,
            other => {
                let what = format!("{name} has split {other}; train, test or val is expected");
                return Err(IoError::malformed(path, what));
            }
        }
    }
    if skipped > 0 {
        notes.push(format!(
            "{skipped} frames are neither for training nor for testing: skipped"
        ));
    }
    if training.is_empty() {
        return Err(IoError::missing(
            path,
            "training frames",
            "give some frames the split train",
        ));
    }
    Ok((training, test))
}

/// Whether the frames have this file; that some have it and others not is an error.
fn all_or_none(
    entries: &[&Entry],
    key: &str,
    get: impl Fn(&Entry) -> &Option<String>,
    path: &Path,
) -> Result<bool, IoError> {
    let without: Vec<_> = entries
        .iter()
        .filter(|e| get(e).is_none())
        .map(|e| e.file_path.as_str())
        .collect();
    if without.is_empty() || without.len() == entries.len() {
        return Ok(without.is_empty());
    }
    Err(IoError::missing(
        path,
        format!("{key} of {}", list_names(&without)),
        "give it to every training frame or to none",
    ))
}

/// Sorts the training frames by `time` where there is one, and gives the test views' times.
fn order_by_time(
    training: &mut [&Entry],
    test: &[&Entry],
    path: &Path,
) -> Result<Vec<f32>, IoError> {
    let without = || training.iter().chain(test).filter(|e| e.time.is_none());
    let total = training.len() + test.len();
    if without().count() != 0 && without().count() != total {
        let names: Vec<_> = without().map(|e| e.file_path.as_str()).collect();
        return Err(IoError::missing(
            path,
            format!("time of {}", list_names(&names)),
            "give it to every frame or to none",
        ));
    }
    let far = |e: &&&Entry| e.time.is_some_and(|t| t.abs() > f64::from(f32::MAX));
    if let Some(entry) = training.iter().chain(test).find(far) {
        let what = format!("{} has time {:?}", entry.file_path, entry.time);
        return Err(IoError::malformed(path, what));
    }
    let times: Vec<f64> = training.iter().filter_map(|e| e.time).collect();
    let all_the_same = times.iter().all(|t| *t == times[0]);
    if times.is_empty() || (all_the_same && training.len() > 1) {
        return Ok(test.iter().map(|e| time_by_name(e, training)).collect());
    }

    // JSON has no NaN, so the order is total.
    training.sort_by(|a, b| {
        a.time
            .partial_cmp(&b.time)
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    if let Some(pair) = training.windows(2).find(|p| p[0].time == p[1].time) {
        let (a, b) = (&pair[0].file_path, &pair[1].file_path);
        let what = format!("{a} and {b} have the same time; one camera's video is expected");
        return Err(IoError::malformed(path, what));
    }
    let times: Vec<f64> = training.iter().filter_map(|e| e.time).collect();
    Ok(test
        .iter()
        .filter_map(|e| e.time)
        .map(|t| interpolate(t, &times))
        .collect())
}

/// Position of `t` among ascending times, clamped to the training frames.
fn interpolate(t: f64, times: &[f64]) -> f32 {
    let after = times.partition_point(|&s| s < t);
    if after == 0 {
        return 0.0;
    }
    if after == times.len() {
        return (times.len() - 1) as f32;
    }
    let (a, b) = (times[after - 1], times[after]);
    ((after - 1) as f64 + (t - a) / (b - a)) as f32
}

fn time_by_name(view: &Entry, training: &[&Entry]) -> f32 {
    let stem = stem_of(&view.file_path);
    let order = |e: &&Entry| natural_order(stem_of(&e.file_path), stem);
    let after = training.iter().filter(|e| order(e).is_lt()).count();
    if training.iter().any(|e| order(e).is_eq()) {
        return after as f32;
    }
    (after as f32 - 0.5).clamp(0.0, (training.len() - 1) as f32)
}

fn view(
    root: &Path,
    path: &Path,
    transforms: &Transforms,
    entry: &Entry,
    name: String,
    time: f32,
) -> Result<PlannedView, IoError> {
    let image = root.join(&entry.file_path);
    let lens = lens(&transforms.intrinsics, entry, &image, path)?;
    Ok(PlannedView {
        name,
        image,
        camera: lens.into_pinhole(path)?,
        camera_file: path.into(),
        cam_from_world: pose(entry, path)?,
        time,
    })
}

fn lens(global: &Intrinsics, entry: &Entry, image: &Path, path: &Path) -> Result<Lens, IoError> {
    let own = &entry.intrinsics;
    let get = |key: fn(&Intrinsics) -> Option<f64>| key(own).or(key(global));
    let or_zero = |key: fn(&Intrinsics) -> Option<f64>| get(key).unwrap_or(0.0);
    let side = |value: f64| (1.0..=1e6).contains(&value).then_some(value as usize);
    let (width, height) = match (get(|i| i.w), get(|i| i.h)) {
        (Some(w), Some(h)) => side(w).zip(side(h)).ok_or_else(|| {
            IoError::malformed(path, format!("{} has w {w} and h {h}", entry.file_path))
        })?,
        _ => read_size(image)?,
    };
    let by_angle = |angle: f64| 0.5 * width as f64 / (0.5 * angle).tan();
    let Some(fx) = get(|i| i.fl_x).or(get(|i| i.camera_angle_x).map(by_angle)) else {
        return Err(IoError::malformed(
            path,
            format!(
                "{} has no fl_x, and there is none for all frames",
                entry.file_path
            ),
        ));
    };
    let model = own.camera_model.clone().or(global.camera_model.clone());
    let model = model.unwrap_or_else(|| "OPENCV".into());
    let [k1, k2, k3, k4] = [
        or_zero(|i| i.k1),
        or_zero(|i| i.k2),
        or_zero(|i| i.k3),
        or_zero(|i| i.k4),
    ];
    let tangential = [or_zero(|i| i.p1), or_zero(|i| i.p2)];
    let distortion = match model.as_str() {
        "OPENCV_FISHEYE" => Distortion::Fisheye {
            k: [k1, k2, k3, k4],
        },
        "FULL_OPENCV" => Distortion::Radial {
            num: [k1, k2, k3, 0.0],
            den: [k4, or_zero(|i| i.k5), or_zero(|i| i.k6)],
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
            return Err(IoError::malformed(
                path,
                format!("camera model {other} is not supported; undistort the images first"),
            ));
        }
    };
    Ok(Lens {
        model,
        camera: Camera::pinhole(
            width,
            height,
            fx,
            get(|i| i.fl_y).unwrap_or(fx),
            get(|i| i.cx).unwrap_or(width as f64 / 2.0),
            get(|i| i.cy).unwrap_or(height as f64 / 2.0),
        ),
        distortion,
    })
}

/// OpenCV's camera from world, of OpenGL's world from camera.
fn pose(entry: &Entry, path: &Path) -> Result<DAffine3, IoError> {
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
    let rotation = DMat3::from_cols(column(0), column(1), column(2));
    let center = column(3);
    let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
    let off = excess
        .to_cols_array()
        .iter()
        .fold(0.0, |m: f64, v| m.max(v.abs()));
    let last_row_wrong = rows.len() == 4 && rows[3] != [0.0, 0.0, 0.0, 1.0];
    if !rotation.is_finite() || !center.is_finite() || last_row_wrong {
        return no_pose("is no rigid transform");
    }
    if off > 1e-2 || rotation.determinant() <= 0.0 {
        return no_pose("has no rotation in its first three columns (scaled or mirrored)");
    }
    // Rounded numbers in the file: the nearest rotation is taken. y and z change sign between the axes.
    let rotation = DMat3::from_quat(DQuat::from_mat3(&rotation).normalize());
    let world_from_cam = DMat3::from_cols(rotation.x_axis, -rotation.y_axis, -rotation.z_axis);
    let cam_from_world = world_from_cam.transpose();
    Ok(DAffine3::from_mat3_translation(
        cam_from_world,
        -(cam_from_world * center),
    ))
}
