//! What only a scene with known truth has, in `truth/` or where its layout has it. For scoring, never for training.

use std::path::{Path, PathBuf};

use crate::folder::{PICTURES, list};
use crate::picture::{Size, read_image_for, read_map_for};
use crate::resample::{shrink_image, shrink_map};
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
            &self.truth_folders.sharp,
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
        Ok(Truth {
            sharp,
            covisible: self.part(&self.truth_folders.covisible, &test, map)?,
            masks_test: self.part(&self.truth_folders.masks_test, &test, map)?,
        })
    }

    /// One picture per view, by the view's name. `read` is told the size that is expected and what was undone of the lens, and
    /// also tells the file's own size.
    fn part<T>(
        &self,
        folder: &Path,
        views: &[(&View, Option<&Undistortion>)],
        read: impl Fn(&Path, Size, Option<&Undistortion>) -> Result<(Size, T), IoError>,
    ) -> Result<Option<Vec<T>>, IoError> {
        let listing = list(folder, PICTURES)?;
        if listing.files.is_empty() || views.is_empty() {
            return Ok(None);
        }
        let stems: Vec<_> = views.iter().map(|(view, _)| view.name.clone()).collect();
        let advice = "add them, or remove the folder";
        let paths: Vec<PathBuf> = listing.pick(&stems, folder, "truth for", advice)?;
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
