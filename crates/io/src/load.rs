//! Reads the files of a plan and brings them to one size.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::error::list_names;
use crate::folder::{PICTURES, list};
use crate::mask::{read_map_for, settle};
use crate::notes::note;
use crate::npy::read_npy;
use crate::picture::{Size, has_aspect, read_depth_png, read_image_for, read_size_for};
use crate::plan::{DepthFile, MaskFile, Picture, Plan, PlannedFrame, PlannedView};
use crate::resample::{resize_nearest, shrink_camera, shrink_depth, shrink_image, shrink_map};
use crate::{Frame, Image, IoError, LoadOptions, Map, Scene, Undistortion, View};

/// The scene of a plan that `layout` made.
pub(crate) fn load(
    root: PathBuf,
    layout: &'static str,
    mut plan: Plan,
    options: &LoadOptions,
) -> Result<Scene, IoError> {
    let stems: Vec<_> = plan.frames.iter().map(|f| f.view.name.clone()).collect();
    let mut loader = Loader {
        factor: options.downscale,
        inverted_masks: plan.inverted_masks,
        refuses_distortion: options.refuse_distortion,
        largest_mask: 0.0,
        notes: plan.notes,
    };
    // The first frame's own picture, where another takes its place.
    let mut own = None;
    if let Some(other) = &options.images {
        let folder = root.join(other);
        loader.note(format!(
            "training frames are taken from {}",
            folder.display()
        ));
        let advice = "the other folder needs a picture for each training frame";
        let images = list(&folder, PICTURES)?.pick(&stems, &folder, "frames", advice)?;
        for (frame, image) in plan.frames.iter_mut().zip(images) {
            let replaced = std::mem::replace(&mut frame.view.image, Picture::File(image));
            own.get_or_insert(replaced);
        }
    }
    if options.static_scene {
        loader.note("static scene asked for: masks and tracks are not read".into());
        plan.frames.iter_mut().for_each(|f| f.mask = None);
    }
    let has_depth: fn(&PlannedFrame) -> bool = |f| f.depth.is_some();
    let has_mask: fn(&PlannedFrame) -> bool = |f| f.mask.is_some();
    all_or_none(&plan.frames, has_depth, "the depth", &plan.depth_at)?;
    all_or_none(&plan.frames, has_mask, "the mask", &plan.masks_at)?;
    let mut tracks = if options.static_scene {
        None
    } else {
        plan.tracks.read(&stems)?
    };

    // All pictures before what belongs to them: only together do they say which of them has an odd size.
    let (mut views, mut sizes, mut undistorted) = (Vec::new(), Vec::new(), Vec::new());
    for planned in &plan.frames {
        let image = loader.image(&planned.view)?;
        sizes.push((image.width, image.height));
        let (view, undone) = loader.view(&planned.view, image)?;
        views.push(view);
        undistorted.push(undone);
    }
    check_sizes(&plan.frames, &sizes)?;
    loader.look_through_masks(&mut plan.frames, &sizes)?;
    let mut frames = Vec::with_capacity(views.len());
    for (((planned, view), size), undone) in
        plan.frames.iter().zip(views).zip(&sizes).zip(&undistorted)
    {
        frames.push(loader.frame(planned, view, (*size, undone.as_ref()))?);
    }
    if let Some(tracks) = &mut tracks {
        let first = plan.frames.first().zip(sizes.first());
        let scale = match (&own, first) {
            (Some(own), Some((frame, &size))) => loader.scale_of_tracks(own, &frame.view, size)?,
            _ => [1.0, 1.0],
        };
        tracks.follow_pictures(scale, &undistorted, options.downscale);
    }
    let mut test = Vec::with_capacity(plan.test.len());
    for planned in &plan.test {
        let image = loader.image(planned)?;
        let (view, undone) = loader.view(planned, image)?;
        test.push(view);
        undistorted.push(undone);
    }

    let mut notes = loader.notes;
    notes.extend(distortion_note(&undistorted));
    if undistorted.iter().all(Option::is_none) {
        undistorted.clear();
    }
    let masked = frames.iter().any(|f| f.mask.is_some());
    if masked && tracks.is_none() {
        return Err(IoError::MasksWithoutTracks {
            masks: plan.masks_at,
            tracks: plan.tracks.folder,
        });
    }
    if tracks.is_some() && !masked {
        notes.push("there are tracks but no masks that say what moves".into());
    }
    Ok(Scene {
        name: root
            .file_name()
            .map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned()),
        root,
        layout,
        downscale: options.downscale,
        frames,
        test,
        points: plan.points,
        tracks,
        undistorted,
        truth_folders: plan.truth,
        notes,
    })
}

/// What was done about lenses, if anything.
fn distortion_note(undistorted: &[Option<Undistortion>]) -> Option<String> {
    let undone: Vec<_> = undistorted.iter().flatten().collect();
    let models = BTreeSet::from_iter(undone.iter().map(|u| u.model()));
    let largest = undone
        .iter()
        .map(|u| u.displacement_px())
        .reduce(f64::max)?;
    let lowest = undone.iter().map(|u| u.zoom()).reduce(f64::min)?;
    let highest = undone.iter().map(|u| u.zoom()).reduce(f64::max)?;
    let zooms = if highest - lowest < 5e-4 {
        format!("{highest:.3}")
    } else {
        format!("{lowest:.3} to {highest:.3}")
    };
    Some(format!(
        "{} of {} pictures had lens distortion ({}) of up to {largest:.2} px: they, their depth, masks and tracks \
         are now those of a pinhole with {zooms} times the focal length, whose pixels all lie inside the picture",
        undone.len(),
        undistorted.len(),
        Vec::from_iter(models).join(", "),
    ))
}

/// An error for the first picture that has not the size of the others: the most frequent one, or among those the one that
/// cameras have.
fn check_sizes(frames: &[PlannedFrame], sizes: &[(usize, usize)]) -> Result<(), IoError> {
    let rank = |size: &(usize, usize)| {
        let count = sizes.iter().filter(|other| *other == size).count();
        let cameras = frames.iter().map(|f| &f.view.lens.camera);
        let fitting = cameras.filter(|c| (c.width, c.height) == *size).count();
        (count, fitting)
    };
    let distinct = BTreeSet::from_iter(sizes.iter().copied());
    let Some(&usual) = distinct.iter().max_by_key(|size| rank(size)) else {
        return Ok(());
    };
    match frames.iter().zip(sizes).find(|(_, size)| **size != usual) {
        Some((odd, &found)) => {
            let what = "the picture, unlike those of other frames,";
            Err(IoError::size(odd.view.image.path(), what, found, usual))
        }
        None => Ok(()),
    }
}

/// That some frames have a file of this kind and others not is an error.
fn all_or_none(
    frames: &[PlannedFrame],
    has: fn(&PlannedFrame) -> bool,
    what: &str,
    place: &Path,
) -> Result<(), IoError> {
    let without = frames.iter().filter(|f| !has(f));
    let without: Vec<_> = without.map(|f| f.view.name.as_str()).collect();
    if without.is_empty() || without.len() == frames.len() {
        return Ok(());
    }
    let what = format!("{what} of {}", list_names(&without));
    let advice = "every training frame needs its own, or none has any";
    Err(IoError::missing(place, what, advice))
}

/// Reads files and makes them smaller.
struct Loader {
    factor: usize,
    inverted_masks: bool,
    refuses_distortion: bool,
    /// Largest value of all masks, or of some where that is over a half, at their pictures' size.
    largest_mask: f32,
    notes: Vec<String>,
}

impl Loader {
    fn note(&mut self, text: String) {
        note(&mut self.notes, text);
    }

    /// A view's picture, as it is in its file.
    fn image(&mut self, planned: &PlannedView) -> Result<Image, IoError> {
        let camera = &planned.lens.camera;
        let of_camera = (camera.width, camera.height);
        match &planned.image {
            Picture::File(path) => read_image_for(path, Some(of_camera), &mut self.notes),
            Picture::Loaded {
                size: (width, height),
                pixels,
                ..
            } => Ok(Image {
                width: *width,
                height: *height,
                pixels: pixels.iter().map(|&v| f32::from(v) / 255.0).collect(),
            }),
        }
    }

    /// A view with what belongs to it; its picture's file has this size, and this was undone of its lens.
    fn frame(
        &mut self,
        planned: &PlannedFrame,
        view: View,
        (size, undone): ((usize, usize), Option<&Undistortion>),
    ) -> Result<Frame, IoError> {
        let depth = planned.depth.as_ref();
        let depth = depth.map(|file| self.depth(file, size)).transpose()?;
        let mask = planned.mask.as_ref();
        let mask = mask.map(|file| self.settled_mask(file, size)).transpose()?;
        let (depth, mask) = match undone {
            Some(undone) => (
                depth.map(|depth| undone.depth(&depth)),
                mask.map(|mask| undone.map(&mask)),
            ),
            None => (depth, mask),
        };
        Ok(Frame {
            view,
            depth: depth.map(|depth| shrink_depth(depth, self.factor)),
            mask: mask.map(|mask| shrink_map(mask, self.factor)),
        })
    }

    /// A view of any size, and what was undone of its lens.
    fn view(
        &mut self,
        planned: &PlannedView,
        image: Image,
    ) -> Result<(View, Option<Undistortion>), IoError> {
        let (width, height) = (image.width, image.height);
        if self.factor > width.min(height) {
            let what = format!(
                "downscale {} leaves nothing of {width}x{height}",
                self.factor
            );
            return Err(IoError::invalid(planned.image.path(), what));
        }
        let (w, h) = (width % self.factor, height % self.factor);
        if (w, h) != (0, 0) {
            self.note(format!(
                "{width}x{height} is no multiple of {}: cropped to {}x{} at the right and bottom",
                self.factor,
                width - w,
                height - h
            ));
        }
        let mut lens = planned.lens.clone();
        let of_camera = (lens.camera.width, lens.camera.height);
        if of_camera != (width, height) {
            if !has_aspect((width, height), of_camera) {
                let what = format!(
                    "the picture has another aspect ratio than its camera in {}; it",
                    planned.camera_file.display()
                );
                let found = (width, height);
                return Err(IoError::size(planned.image.path(), what, found, of_camera));
            }
            lens = lens.resized(width, height);
            self.note(format!(
                "intrinsics were scaled to the pictures' size {width}x{height}"
            ));
        }
        let undone = Undistortion::of(&lens).map_err(|what| {
            IoError::malformed(&planned.camera_file, format!("{}: {what}", planned.name))
        })?;
        let (camera, image) = match &undone {
            Some(undone) if self.refuses_distortion => {
                return Err(IoError::Distortion {
                    model: undone.model().into(),
                    pixels: undone.displacement_px(),
                    path: planned.camera_file.clone(),
                });
            }
            Some(undone) => (undone.camera(), undone.image(&image)),
            None => (&lens.camera, image),
        };
        let view = View {
            name: planned.name.clone(),
            camera: shrink_camera(camera, self.factor),
            cam_from_world: planned.cam_from_world,
            time: planned.time,
            image: shrink_image(image, self.factor),
        };
        Ok((view, undone))
    }

    /// z-depth of the training frames' `size`.
    fn depth(&mut self, file: &DepthFile, size: (usize, usize)) -> Result<Map, IoError> {
        let (DepthFile::Disparity(path)
        | DepthFile::Depth { path, .. }
        | DepthFile::Loaded { archive: path, .. }) = file;
        let is_array = path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("npy"));
        let mut map = match file {
            DepthFile::Loaded { depth, .. } => depth.clone(),
            _ if is_array => read_array_map(path)?,
            _ => read_depth_png(path, size, &mut self.notes)?,
        };
        if let Some(at) = map.values.iter().position(|v| v.is_nan()) {
            let (x, y) = (at % map.width, at / map.width);
            let what = format!("the value at column {x}, row {y},");
            let advice = "make the file again, or mark missing values with 0";
            return Err(IoError::not_a_number(path, what, advice));
        }
        for value in &mut map.values {
            let v = f64::from(*value);
            let z = match file {
                DepthFile::Disparity(_) => 1.0 / v,
                DepthFile::Depth { scale, .. } => v * scale,
                DepthFile::Loaded { .. } => v,
            } as f32;
            *value = if v > 0.0 && z.is_finite() && z > 0.0 {
                z
            } else {
                0.0
            };
        }
        self.resized(map, "depth", path, size)
    }

    /// A mask of the training frames' `size`, 1 where something moves.
    fn mask(&mut self, file: &MaskFile, size: (usize, usize)) -> Result<Map, IoError> {
        let (map, path) = match file {
            MaskFile::File(path) => (read_map_for(path, Some(size), &mut self.notes)?, path),
            MaskFile::Loaded { mask, archive } => (mask.clone(), archive),
        };
        let mut map = self.resized(map, "mask", path, size)?;
        if self.inverted_masks {
            for value in &mut map.values {
                *value = if *value > 0.0 { 0.0 } else { 1.0 };
            }
        }
        Ok(map)
    }

    /// Finds the masks' largest value, which says how all are to be read, and drops them where they are empty in every frame. They
    /// are not kept, for they are large, but read once more later; mostly the first is enough, as a half is no small number.
    fn look_through_masks(
        &mut self,
        frames: &mut [PlannedFrame],
        sizes: &[Size],
    ) -> Result<(), IoError> {
        if frames.iter().all(|f| f.mask.is_none()) {
            return Ok(());
        }
        for (frame, &size) in frames.iter().zip(sizes) {
            if let Some(file) = &frame.mask {
                let values = self.mask(file, size)?.values;
                self.largest_mask = values.into_iter().fold(self.largest_mask, f32::max);
            }
            if self.largest_mask > 0.5 {
                return Ok(());
            }
        }
        if self.largest_mask < 0.5 / 255.0 {
            self.note("the masks are empty in every frame: nothing moves".into());
            frames.iter_mut().for_each(|f| f.mask = None);
        }
        Ok(())
    }

    /// A mask whose numbers of instances, if it has any, are 1. So it is before its lens is undone and before it is made smaller:
    /// no mean of such numbers says how much of a pixel moves.
    fn settled_mask(&mut self, file: &MaskFile, size: Size) -> Result<Map, IoError> {
        let mut map = self.mask(file, size)?;
        if let Some(told) = settle(std::iter::once(&mut map), self.largest_mask) {
            self.note(told);
        }
        Ok(map)
    }

    /// How much larger the training frames are, across and down, than the scene's own pictures, of which tracks are.
    fn scale_of_tracks(
        &mut self,
        own: &Picture,
        first: &PlannedView,
        size: Size,
    ) -> Result<[f64; 2], IoError> {
        let camera = &first.lens.camera;
        let own = match own {
            Picture::File(path) => read_size_for(path, Some((camera.width, camera.height)))?,
            Picture::Loaded { size, .. } => *size,
        };
        if own != size {
            self.note(format!(
                "tracks were scaled from {}x{}, the size of the scene's own pictures, to {}x{}",
                own.0, own.1, size.0, size.1
            ));
        }
        Ok([size.0 as f64 / own.0 as f64, size.1 as f64 / own.1 as f64])
    }

    /// A map of the same field of view at its picture's `size`: tools and sensors have sizes of their own.
    fn resized(
        &mut self,
        map: Map,
        what: &str,
        path: &Path,
        size: (usize, usize),
    ) -> Result<Map, IoError> {
        let found = (map.width, map.height);
        if found == size {
            return Ok(map);
        }
        if !has_aspect(found, size) {
            return Err(IoError::size(path, format!("the {what}"), found, size));
        }
        self.note(format!(
            "{what} was resized from {}x{} to {}x{} (nearest neighbour)",
            found.0, found.1, size.0, size.1
        ));
        Ok(resize_nearest(&map, size.0, size.1))
    }
}

/// An array [H, W] as a map; sides of length 1 around it do not matter.
pub(crate) fn read_array_map(path: &Path) -> Result<Map, IoError> {
    let array = read_npy(path)?;
    let sides: Vec<_> = if array.shape.len() == 2 {
        array.shape.clone()
    } else {
        array.shape.iter().copied().filter(|&s| s != 1).collect()
    };
    match sides[..] {
        [height, width] if height > 0 && width > 0 => Ok(Map {
            width,
            height,
            values: array.values,
        }),
        _ => Err(IoError::malformed(
            path,
            format!("the array has shape {:?}; [H, W] is expected", array.shape),
        )),
    }
}
