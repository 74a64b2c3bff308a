//! What MegaSaM writes (<https://github.com/mega-sam/mega-sam>, `cvd_opt/cvd_opt.py`): one archive,
//! `{scene}_sgd_cvd_hr.npz`, with pictures in it.
//!
//! - `images` u8 [N, H, W, 3], in the order of the video
//! - `depths` [N, H, W], z-depth in units of the poses
//! - `intrinsic` [3, 3], of all frames, in pixels of `images`
//! - `cam_c2w` [N, 4, 4], OpenCV axes
//!
//! The frames are called 00000, 00001, … It has neither masks nor tracks: those of Shape-of-Motion's
//! layout are read where they are beside it, under these names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use splat_core::Camera;

use crate::camera_model::Lens;
use crate::error::list_names;
use crate::folder::list;
use crate::npy::{Array, read_npz};
use crate::plan::{
    DepthFile, Layout, MaskFile, Picture, Plan, PlannedFrame, PlannedView, list_masks,
};
use crate::rotation::cam_from_world;
use crate::scene::TruthFolders;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions, Map};

const ENDING: &str = "_sgd_cvd_hr.npz";

pub(super) const LAYOUT: Layout = Layout {
    name: "MegaSaM",
    looks_for: &["*_sgd_cvd_hr.npz"],
    plan,
};

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let path = find_archive(root)?;
    let mut archive = Archive {
        arrays: read_npz(&path)?,
        path: &path,
    };
    let images = archive.take("images", 4)?;
    let [count, height, width, channels] = images.shape[..] else {
        return Err(archive.shaped("images", &images));
    };
    let depths = archive.take("depths", 3)?;
    let poses = archive.take("cam_c2w", 3)?;
    let intrinsic = archive.take("intrinsic", 2)?;
    if channels != 3 || count == 0 || height == 0 || width == 0 {
        return Err(archive.shaped("images", &images));
    }
    if depths.shape != [count, height, width] {
        return Err(archive.shaped("depths", &depths));
    }
    if poses.shape != [count, 4, 4] {
        return Err(archive.shaped("cam_c2w", &poses));
    }
    if intrinsic.shape != [3, 3] {
        return Err(archive.shaped("intrinsic", &intrinsic));
    }
    let is_byte = |v: &f32| (0.0..=255.0).contains(v) && v.fract() == 0.0;
    if !images.values.iter().all(is_byte) {
        let what = "images holds other numbers than 0 to 255";
        return Err(IoError::malformed(&path, what));
    }
    let k = |at: usize| f64::from(intrinsic.values[at]);
    let camera = Camera::pinhole([width, height], [k(0), k(4)], [k(2), k(5)]);
    let lens = Lens::pinhole(camera).checked("intrinsic", &path)?;

    let names: Vec<_> = (0..count).map(|i| format!("{i:05}")).collect();
    let masks_at = root.join("masks");
    let masks = list_masks(&masks_at, options)?.named_as(&names, &masks_at)?;
    let pixels = width * height;
    let parts = images.values.chunks_exact(3 * pixels);
    let parts = parts.zip(depths.values.chunks_exact(pixels));
    let parts = parts.zip(poses.values.chunks_exact(16)).zip(&names);
    let mut frames = Vec::with_capacity(count);
    for (i, (((image, depth), pose), name)) in parts.enumerate() {
        let depth = Map {
            width,
            height,
            values: depth.to_vec(),
        };
        frames.push(PlannedFrame {
            view: PlannedView {
                name: name.clone(),
                image: Picture::Loaded {
                    size: (width, height),
                    pixels: image.iter().map(|&v| v as u8).collect(),
                    archive: path.clone(),
                },
                lens: lens.clone(),
                camera_file: path.clone(),
                cam_from_world: cam_from_world(pose).ok_or_else(|| {
                    let what = format!("cam_c2w of frame {i} is no rigid transform");
                    IoError::malformed(&path, what)
                })?,
                time: i as f32,
            },
            depth: Some(DepthFile::Loaded {
                depth,
                archive: path.clone(),
            }),
            mask: masks.get(name).cloned().map(MaskFile::File),
        });
    }
    Ok(Plan {
        truth: TruthFolders::of(root),
        frames,
        test: Vec::new(),
        points: Vec::new(),
        depth_at: path.clone(),
        masks_at,
        inverted_masks: false,
        tracks: TrackFiles::new(&root.join("flow3d_preprocessed")),
        notes: vec![format!(
            "the frames of MegaSaM are called {} to {}; the centre in `intrinsic` is taken to count from the \
             picture's corner",
            names[0],
            names[count - 1]
        )],
    })
}

/// The one archive of the folder.
fn find_archive(root: &Path) -> Result<PathBuf, IoError> {
    let archives = list(root, &["npz"])?.files.into_values();
    let is_result = |p: &PathBuf| p.to_string_lossy().ends_with(ENDING);
    let mut archives: Vec<_> = archives.filter(is_result).collect();
    if archives.len() > 1 {
        let names = archives.iter().filter_map(|p| p.file_name()?.to_str());
        let names = list_names(&Vec::from_iter(names));
        let what = format!("{names} are several scenes; give each a folder of its own");
        return Err(IoError::names(root, what));
    }
    archives
        .pop()
        .ok_or_else(|| IoError::missing(root, format!("*{ENDING}"), "MegaSaM's cvd_opt writes it"))
}

struct Archive<'a> {
    arrays: BTreeMap<String, Array>,
    path: &'a Path,
}

impl Archive<'_> {
    fn take(&mut self, name: &str, sides: usize) -> Result<Array, IoError> {
        let advice = "images, depths, intrinsic and cam_c2w are expected";
        let found = self.arrays.remove(name);
        let array = found.ok_or_else(|| IoError::missing(self.path, name, advice))?;
        if array.shape.len() == sides {
            Ok(array)
        } else {
            Err(self.shaped(name, &array))
        }
    }

    fn shaped(&self, name: &str, array: &Array) -> IoError {
        let shape = &array.shape;
        let what = format!(
            "{name} has shape {shape:?}; images [N, H, W, 3], depths [N, H, W], intrinsic [3, 3] and \
             cam_c2w [N, 4, 4] are expected"
        );
        IoError::malformed(self.path, what)
    }
}
