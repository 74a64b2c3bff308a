//! The stereo blur dataset as DyBluRF's authors publish it
//! (<https://github.com/huiqiang-sun/DyBluRF#dataset>), and as MoBGS's authors preprocessed it
//! (<https://github.com/KAIST-VICLab/MoBGS>, `readStereoCameras`).
//!
//! ```text
//! poses_bounds.npy                     [2 N, 17], LLFF: row 2 i is the left camera at instant i, row 2 i + 1 the right one
//! images/ or images_512x288/           training frames, left; the smaller ones are read where they are there
//! inference_images/                    test views, right
//! sharp_images/                        optional: truth of the training frames
//! motion_masks/                        optional: white where something moves
//! sparse/                              optional: the COLMAP model that poses_bounds.npy is from; its points are read
//! disp/                                not read: relative disparity
//!
//! of MoBGS, in the pixels of images_512x288:
//! align_uni_depth_noclip/{frame}.npy   z-depth [H, W] in units of the poses
//! motion_masks_manual/                 in the place of motion_masks/
//! bootstapir/{query}_{target}.npy      tracks
//! ```

use std::path::{Path, PathBuf};

use super::stereo::{CENTERED, Cameras, points, truth};
use crate::folder::{Listing, PICTURES, list, list_optional};
use crate::plan::{DepthFile, Layout, MaskFile, Plan, PlannedFrame, list_masks};
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions};

pub(super) const LAYOUT: Layout = Layout {
    name: "DyBluRF",
    looks_for: &["poses_bounds.npy", "inference_images/"],
    plan,
};

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let mut notes = Vec::new();
    let (images_at, images) = training_pictures(root)?;
    let stems = images.stems();
    let cameras = Cameras::read(root.join("poses_bounds.npy"))?;
    cameras.reach(stems.len(), &images_at)?;
    // The authors take the first cameras where there are more than pictures.
    if stems.len() < cameras.instants() {
        notes.push(format!(
            "poses_bounds.npy has {} instants for {} frames: the first ones are theirs",
            cameras.instants(),
            stems.len()
        ));
    }

    let depth_at = root.join("align_uni_depth_noclip");
    let depth = list_optional(&depth_at, &["npy"])?.named_as(&stems, &depth_at)?;
    if depth.is_empty() && root.join("disp").is_dir() {
        notes.push(
            "disp/ is not read: its disparity is relative, and nothing says by which scale and shift".into(),
        );
    }
    let masks = ["motion_masks_manual", "motion_masks"].map(|name| root.join(name));
    let masks_at = masks.iter().find(|folder| folder.is_dir());
    let masks_at = masks_at.unwrap_or(&masks[1]).clone();
    let masks = list_masks(&masks_at, options)?.named_as(&stems, &masks_at)?;

    let mut frames = Vec::with_capacity(stems.len());
    for (i, name) in stems.iter().enumerate() {
        let depth = depth.get(name).cloned();
        frames.push(PlannedFrame {
            view: cameras.view(2 * i, name, images.files[name].clone(), i as f32)?,
            depth: depth.map(|path| DepthFile::Depth { path, scale: 1.0 }),
            mask: masks.get(name).cloned().map(MaskFile::File),
        });
    }
    let test_at = root.join("inference_images");
    let test_images = list(&test_at, PICTURES)?;
    let test_stems = test_images.stems();
    cameras.reach(test_stems.len(), &test_at)?;
    let last = stems.len() - 1;
    let mut test = Vec::with_capacity(test_stems.len());
    for (i, name) in test_stems.iter().enumerate() {
        let image = test_images.files[name].clone();
        test.push(cameras.view(2 * i + 1, name, image, i.min(last) as f32)?);
    }
    notes.push(CENTERED.into());
    Ok(Plan {
        truth: truth(root, "sharp_images", &frames, &mut notes)?,
        frames,
        test,
        points: points(root)?,
        depth_at,
        masks_at,
        inverted_masks: false,
        tracks: TrackFiles::in_folder(root.join("bootstapir")),
        notes,
    })
}

/// The folder of the training frames and what is in it.
fn training_pictures(root: &Path) -> Result<(PathBuf, Listing), IoError> {
    for name in ["images_512x288", "images"] {
        let folder = root.join(name);
        let images = list(&folder, PICTURES)?;
        if !images.files.is_empty() {
            return Ok((folder, images));
        }
    }
    let what = "frames: no PNG or JPEG in images_512x288/ or images/";
    Err(IoError::missing(
        root,
        what,
        "put the left camera's frames there",
    ))
}
