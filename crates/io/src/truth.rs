//! What only a scene with known truth has, in `truth/` or where its layout has it. For scoring, never for training.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};

use crate::folder::{PICTURES, list};
use crate::load::read_array_map;
use crate::mask::read_map_for;
use crate::npy::read_npy;
use crate::picture::{Size, read_image_for};
use crate::resample::{shrink_depth, shrink_image, shrink_map};
use crate::{Image, IoError, Map, Scene, Undistortion, View};

/// The truth of a scene, each picture at its view's size and as its pinhole sees it. Parts that are not there are None.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth {
    /// `truth/images_sharp`: the training frames without blur, one per frame.
    pub sharp: Option<Vec<Image>>,
    /// `truth/covisible`: 1 where a test view's pixel is seen by some training frame, one per test
    /// view. Downscaled by area, so that a value under 1 has some pixel in it that is not.
    pub covisible: Option<Vec<Map>>,
    /// `truth/masks_test`: 1 where a test view shows something that moves, one per test view.
    pub masks_test: Option<Vec<Map>>,
    /// `truth/exposure` and `truth/depth`: how the training frames were blurred, one per frame.
    pub exposures: Option<Vec<TrueExposure>>,
}

/// How a training frame was blurred: its light came in equal parts from these cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct TrueExposure {
    /// From the camera of the frame's pose to each of those: a motion in space, with a shear for a point of a lens off its middle.
    /// `truth/exposure/NAME.npy`, [n, 3, 4] of real numbers, in the scene's units.
    pub cameras: Vec<DAffine3>,
    /// z-depth as the frame's pose sees it, 0 where missing. `truth/depth/NAME.npy`, [H, W] of real numbers.
    pub depth: Map,
}

impl Scene {
    /// Reads what there is of the truth.
    ///
    /// # Errors
    /// A part that is there but lacks a file, or has one that is broken or of the wrong size.
    pub fn truth(&self) -> Result<Truth, IoError> {
        let undone = |at: usize| self.undistorted.get(at).and_then(Option::as_ref);
        let count = self.frames.len();
        let training = self.frames.iter().enumerate();
        let training: Vec<_> = training.map(|(i, f)| (&f.view, undone(i))).collect();
        let test = self.test.iter().enumerate();
        let test: Vec<_> = test.map(|(i, view)| (view, undone(count + i))).collect();
        let factor = self.downscale;

        let sharp = self.part(
            (&self.truth_folders.sharp, PICTURES),
            &training,
            |path, size, undone| {
                let image = read_image_for(path, Some(size), &mut Vec::new())?;
                let found = (image.width, image.height);
                let image = match undone {
                    Some(undone) => undone.image(&image),
                    None => image,
                };
                Ok((found, shrink_image(image, factor)))
            },
        )?;
        let map = |path: &Path, size, undone: Option<&Undistortion>| {
            let map = read_map_for(path, Some(size), &mut Vec::new())?;
            let found = (map.width, map.height);
            let map = match undone {
                Some(undone) => undone.map(&map),
                None => map,
            };
            Ok((found, shrink_map(map, factor)))
        };
        let folders = &self.truth_folders;
        Ok(Truth {
            sharp,
            covisible: self.part((&folders.covisible, PICTURES), &test, map)?,
            masks_test: self.part((&folders.masks_test, PICTURES), &test, map)?,
            exposures: self.exposures(&training)?,
        })
    }

    fn exposures(
        &self,
        training: &[(&View, Option<&Undistortion>)],
    ) -> Result<Option<Vec<TrueExposure>>, IoError> {
        let (folder, folders) = (&self.truth_folders.exposure, &self.truth_folders);
        let Some(paths) = files((folder, ARRAYS), training)? else {
            return Ok(None);
        };
        let depth = self.part((&folders.depth, ARRAYS), training, |path, _, undone| {
            let mut depth = read_array_map(path)?;
            for z in &mut depth.values {
                *z = if *z > 0.0 && z.is_finite() { *z } else { 0.0 };
            }
            let found = (depth.width, depth.height);
            let depth = match undone {
                Some(undone) => undone.depth(&depth),
                None => depth,
            };
            Ok((found, shrink_depth(depth, self.downscale)))
        })?;
        let Some(depth) = depth else {
            let advice =
                "the kernels of an exposure follow from it; add it, or remove truth/exposure";
            return Err(IoError::missing(&folders.depth, "true depth", advice));
        };
        let exposures = paths.iter().zip(depth).map(|(path, depth)| {
            let cameras = cameras(path)?;
            Ok(TrueExposure { cameras, depth })
        });
        exposures.collect::<Result<_, _>>().map(Some)
    }

    /// One picture or array per view, by the view's name, out of a folder and with one of some endings. `read` is told the size
    /// that is expected and what was undone of the lens, and also tells the file's own size.
    fn part<T>(
        &self,
        kind: (&Path, &[&str]),
        views: &[(&View, Option<&Undistortion>)],
        read: impl Fn(&Path, Size, Option<&Undistortion>) -> Result<(Size, T), IoError>,
    ) -> Result<Option<Vec<T>>, IoError> {
        let Some(paths) = files(kind, views)? else {
            return Ok(None);
        };
        let mut pictures = Vec::with_capacity(views.len());
        for (path, (view, undone)) in paths.iter().zip(views) {
            let camera = (view.camera.width, view.camera.height);
            let expected = (camera.0 * self.downscale, camera.1 * self.downscale);
            let (found, picture) = read(path, expected, *undone)?;
            let shrunk = (found.0 / self.downscale, found.1 / self.downscale);
            if shrunk != camera {
                return Err(IoError::size(path, "the picture", found, expected));
            }
            pictures.push(picture);
        }
        Ok(Some(pictures))
    }
}

/// Endings of arrays.
const ARRAYS: &[&str] = &["npy"];

/// One file per view, by the view's name; `None` of a folder without any.
fn files(
    (folder, endings): (&Path, &[&str]),
    views: &[(&View, Option<&Undistortion>)],
) -> Result<Option<Vec<PathBuf>>, IoError> {
    let listing = list(folder, endings)?;
    if listing.files.is_empty() || views.is_empty() {
        return Ok(None);
    }
    let stems: Vec<_> = views.iter().map(|(view, _)| view.name.clone()).collect();
    let advice = "add them, or remove the folder";
    listing.pick(&stems, folder, "truth for", advice).map(Some)
}

/// See [`TrueExposure::cameras`].
fn cameras(path: &Path) -> Result<Vec<DAffine3>, IoError> {
    let array = read_npy(path)?;
    let [count, 3, 4] = array.shape[..] else {
        let what = format!("cameras are [n, 3, 4], and this is {:?}", array.shape);
        return Err(IoError::malformed(path, what));
    };
    if count == 0 {
        return Err(IoError::malformed(path, "an exposure has a camera or more"));
    }
    let rows = array.values.as_chunks::<12>().0;
    let cameras = rows.iter().enumerate().map(|(k, rows)| {
        let rows = rows.map(f64::from);
        let column = |j: usize| DVec3::new(rows[j], rows[4 + j], rows[8 + j]);
        let camera = DAffine3 {
            matrix3: DMat3::from_cols(column(0), column(1), column(2)),
            translation: column(3),
        };
        // A camera that cannot be undone sees nothing.
        let usable = camera.is_finite() && camera.inverse().is_finite();
        let wrong = || IoError::malformed(path, format!("camera {k} is no map that can be undone"));
        usable.then_some(camera).ok_or_else(wrong)
    });
    cameras.collect()
}
