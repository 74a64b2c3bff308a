//! DyCheck's layout, as its iPhone dataset has it
//! (<https://github.com/KAIR-BAIR/dycheck/blob/main/docs/DATASETS.md>).
//!
//! ```text
//! splits/train.json, val.json          frame_names and time_ids of the training frames and of the test views
//! camera/{frame}.json                  OpenCV axes, with distortion
//! rgb/{F}x/{frame}.png                 pictures, F times smaller than the cameras
//! covisible/{F}x/val/{frame}.png       optional: white where a test view shows what is seen in training
//! depth/{F}x/{frame}.npy               optional: z-depth [H, W, 1] in units of the poses, 0 = missing
//! flow3d_preprocessed/                 optional: what Shape-of-Motion's authors add
//!   track_anything/{F}x/{frame}.png    white where something moves
//!   2d_tracks/{F}x/{query}_{target}.npy
//!   colmap/sparse                      refined cameras, and with them
//!   aligned_depth_anything_colmap/{F}x/{frame}.npy  disparity in their units
//! ```
//!
//! Of the sizes in `rgb/` the largest pictures are read, and what has sizes is looked for at that one.

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use serde::Deserialize;
use splat_core::Camera;

use crate::camera_model::{Distortion, Lens};
use crate::colmap::{Model, find_model, read_model};
use crate::folder::{PICTURES, list, list_optional, stem_of};
use crate::json::read_json;
use crate::plan::{
    DepthFile, Layout, MaskFile, Picture, Plan, PlannedFrame, PlannedView, list_masks, time_between,
};
use crate::rotation::{camera_at, nearest_rotation};
use crate::scene::TruthFolders;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions};

pub(super) const LAYOUT: Layout = Layout {
    name: "DyCheck",
    looks_for: &["splits/train.json", "camera/", "rgb/"],
    plan,
};

/// `splits/{split}.json`.
#[derive(Default, Deserialize)]
struct Split {
    frame_names: Vec<String>,
    time_ids: Vec<u32>,
}

/// `camera/{frame}.json`.
#[derive(Deserialize)]
struct CameraFile {
    /// Rows of the rotation from the world to the camera.
    orientation: [[f64; 3]; 3],
    /// The camera's centre.
    position: [f64; 3],
    focal_length: f64,
    principal_point: [f64; 2],
    image_size: [u32; 2],
    #[serde(default)]
    skew: f64,
    #[serde(default = "one")]
    pixel_aspect_ratio: f64,
    #[serde(default)]
    radial_distortion: [f64; 3],
    /// Older files say `tangential`.
    #[serde(default, alias = "tangential")]
    tangential_distortion: [f64; 2],
}

fn one() -> f64 {
    1.0
}

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let mut notes = Vec::new();
    let size = largest_pictures(&root.join("rgb"))?;
    let training = read_split(&root.join("splits/train.json"))?;
    if training.is_empty() {
        let path = root.join("splits/train.json");
        let advice = "this split says which frames are for training";
        return Err(IoError::missing(&path, "training frames", advice));
    }
    if let Some(pair) = training.windows(2).find(|p| p[0].0 == p[1].0) {
        let what = format!(
            "{} and {} have the same time; one camera's video is expected",
            pair[0].1, pair[1].1
        );
        return Err(IoError::malformed(&root.join("splits/train.json"), what));
    }
    let val = root.join("splits/val.json");
    let test = if val.is_file() {
        read_split(&val)?
    } else {
        Vec::new()
    };

    let stems: Vec<_> = training.iter().map(|(_, name)| name.clone()).collect();
    let preprocessed = root.join("flow3d_preprocessed");
    let refined = Refined::find(&preprocessed)?;
    let aligned = preprocessed.join("aligned_depth_anything_colmap");
    let (depth_at, note) = match &refined {
        Some(_) => (
            aligned.join(&size),
            "cameras and depth are the refined ones of flow3d_preprocessed/, not those of camera/ and depth/",
        ),
        None => (
            root.join("depth").join(&size),
            "depth/ is taken to be in units of the poses, as DyCheck's code takes it",
        ),
    };
    notes.push(note.to_owned());
    let depth = list_optional(&depth_at, &["npy"])?.named_as(&stems, &depth_at)?;
    let masks_at = preprocessed.join("track_anything").join(&size);
    let masks = list_masks(&masks_at, options)?.named_as(&stems, &masks_at)?;

    let view = |name: &str, time: f32| -> Result<PlannedView, IoError> {
        let image = root.join("rgb").join(&size).join(format!("{name}.png"));
        match &refined {
            Some(refined) => refined.view(name, image, time),
            None => original_view(root, name, image, time),
        }
    };
    let mut frames = Vec::with_capacity(stems.len());
    for (i, name) in stems.iter().enumerate() {
        let depth = depth.get(name).cloned();
        frames.push(PlannedFrame {
            view: view(name, i as f32)?,
            depth: depth.map(|path| {
                if refined.is_some() {
                    DepthFile::Disparity(path)
                } else {
                    DepthFile::Depth { path, scale: 1.0 }
                }
            }),
            mask: masks.get(name).cloned().map(MaskFile::File),
        });
    }
    let instants: Vec<_> = training.iter().map(|&(time, _)| f64::from(time)).collect();
    let mut views = Vec::with_capacity(test.len());
    for (time, name) in &test {
        views.push(view(name, time_between(f64::from(*time), &instants))?);
    }
    if refined.is_none() && root.join("points.npy").is_file() {
        notes.push("points.npy is not read: its points have no colours".into());
    }
    let mut truth = TruthFolders::of(root);
    let covisible = root.join("covisible").join(&size).join("val");
    let seen = list(&covisible, PICTURES)?.files;
    if test.iter().any(|(_, name)| !seen.contains_key(name)) {
        notes.push(format!(
            "covisible/{size}/val/ has no picture for each test view: not read"
        ));
    } else if !test.is_empty() {
        truth.covisible = covisible;
    }
    Ok(Plan {
        truth,
        frames,
        test: views,
        points: refined.map_or_else(Vec::new, |refined| refined.0.points),
        depth_at,
        masks_at,
        inverted_masks: false,
        tracks: TrackFiles::in_folder(preprocessed.join("2d_tracks").join(&size)),
        notes,
    })
}

/// The folder of `rgb/` with the largest pictures, such as `1x`.
fn largest_pictures(rgb: &Path) -> Result<String, IoError> {
    let access = |e| IoError::access(rgb, e);
    let mut factors = Vec::new();
    for entry in std::fs::read_dir(rgb).map_err(access)? {
        let entry = entry.map_err(access)?;
        let name = entry.file_name();
        let factor = name.to_str().and_then(|n| n.strip_suffix('x'));
        factors.extend(factor.and_then(|f| f.parse::<u32>().ok()));
    }
    let smallest = factors.into_iter().min();
    smallest.map(|factor| format!("{factor}x")).ok_or_else(|| {
        let advice = "they are named after how many times smaller their pictures are";
        IoError::missing(rgb, "folders 1x, 2x, …", advice)
    })
}

/// Times and names of a split, in the order of time.
fn read_split(path: &Path) -> Result<Vec<(u32, String)>, IoError> {
    let split: Split = read_json(path)?;
    let (names, times) = (split.frame_names.len(), split.time_ids.len());
    if names != times {
        let what = format!("{names} frame_names and {times} time_ids; there is one time a frame");
        return Err(IoError::malformed(path, what));
    }
    let mut frames: Vec<_> = split.time_ids.into_iter().zip(split.frame_names).collect();
    frames.sort();
    Ok(frames)
}

/// The view of a frame by its own camera file.
fn original_view(
    root: &Path,
    name: &str,
    image: PathBuf,
    time: f32,
) -> Result<PlannedView, IoError> {
    let path = root.join("camera").join(format!("{name}.json"));
    let file: CameraFile = read_json(&path)?;
    let malformed = |what: String| IoError::malformed(&path, what);
    if file.skew.abs() > 1e-9 {
        return Err(malformed(format!("skew {} is not supported", file.skew)));
    }
    // Its rows are the columns of the way back.
    let [x, y, z] = file.orientation.map(DVec3::from_array);
    let world_from_cam = nearest_rotation(DMat3::from_cols(x, y, z))
        .ok_or_else(|| malformed("orientation is no rotation".into()))?;
    let position = DVec3::from_array(file.position);
    if !position.is_finite() {
        return Err(malformed("position is not finite".into()));
    }
    let [width, height] = file.image_size.map(|side| side as usize);
    let [k1, k2, k3] = file.radial_distortion;
    let lens = Lens {
        model: "DyCheck".into(),
        camera: Camera::pinhole(
            [width, height],
            [
                file.focal_length,
                file.focal_length * file.pixel_aspect_ratio,
            ],
            file.principal_point,
        ),
        distortion: Distortion::Radial {
            num: [k1, k2, k3, 0.0],
            den: [0.0; 3],
            tangential: file.tangential_distortion,
        },
    };
    Ok(PlannedView {
        name: name.into(),
        image: Picture::File(image),
        lens: lens.checked(name, &path)?,
        camera_file: path,
        cam_from_world: camera_at(position, world_from_cam),
        time,
    })
}

/// Shape-of-Motion's refined cameras, whose model names the frames.
struct Refined(Model);

impl Refined {
    fn find(preprocessed: &Path) -> Result<Option<Self>, IoError> {
        let model = find_model(&preprocessed.join("colmap"));
        model
            .map(|folder| read_model(&folder).map(Self))
            .transpose()
    }

    fn view(&self, name: &str, image: PathBuf, time: f32) -> Result<PlannedView, IoError> {
        let model = &self.0;
        let mut images = model.images.iter();
        let posed = images.find(|i| stem_of(&i.name) == name).ok_or_else(|| {
            IoError::names(
                &model.images_path,
                format!("no camera for the frame {name}"),
            )
        })?;
        model.view(posed, name, image, time)
    }
}
