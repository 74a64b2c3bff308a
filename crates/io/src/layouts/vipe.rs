//! What ViPE writes (<https://github.com/nv-tlabs/vipe>, `save_artifacts` of `vipe/utils/io.py`), of one video.
//!
//! ```text
//! pose/{name}.npz                      data [N, 4, 4], world from camera with OpenCV axes, of the frames inds [N]
//! intrinsics/{name}.npz                data [N, 4], fx, fy, cx, cy in pixels of the video, of the frames inds [N]
//! intrinsics/{name}_camera.txt         optional: each frame's camera; PINHOLE is read
//! rgb/{name}.mp4                       the frames, as a video that is not decoded here
//! rgb/{name}/00000.png, …              the same as pictures, one for each frame: the user's ffmpeg makes them
//! depth/{name}.zip                     optional: 00000.exr, …, z-depth in units of the poses
//! mask/{name}.zip                      optional: 00000.png, …, numbers of instances, 0 where there is none
//! mask/{name}.txt                      optional: what each instance is
//! ```
//!
//! It has no tracks: those of Shape-of-Motion's layout are read where they are beside it, under the pictures' names.

use std::collections::BTreeMap;
use std::path::Path;

use splat_core::Camera;

use crate::archive::for_each_entry;
use crate::bytes::read_file;
use crate::camera_model::Lens;
use crate::error::list_names;
use crate::exr::parse_depth_exr;
use crate::folder::{PICTURES, list};
use crate::npy::read_npz;
use crate::picture::{parse_labels, read_size};
use crate::plan::{DepthFile, Layout, MaskFile, Picture, Plan, PlannedFrame, PlannedView};
use crate::rotation::cam_from_world;
use crate::scene::TruthFolders;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions, Map};

pub(super) const LAYOUT: Layout = Layout {
    name: "ViPE",
    looks_for: &["pose/", "intrinsics/", "rgb/"],
    plan,
};

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let name = &the_video(root)?;
    let file = |folder: &str, ending: &str| root.join(folder).join(format!("{name}{ending}"));
    let (pose_at, intrinsics_at) = (file("pose", ".npz"), file("intrinsics", ".npz"));
    let poses = Rows::read(&pose_at, &[4, 4])?;
    check_cameras(&file("intrinsics", "_camera.txt"))?;
    let intrinsics = Rows::read(&intrinsics_at, &[4])?;

    let pictures_at = root.join("rgb").join(name);
    let pictures = list(&pictures_at, PICTURES)?;
    let stems = pictures.stems();
    if stems.is_empty() {
        return Err(no_pictures(&pictures_at, &file("rgb", ".mp4")));
    }
    let last = poses.rows.last_key_value().map_or(0, |(frame, _)| *frame);
    if stems.len() != last + 1 {
        let what = format!(
            "{} pictures, and {} has poses of frames up to {last}, counted from 0",
            stems.len(),
            pose_at.display()
        );
        return Err(IoError::names(&pictures_at, what));
    }

    let depth_at = file("depth", ".zip");
    let mut depth = read_depth(&depth_at)?;
    let masks_at = file("mask", ".zip");
    let mut notes = Vec::new();
    let mut masks = if options.static_scene {
        BTreeMap::new()
    } else {
        let still = sky(&file("mask", ".txt"))?;
        read_masks(&masks_at, &still, &mut notes)?
    };
    let mut frames = Vec::with_capacity(poses.rows.len());
    for (time, (&frame, pose)) in poses.rows.iter().enumerate() {
        let stem = &stems[frame];
        let image = pictures.files[stem].clone();
        let who = format!("frame {frame}");
        let Some(&[fx, fy, cx, cy]) = intrinsics.rows.get(&frame).map(Vec::as_slice) else {
            let what = format!("there is a pose of {who}, and no intrinsics");
            return Err(IoError::names(&intrinsics_at, what));
        };
        // The intrinsics are in pixels of the video, as depth is; pictures of it may be smaller.
        let depth = depth.remove(&frame);
        let (width, height) = match &depth {
            Some(depth) => (depth.width, depth.height),
            None => read_size(&image)?,
        };
        let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(f64::from);
        let camera = Camera::pinhole([width, height], [fx, fy], [cx, cy]);
        frames.push(PlannedFrame {
            view: PlannedView {
                name: stem.clone(),
                image: Picture::File(image),
                lens: Lens::pinhole(camera).checked(&who, &intrinsics_at)?,
                camera_file: intrinsics_at.clone(),
                cam_from_world: cam_from_world(pose).ok_or_else(|| {
                    IoError::malformed(&pose_at, format!("{who} has no rigid transform"))
                })?,
                time: time as f32,
            },
            depth: depth.map(|depth| DepthFile::Loaded {
                depth,
                archive: depth_at.clone(),
            }),
            mask: masks.remove(&frame).map(|mask| MaskFile::Loaded {
                mask,
                archive: masks_at.clone(),
            }),
        });
    }
    notes.push(
        "the centre in ViPE's intrinsics is taken to count from the picture's corner".to_owned(),
    );
    Ok(Plan {
        truth: TruthFolders::of(root),
        frames,
        test: Vec::new(),
        points: Vec::new(),
        depth_at,
        masks_at,
        inverted_masks: false,
        tracks: TrackFiles::new(&root.join("flow3d_preprocessed")),
        notes,
    })
}

/// The name of the one video whose poses are there.
fn the_video(root: &Path) -> Result<String, IoError> {
    let folder = root.join("pose");
    let names = list(&folder, &["npz"])?.stems();
    match &names[..] {
        [name] => Ok(name.clone()),
        [] => Err(IoError::missing(
            &folder,
            "poses: no .npz",
            "ViPE writes it where it is asked for artifacts",
        )),
        _ => {
            let names = list_names(&names);
            let what = format!(
                "{names} are several videos; give each a folder of its own (`vipe infer --output DIR`)"
            );
            Err(IoError::names(&folder, what))
        }
    }
}

/// That the frames are a video, or not there at all.
fn no_pictures(folder: &Path, video: &Path) -> IoError {
    if !video.is_file() {
        let what = "the frames: neither pictures nor a video beside them";
        return IoError::missing(folder, what, "ViPE writes rgb/NAME.mp4");
    }
    let quoted = |path: &Path| format!("'{}'", path.display().to_string().replace('\'', r"'\''"));
    let advice = format!(
        "videos are not decoded here, and this makes pictures of it: mkdir {} && ffmpeg -i {} -start_number 0 {}",
        quoted(folder),
        quoted(video),
        quoted(&folder.join("%05d.png")),
    );
    IoError::missing(folder, "the frames as pictures", advice)
}

/// Numbers of frames, by the frame's number in the video.
struct Rows {
    rows: BTreeMap<usize, Vec<f32>>,
}

impl Rows {
    /// Reads `data`, which has a row of this shape for each number in `inds`.
    fn read(path: &Path, shape: &[usize]) -> Result<Self, IoError> {
        let mut arrays = read_npz(path)?;
        let mut take = |name: &str| {
            let found = arrays.remove(name);
            found.ok_or_else(|| IoError::missing(path, name, "data and inds are expected"))
        };
        let (data, inds) = (take("data")?, take("inds")?);
        let count = inds.values.len();
        if inds.shape.len() != 1 || data.shape != [&[count], shape].concat() || count == 0 {
            let what = format!(
                "data has shape {:?} and inds {:?}; [N, …{shape:?}] and [N] are expected",
                data.shape, inds.shape
            );
            return Err(IoError::malformed(path, what));
        }
        let width = data.values.len() / count;
        let mut rows = BTreeMap::new();
        for (row, &number) in data.values.chunks_exact(width).zip(&inds.values) {
            // Beyond this, f32 does not tell numbers apart.
            let is_frame = (0.0..=1e7).contains(&number) && number.fract() == 0.0;
            if !is_frame || rows.insert(number as usize, row.to_vec()).is_some() {
                let what =
                    format!("inds holds {number}, which is no number of a frame, or twice there");
                return Err(IoError::malformed(path, what));
            }
        }
        Ok(Self { rows })
    }
}

/// The lines `NUMBER: TEXT` of a file, as numbers and texts; none where it is not there.
fn numbered_lines(path: &Path) -> Result<Vec<(usize, String)>, IoError> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = String::from_utf8(read_file(path)?)
        .map_err(|_| IoError::malformed(path, "the text is not UTF-8"))?;
    let mut lines = Vec::new();
    for (at, line) in text.lines().enumerate() {
        let parts = line.split_once(':');
        let parsed = parts.and_then(|(n, text)| Some((n.trim().parse().ok()?, text.trim())));
        let Some((number, text)) = parsed else {
            let what = format!("line {}: NUMBER: TEXT is expected", at + 1);
            return Err(IoError::malformed(path, what));
        };
        lines.push((number, text.to_owned()));
    }
    Ok(lines)
}

/// An error where a camera is no pinhole.
fn check_cameras(path: &Path) -> Result<(), IoError> {
    let cameras = numbered_lines(path)?;
    match cameras.iter().find(|(_, camera)| camera != "PINHOLE") {
        Some((frame, camera)) => {
            let what = format!(
                "frame {frame} has a {camera} camera, and PINHOLE alone is read; undistort the video, or run \
                 ViPE's default pipeline"
            );
            Err(IoError::malformed(path, what))
        }
        None => Ok(()),
    }
}

/// The depth of each frame.
fn read_depth(path: &Path) -> Result<BTreeMap<usize, Map>, IoError> {
    let mut maps = BTreeMap::new();
    if path.exists() {
        for_each_entry(path, ".exr", |name, data| {
            let depth = parse_depth_exr(&data, &path.join(format!("{name}.exr")))?;
            insert(&mut maps, name, depth, path)
        })?;
    }
    Ok(maps)
}

/// What ViPE took for movable in each frame, but for the instances that are `still`.
fn read_masks(
    path: &Path,
    still: &[usize],
    notes: &mut Vec<String>,
) -> Result<BTreeMap<usize, Map>, IoError> {
    let mut masks = BTreeMap::new();
    if !path.exists() {
        return Ok(masks);
    }
    for_each_entry(path, ".png", |name, data| {
        let ((width, height), labels) = parse_labels(&data, &path.join(format!("{name}.png")))?;
        let moves = |label: u8| label != 0 && !still.contains(&usize::from(label));
        let mask = Map {
            width,
            height,
            values: labels
                .iter()
                .map(|&l| f32::from(u8::from(moves(l))))
                .collect(),
        };
        insert(&mut masks, name, mask, path)
    })?;
    notes.push(
        "ViPE's masks show what could move (people, animals, vehicles and what else it was asked for), whether \
         it does or not: all of it but the sky is taken to move"
            .to_owned(),
    );
    Ok(masks)
}

/// The instances that are sky, which ViPE looks for beside what moves.
fn sky(path: &Path) -> Result<Vec<usize>, IoError> {
    let phrases = numbered_lines(path)?.into_iter();
    Ok(phrases
        .filter(|(_, phrase)| phrase == "sky")
        .map(|(instance, _)| instance)
        .collect())
}

/// Puts a frame's map where its entry's name says.
fn insert(
    maps: &mut BTreeMap<usize, Map>,
    name: &str,
    map: Map,
    archive: &Path,
) -> Result<(), IoError> {
    let frame = name.parse().ok();
    match frame.map(|frame: usize| maps.insert(frame, map)) {
        Some(None) => Ok(()),
        _ => {
            let what = format!("entry {name} is no number of a frame, or twice there");
            Err(IoError::malformed(archive, what))
        }
    }
}
