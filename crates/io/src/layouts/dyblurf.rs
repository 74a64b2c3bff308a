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

use glam::{DAffine3, DMat3, DVec3};
use splat_core::Camera;

use crate::camera_model::Lens;
use crate::colmap::{find_model, read_model};
use crate::folder::{Listing, PICTURES, list};
use crate::npy::read_npy;
use crate::picture::read_size;
use crate::plan::{DepthFile, Layout, Picture, Plan, PlannedFrame, PlannedView};
use crate::rotation::{camera_at, nearest_rotation};
use crate::scene::TruthFolders;
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
    cameras.check(stems.len(), &images_at, &mut notes)?;

    let depth_at = root.join("align_uni_depth_noclip");
    let depth = list(&depth_at, &["npy"])?.files;
    if depth.is_empty() && root.join("disp").is_dir() {
        notes.push(
            "disp/ is not read: its disparity is relative, and nothing says by which scale and shift".into(),
        );
    }
    let masks = ["motion_masks_manual", "motion_masks"].map(|name| root.join(name));
    let masks_at = masks.iter().find(|folder| folder.is_dir());
    let masks_at = masks_at.unwrap_or(&masks[1]).clone();
    let masks = if options.static_scene {
        Listing::default()
    } else {
        list(&masks_at, PICTURES)?
    };

    let mut frames = Vec::with_capacity(stems.len());
    for (i, name) in stems.iter().enumerate() {
        let depth = depth.get(name).cloned();
        frames.push(PlannedFrame {
            view: cameras.view(2 * i, name, images.files[name].clone(), i as f32)?,
            depth: depth.map(|path| DepthFile::Depth { path, scale: 1.0 }),
            mask: masks.files.get(name).cloned(),
        });
    }
    let test_at = root.join("inference_images");
    let test_images = list(&test_at, PICTURES)?;
    let test_stems = test_images.stems();
    cameras.check(test_stems.len(), &test_at, &mut Vec::new())?;
    let last = stems.len() - 1;
    let mut test = Vec::with_capacity(test_stems.len());
    for (i, name) in test_stems.iter().enumerate() {
        let image = test_images.files[name].clone();
        test.push(cameras.view(2 * i + 1, name, image, i.min(last) as f32)?);
    }
    let points = match find_model(root) {
        Some(folder) => read_model(&folder)?.points,
        None => Vec::new(),
    };
    notes.push(
        "poses_bounds.npy has no principal point: it is taken to be the picture's middle, as the authors take it"
            .into(),
    );
    Ok(Plan {
        truth: truth(root, &images, &stems, &mut notes)?,
        frames,
        test,
        points,
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

/// `sharp_images/` where it has a picture of the same size for each frame.
fn truth(
    root: &Path,
    images: &Listing,
    stems: &[String],
    notes: &mut Vec<String>,
) -> Result<TruthFolders, IoError> {
    let sharp_at = root.join("sharp_images");
    let sharp = list(&sharp_at, PICTURES)?;
    let mut folders = TruthFolders::of(root);
    if sharp.files.is_empty() {
        return Ok(folders);
    }
    for name in stems {
        let same_size = match sharp.files.get(name) {
            Some(path) => read_size(path)? == read_size(&images.files[name])?,
            None => false,
        };
        if !same_size {
            notes.push(format!(
                "sharp_images/ is not read: it has no picture of the frame's size for {name}"
            ));
            return Ok(folders);
        }
    }
    folders.sharp = sharp_at;
    Ok(folders)
}

/// `poses_bounds.npy`.
struct Cameras {
    path: PathBuf,
    /// [2 N, 17].
    rows: Vec<[f64; 17]>,
}

impl Cameras {
    fn read(path: PathBuf) -> Result<Self, IoError> {
        let array = read_npy(&path)?;
        let [count, 17] = array.shape[..] else {
            let shape = array.shape;
            let what = format!("the array has shape {shape:?}; [2 N, 17] is expected");
            return Err(IoError::malformed(&path, what));
        };
        if count % 2 == 1 {
            let what =
                format!("{count} cameras; a left and a right one are expected for each instant");
            return Err(IoError::malformed(&path, what));
        }
        let rows = array.values.chunks_exact(17);
        let rows = rows.map(|row| std::array::from_fn(|i| f64::from(row[i])));
        Ok(Self {
            rows: rows.collect(),
            path,
        })
    }

    /// The authors take the first cameras where there are more than pictures.
    fn check(
        &self,
        pictures: usize,
        folder: &Path,
        notes: &mut Vec<String>,
    ) -> Result<(), IoError> {
        let instants = self.rows.len() / 2;
        if pictures > instants {
            let folder = folder.display();
            let what =
                format!("cameras of {instants} instants, and {pictures} pictures in {folder}");
            return Err(IoError::names(&self.path, what));
        }
        if pictures < instants {
            notes.push(format!(
                "poses_bounds.npy has {instants} instants for {pictures} frames: the first ones are theirs"
            ));
        }
        Ok(())
    }

    fn view(
        &self,
        row: usize,
        name: &str,
        image: PathBuf,
        time: f32,
    ) -> Result<PlannedView, IoError> {
        let who = format!("row {row}");
        let values = &self.rows[row];
        // Rows of [3, 5]: the axes down, right and back, the centre, and height, width and focal length.
        let column = |c: usize| DVec3::new(values[c], values[5 + c], values[10 + c]);
        let (down, right, back, center, of_picture) =
            (column(0), column(1), column(2), column(3), column(4));
        let pose = nearest_rotation(DMat3::from_cols(right, down, -back));
        let pose = pose.filter(|_| center.is_finite());
        let pose: Option<DAffine3> = pose.map(|rotation| camera_at(center, rotation));
        let cam_from_world = pose.ok_or_else(|| {
            IoError::malformed(&self.path, format!("{who} has no rigid transform"))
        })?;
        let side = |v: f64| (1.0..=1e6).contains(&v).then_some(v as usize);
        let [height, width, focal] = of_picture.to_array();
        let (Some(width), Some(height)) = (side(width), side(height)) else {
            let what = format!("{who} has a picture of {width} x {height}");
            return Err(IoError::malformed(&self.path, what));
        };
        let center = [width as f64 / 2.0, height as f64 / 2.0];
        let camera = Camera::pinhole([width, height], [focal, focal], center);
        Ok(PlannedView {
            name: name.into(),
            image: Picture::File(image),
            lens: Lens::pinhole(camera).checked(&who, &self.path)?,
            camera_file: self.path.clone(),
            cam_from_world,
            time,
        })
    }
}
