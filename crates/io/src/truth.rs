//! `truth/`: what only a scene with known truth has. For scoring, never for training.

use std::path::{Path, PathBuf};

use crate::folder::{PICTURES, list};
use crate::picture::{read_image_for, read_map_for};
use crate::resample::{shrink_image, shrink_map};
use crate::{Image, IoError, Map, Scene, View};

/// The truth of a scene, each picture at its view's size. Parts that are not there are None.
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
    /// Reads what there is of `truth/`.
    ///
    /// # Errors
    /// A part that is there but lacks a file, or has one that is broken or of the wrong size.
    pub fn truth(&self) -> Result<Truth, IoError> {
        let truth = self.root.join("truth");
        let training: Vec<_> = self.frames.iter().map(|f| &f.view).collect();
        let test: Vec<_> = self.test.iter().collect();
        let factor = self.downscale;

        let sharp = self.part(&truth.join("images_sharp"), &training, |path, size| {
            let image = read_image_for(path, Some(size), &mut Vec::new())?;
            Ok(((image.width, image.height), shrink_image(image, factor)))
        })?;
        let map = |path: &Path, size| -> Result<((usize, usize), Map), IoError> {
            let map = read_map_for(path, Some(size), &mut Vec::new())?;
            Ok(((map.width, map.height), shrink_map(map, factor)))
        };
        Ok(Truth {
            sharp,
            covisible: self.part(&truth.join("covisible"), &test, map)?,
            masks_test: self.part(&truth.join("masks_test"), &test, map)?,
        })
    }

    /// One picture per view, by the view's name. `read` is told the size that is expected, and also tells the file's own.
    fn part<T>(
        &self,
        folder: &Path,
        views: &[&View],
        read: impl Fn(&Path, (usize, usize)) -> Result<((usize, usize), T), IoError>,
    ) -> Result<Option<Vec<T>>, IoError> {
        let listing = list(folder, PICTURES)?;
        if listing.files.is_empty() || views.is_empty() {
            return Ok(None);
        }
        let stems: Vec<_> = views.iter().map(|v| v.name.clone()).collect();
        let advice = "add them, or remove the folder";
        let paths: Vec<PathBuf> = listing.pick(&stems, folder, "truth for", advice)?;
        let mut pictures = Vec::with_capacity(views.len());
        for (path, view) in paths.iter().zip(views) {
            let camera = (view.camera.width, view.camera.height);
            let expected = (camera.0 * self.downscale, camera.1 * self.downscale);
            let (found, picture) = read(path, expected)?;
            let shrunk = (found.0 / self.downscale, found.1 / self.downscale);
            if shrunk != camera {
                return Err(IoError::size(path, "the picture", found, expected));
            }
            pictures.push(picture);
        }
        Ok(Some(pictures))
    }
}
