//! The defocus data set of D2RF's authors, as they publish it (<https://github.com/xianrui-luo/D2RF>,
//! `load_llff.py`, `run_nerf.py` and `eval.py`).
//!
//! ```text
//! poses_bounds.npy                     [2 N, 17], LLFF: row 2 i is the left camera at instant i, row 2 i + 1 the right one
//! images_bokeh/000000_left, _right, …  defocused; the left ones are the training frames
//! images/000000_left, _right, …        sharp; the right ones are the test views, the left ones truth of the frames
//! motion_masks/000000_left, …          optional: white where something moves
//! sparse/                              optional: the COLMAP model that poses_bounds.npy is from; its points are read
//! dpt/, background_mask/, flow_i1/     not read: relative disparity, the authors' own split of the scene, flow
//! images_2/                            not read: their loader makes it of images_bokeh/
//!
//! flow3d_preprocessed/                 optional: what Shape-of-Motion's tools make of the left frames
//!   2d_tracks/{query}_{target}.npy
//!   aligned_depth_anything_colmap/     disparity in units of the poses
//! ```

use std::path::Path;

use super::stereo::{CENTERED, Cameras, points, truth};
use crate::folder::{Listing, PICTURES, list, list_optional};
use crate::plan::{DepthFile, Layout, MaskFile, Plan, PlannedFrame, list_masks};
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions};

pub(super) const LAYOUT: Layout = Layout {
    name: "D2RF",
    looks_for: &["poses_bounds.npy", "images_bokeh/"],
    plan,
};

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let mut notes = vec![CENTERED.to_owned()];
    let images_at = root.join("images_bokeh");
    let images = list(&images_at, PICTURES)?;
    let instants = eyes(&images, &images_at)?;
    let cameras = Cameras::read(root.join("poses_bounds.npy"))?;
    cameras.reach(instants.len(), &images_at)?;
    if instants.len() < cameras.instants() {
        // Unlike DyBluRF's, the authors' loader refuses that too: which cameras are over is not known.
        let what = format!(
            "{} instants with pictures, and cameras of {} in poses_bounds.npy",
            instants.len(),
            cameras.instants()
        );
        return Err(IoError::names(&images_at, what));
    }

    let preprocessed = root.join("flow3d_preprocessed");
    let depth_at = preprocessed.join("aligned_depth_anything_colmap");
    let lefts: Vec<_> = instants.iter().map(|[left, _]| left.clone()).collect();
    let depth = list_optional(&depth_at, &["npy"])?.named_as(&lefts, &depth_at)?;
    if depth.is_empty() && root.join("dpt").is_dir() {
        notes.push(
            "dpt/ is not read: its disparity is relative, and nothing says by which scale and shift".into(),
        );
    }
    let masks_at = root.join("motion_masks");
    let masks = list_masks(&masks_at, options)?.named_as(&lefts, &masks_at)?;
    let mut frames = Vec::with_capacity(instants.len());
    for (i, [left, _]) in instants.iter().enumerate() {
        let image = images.files[left].clone();
        frames.push(PlannedFrame {
            view: cameras.view(2 * i, left, image, i as f32)?,
            depth: depth.get(left).cloned().map(DepthFile::Disparity),
            mask: masks.get(left).cloned().map(MaskFile::File),
        });
    }

    let sharp_at = root.join("images");
    let sharp = list(&sharp_at, PICTURES)?;
    let mut test = Vec::new();
    if !sharp.files.is_empty() {
        let rights: Vec<_> = instants.iter().map(|[_, right]| right.clone()).collect();
        let advice = "the sharp pictures of the right camera are the test views";
        let pictures = sharp.pick(&rights, &sharp_at, "pictures of", advice)?;
        for (i, (right, image)) in rights.iter().zip(pictures).enumerate() {
            test.push(cameras.view(2 * i + 1, right, image, i as f32)?);
        }
    }
    Ok(Plan {
        truth: truth(root, "images", &frames, &mut notes)?,
        frames,
        test,
        points: points(root)?,
        depth_at,
        masks_at,
        inverted_masks: false,
        tracks: TrackFiles::new(&preprocessed),
        notes,
    })
}

/// The names of the left and the right picture of each instant. Sorted, they take turns, and a missing one
/// would exchange the eyes of all that follow.
fn eyes(images: &Listing, folder: &Path) -> Result<Vec<[String; 2]>, IoError> {
    let stems = images.stems();
    if stems.is_empty() {
        let what = "frames: no PNG or JPEG";
        let advice = "put the defocused pictures of both cameras there";
        return Err(IoError::missing(folder, what, advice));
    }
    let mut instants = Vec::with_capacity(stems.len() / 2);
    for pair in stems.chunks(2) {
        let instant = pair[0].strip_suffix("_left");
        match pair {
            [left, right] if instant.is_some() && instant == right.strip_suffix("_right") => {
                instants.push([left.clone(), right.clone()]);
            }
            _ => {
                let found = pair.join(" and ");
                let what =
                    format!("a pair like 000000_left and 000000_right is expected, {found} found");
                return Err(IoError::names(folder, what));
            }
        }
    }
    Ok(instants)
}
