//! What the stereo data sets of D2RF's and DyBluRF's authors share: LLFF's cameras, the left one of an
//! instant before its right one, and sharp pictures of the training frames.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use splat_core::Camera;

use crate::camera_model::Lens;
use crate::colmap::{find_model, read_points};
use crate::folder::{PICTURES, list};
use crate::npy::read_npy;
use crate::picture::read_size;
use crate::plan::{Picture, PlannedFrame, PlannedView};
use crate::rotation::{camera_at, nearest_rotation};
use crate::scene::TruthFolders;
use crate::{IoError, SparsePoint};

/// A note on what [`Cameras`] supposes.
pub(super) const CENTERED: &str = "poses_bounds.npy has no principal point: it is taken to be the picture's middle, as the authors take it";

/// `poses_bounds.npy`.
pub(super) struct Cameras {
    path: PathBuf,
    /// [2 N, 17].
    rows: Vec<[f64; 17]>,
}

impl Cameras {
    pub(super) fn read(path: PathBuf) -> Result<Self, IoError> {
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

    pub(super) fn instants(&self) -> usize {
        self.rows.len() / 2
    }

    /// An error where one eye's pictures in `folder` are more than there are instants.
    pub(super) fn reach(&self, pictures: usize, folder: &Path) -> Result<(), IoError> {
        let instants = self.instants();
        if pictures > instants {
            let folder = folder.display();
            let what =
                format!("cameras of {instants} instants, and {pictures} pictures in {folder}");
            return Err(IoError::names(&self.path, what));
        }
        Ok(())
    }

    /// The view of a row: 2 i is the left camera at instant i, 2 i + 1 the right one.
    pub(super) fn view(
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

/// The points of the COLMAP model that the cameras are from, where it is there. Its own cameras are not read.
pub(super) fn points(root: &Path) -> Result<Vec<SparsePoint>, IoError> {
    match find_model(root) {
        Some(folder) => read_points(&folder),
        None => Ok(Vec::new()),
    }
}

/// The folders of truth. Of the frames it is the folder `name`, where that has a sharp picture for each, of the frame's size;
/// else what `truth/` has, as in any layout.
pub(super) fn truth(
    root: &Path,
    name: &str,
    frames: &[PlannedFrame],
    notes: &mut Vec<String>,
) -> Result<TruthFolders, IoError> {
    let mut truth = TruthFolders::of(root);
    let folder = root.join(name);
    let sharp = list(&folder, PICTURES)?;
    if sharp.files.is_empty() {
        return Ok(truth);
    }
    for PlannedFrame { view, .. } in frames {
        let same_size = match sharp.files.get(&view.name) {
            Some(path) => read_size(path)? == read_size(view.image.path())?,
            None => false,
        };
        if !same_size {
            notes.push(format!(
                "{name}/ is not read as truth of the frames: it has no picture of the frame's size for {}",
                view.name
            ));
            return Ok(truth);
        }
    }
    truth.sharp = folder;
    Ok(truth)
}
