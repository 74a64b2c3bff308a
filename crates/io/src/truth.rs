//! What only a scene with known truth has, in `truth/` or where its layout has it. For scoring, never for training.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};

use crate::folder::{PICTURES, list};
use crate::load::read_array_map;
use crate::mask::{read_map_for, settle};
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
    /// `truth/masks_test`: 1 where a test view shows something that moves, one per test view. Both are read by the rule of
    /// training masks where they hold small numbers: 0 and 1 of 255 are stretched, and of others all above 0 counts.
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
            let largest = map.values.iter().copied().fold(0.0, f32::max);
            let map = match undone {
                Some(undone) => undone.map(&map),
                None => map,
            };
            Ok((found, (shrink_map(map, factor), largest)))
        };
        let folders = &self.truth_folders;
        Ok(Truth {
            sharp,
            covisible: self
                .part((&folders.covisible, PICTURES), &test, map)?
                .map(settled),
            masks_test: self
                .part((&folders.masks_test, PICTURES), &test, map)?
                .map(settled),
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

/// Maps, read by the rule of training masks; each comes with its largest value at its file's own size.
fn settled(read: Vec<(Map, f32)>) -> Vec<Map> {
    let (mut maps, largest): (Vec<Map>, Vec<f32>) = read.into_iter().unzip();
    settle(maps.iter_mut(), largest.into_iter().fold(0.0, f32::max));
    maps
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

#[cfg(test)]
mod tests {
    use super::*;
    use splat_core::Camera;

    /// Two test views of 4 x 2 px, made half as large as their files.
    fn scene(root: &Path) -> Scene {
        let view = |name: &str| View {
            name: name.to_owned(),
            camera: Camera::pinhole([4, 2], [4.0; 2], [2.0, 1.0]),
            cam_from_world: DAffine3::IDENTITY,
            time: 0.0,
            image: Image {
                width: 4,
                height: 2,
                pixels: vec![0.0; 3 * 4 * 2],
            },
        };
        Scene {
            downscale: 2,
            test: vec![view("a"), view("b")],
            truth_folders: crate::TruthFolders::of(root),
            ..Scene::of_frames(Vec::new())
        }
    }

    /// Writes both maps of each view, of which only the second has anything: `left` in its first five columns of eight.
    fn write(root: &Path, left: u8) {
        for folder in ["covisible", "masks_test"].map(|name| root.join("truth").join(name)) {
            std::fs::create_dir_all(&folder).unwrap();
            for (name, value) in [("a.png", 0), ("b.png", left)] {
                let map = image::GrayImage::from_fn(8, 4, |x, _| {
                    image::Luma([if x < 5 { value } else { 0 }])
                });
                map.save(folder.join(name)).unwrap();
            }
        }
    }

    #[test]
    fn maps_that_hold_small_numbers_are_read_as_those_that_hold_255() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let read = |left: u8| {
            write(root, left);
            let truth = scene(root).truth().unwrap();
            [truth.covisible, truth.masks_test].map(|maps| {
                let maps = maps.unwrap().into_iter();
                maps.map(|map| map.values[..4].to_vec()).collect::<Vec<_>>()
            })
        };
        let [nothing, half]: [[f32; 4]; 2] = [[0.0; 4], [1.0, 1.0, 0.5, 0.0]];
        for left in [255, 1] {
            let rows = vec![nothing.to_vec(), half.to_vec()];
            assert_eq!(read(left), [rows.clone(), rows], "{left} of 255");
        }
        // Numbers of instances: any is something.
        for rows in read(3) {
            assert_eq!(rows[0], nothing);
            assert_eq!((rows[1][0], rows[1][1], rows[1][3]), (1.0, 1.0, 0.0));
        }
    }
}
