//! The layout of Shape-of-Motion's users (and of the reference code).
//!
//! ```text
//! images/                              training frames, in the order of their names
//! images_test/                         optional: test views
//! masks/                               optional: white where something moves
//! flow3d_preprocessed/
//!   colmap/sparse[/0]                  cameras, images, points3D (.bin or .txt)
//!   aligned_depth_anything_colmap/     optional: {frame}.npy, disparity [H, W]
//!   2d_tracks/                         optional: {query}_{target}.npy, [P, 4]
//!   2d_tracks.npz                      or the same arrays in one file
//! ```

mod pairing;

use std::path::{Path, PathBuf};

use pairing::pair;

use crate::colmap::{find_model, read_model};
use crate::folder::{Listing, PICTURES, list, list_optional};
use crate::plan::{DepthFile, Layout, MaskFile, Plan, PlannedFrame, list_masks};
use crate::scene::TruthFolders;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions};

pub(super) const LAYOUT: Layout = Layout {
    name: "Shape-of-Motion",
    looks_for: &["images/", "flow3d_preprocessed/"],
    plan,
};

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let preprocessed = root.join("flow3d_preprocessed");
    let mut notes = Vec::new();

    let images = list_pictures(&root.join("images"), &mut notes)?;
    let stems = images.stems();

    let test_images = list(&root.join("images_test"), PICTURES)?;
    let test_stems = test_images.stems();

    let colmap = preprocessed.join("colmap");
    let model_at = find_model(&colmap).ok_or_else(|| {
        IoError::missing(
            &colmap,
            "the COLMAP model: no images.bin or images.txt in sparse/ or sparse/0/",
            "run COLMAP on the frames, or copy its model here",
        )
    })?;
    let model = read_model(&model_at)?;
    let pairing = pair(&stems, &test_stems, &model, &mut notes)?;

    let depth_at = preprocessed.join("aligned_depth_anything_colmap");
    let depth = list_optional(&depth_at, &["npy"])?;
    let depth = optional(&depth, &stems, &depth_at, "disparity of")?;
    let masks_at = root.join("masks");
    let masks = list_masks(&masks_at, options)?;
    let masks = optional(&masks, &stems, &masks_at, "masks of")?;

    let posed = |at: usize| &model.images[at];
    let mut frames = Vec::with_capacity(stems.len());
    for (i, name) in stems.iter().enumerate() {
        let image = images.files[name].clone();
        frames.push(PlannedFrame {
            view: model.view(posed(pairing.training[i]), name, image, i as f32)?,
            depth: depth.as_ref().map(|d| DepthFile::Disparity(d[i].clone())),
            mask: masks.as_ref().map(|m| MaskFile::File(m[i].clone())),
        });
    }
    let mut test = Vec::new();
    for (name, &(at, time)) in test_stems.iter().zip(&pairing.test) {
        let image = test_images.files[name].clone();
        test.push(model.view(posed(at), name, image, time)?);
    }
    Ok(Plan {
        truth: TruthFolders::of(root),
        frames,
        test,
        points: model.points,
        depth_at,
        masks_at,
        inverted_masks: false,
        tracks: TrackFiles::new(&preprocessed),
        notes,
    })
}

fn list_pictures(folder: &Path, notes: &mut Vec<String>) -> Result<Listing, IoError> {
    let images = list(folder, PICTURES)?;
    if images.files.is_empty() {
        let what = format!("frames: no PNG or JPEG among {} files", images.others);
        return Err(IoError::missing(
            folder,
            what,
            "put the video's frames there",
        ));
    }
    if images.others > 0 {
        notes.push(format!(
            "ignored {} files in images/ that are no PNG or JPEG",
            images.others
        ));
    }
    Ok(images)
}

/// One file per frame where the folder has any at all.
fn optional(
    listing: &Listing,
    stems: &[String],
    folder: &Path,
    what: &str,
) -> Result<Option<Vec<PathBuf>>, IoError> {
    if listing.files.is_empty() {
        return Ok(None);
    }
    let advice = "add them, or remove the folder to do without";
    listing.pick(stems, folder, what, advice).map(Some)
}
