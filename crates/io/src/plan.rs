//! Between the layouts and the loader: what a layout says of itself, and what it finds out about a folder
//! before any picture is read.

use std::path::{Path, PathBuf};

use glam::DAffine3;

use crate::camera_model::Lens;
use crate::folder::{Listing, PICTURES, list_optional};
use crate::scene::TruthFolders;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions, Map, SparsePoint};

/// A way to lay a scene out in a folder.
pub(crate) struct Layout {
    /// Its name in messages and in [`Scene::layout`](crate::Scene::layout).
    pub(crate) name: &'static str,
    /// What makes a folder one of these when all of it is there; folders end in a slash, and a star
    /// stands for the beginning of a file's name.
    pub(crate) looks_for: &'static [&'static str],
    /// Says where everything is in such a folder.
    pub(crate) plan: fn(&Path, &LoadOptions) -> Result<Plan, IoError>,
}

impl Layout {
    /// What of [`Self::looks_for`] is there.
    pub(crate) fn found(&self, root: &Path) -> impl Iterator<Item = &'static str> {
        self.looks_for.iter().copied().filter(|part| {
            let path = root.join(part);
            if let Some(ending) = part.strip_prefix('*') {
                has_file_with(root, ending)
            } else if part.ends_with('/') {
                path.is_dir()
            } else {
                path.is_file()
            }
        })
    }

    pub(crate) fn recognises(&self, root: &Path) -> bool {
        self.found(root).count() == self.looks_for.len()
    }
}

fn has_file_with(root: &Path, ending: &str) -> bool {
    let mut entries = std::fs::read_dir(root).into_iter().flatten().flatten();
    entries.any(|e| e.path().is_file() && e.file_name().to_string_lossy().ends_with(ending))
}

/// A scene before its pictures are read. Frames are in time order.
pub(crate) struct Plan {
    pub(crate) frames: Vec<PlannedFrame>,
    pub(crate) test: Vec<PlannedView>,
    pub(crate) points: Vec<SparsePoint>,
    /// Where the depth and the masks are from, for messages.
    pub(crate) depth_at: PathBuf,
    pub(crate) masks_at: PathBuf,
    /// Masks are black where something moves, and anything else is white.
    pub(crate) inverted_masks: bool,
    pub(crate) tracks: TrackFiles,
    pub(crate) truth: TruthFolders,
    pub(crate) notes: Vec<String>,
}

/// A view before its picture is read. The lens may be for another size of the picture.
pub(crate) struct PlannedView {
    pub(crate) name: String,
    pub(crate) image: Picture,
    pub(crate) lens: Lens,
    /// The file that the camera is from, for messages.
    pub(crate) camera_file: PathBuf,
    pub(crate) cam_from_world: DAffine3,
    pub(crate) time: f32,
}

/// Where a view's picture is.
pub(crate) enum Picture {
    File(PathBuf),
    /// Already read, from an archive.
    Loaded {
        size: (usize, usize),
        /// sRGB [H, W, 3].
        pixels: Vec<u8>,
        archive: PathBuf,
    },
}

impl Picture {
    /// The file that it is from, for messages.
    pub(crate) fn path(&self) -> &Path {
        let (Self::File(path) | Self::Loaded { archive: path, .. }) = self;
        path
    }
}

/// A training frame before its files are read. A layout need not care that all frames have a file or
/// none: the loader does.
pub(crate) struct PlannedFrame {
    pub(crate) view: PlannedView,
    pub(crate) depth: Option<DepthFile>,
    pub(crate) mask: Option<MaskFile>,
}

/// Where a frame's mask is.
pub(crate) enum MaskFile {
    /// A picture.
    File(PathBuf),
    /// Already read, from an archive: 1 where something moves.
    Loaded { mask: Map, archive: PathBuf },
}

/// Where a frame's depth is.
pub(crate) enum DepthFile {
    /// An array of disparity.
    Disparity(PathBuf),
    /// A 16-bit PNG or an array, in units of `scale` scene units.
    Depth { path: PathBuf, scale: f64 },
    /// Already read, from an archive, in scene units.
    Loaded { depth: Map, archive: PathBuf },
}

/// The masks in a folder, or none where the scene is said to be static.
pub(crate) fn list_masks(folder: &Path, options: &LoadOptions) -> Result<Listing, IoError> {
    if options.static_scene {
        Ok(Listing::default())
    } else {
        list_optional(folder, PICTURES)
    }
}

/// The time, in training frames, of an instant among the training frames' own (ascending), clamped to
/// them.
pub(crate) fn time_between(instant: f64, training: &[f64]) -> f32 {
    let after = training.partition_point(|&t| t < instant);
    if after == 0 || after == training.len() {
        return after.min(training.len().saturating_sub(1)) as f32;
    }
    let (a, b) = (training[after - 1], training[after]);
    ((after - 1) as f64 + (instant - a) / (b - a)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instants_lie_between_their_neighbours_and_within_the_video() {
        let training = [0.0, 2.0, 4.0, 10.0];
        for (instant, time) in [
            (-1.0, 0.0),
            (0.0, 0.0),
            (2.0, 1.0),
            (3.0, 1.5),
            (8.5, 2.75),
            (10.0, 3.0),
            (11.0, 3.0),
        ] {
            assert_eq!(time_between(instant, &training), time, "{instant}");
        }
        assert_eq!(time_between(3.0, &[5.0]), 0.0, "a single frame");
    }
}
