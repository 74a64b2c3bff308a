//! A scene: what both layouts are turned into.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec3};
use splat_core::Camera;

use crate::npy::read_npy;
use crate::picture::{read_depth_png, read_image, read_map};
use crate::resample::{
    resize_camera, resize_nearest, shrink_camera, shrink_depth, shrink_image, shrink_map,
};
use crate::tracks::TrackFiles;
use crate::{Image, IoError, Map, Tracks, nerfstudio, shape_of_motion};

/// How a scene is opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoadOptions {
    /// Pictures, maps, intrinsics and tracks are made this many times smaller (1 leaves them as they
    /// are): pictures and masks by averaging blocks, depth by averaging the blocks' valid disparity.
    /// Sides that are no multiple of it are cropped at the right and at the bottom.
    pub downscale: usize,
    /// Takes the training frames from this folder (relative to the scene) instead of their own, by
    /// file stem. Everything else stays.
    pub images: Option<PathBuf>,
    /// Nothing moves: masks and tracks are not read.
    pub static_scene: bool,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            downscale: 1,
            images: None,
            static_scene: false,
        }
    }
}

/// The layout that a scene was read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneFormat {
    /// `images/` and `flow3d_preprocessed/`, as Shape-of-Motion's users have them.
    ShapeOfMotion,
    /// nerfstudio's `transforms.json`.
    Nerfstudio,
}

/// A sparse 3D point of the structure from motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparsePoint {
    /// Position in the world, scene units.
    pub position: DVec3,
    /// sRGB in [0, 1].
    pub color: [f32; 3],
}

/// A picture with its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The file's stem (with its folders where stems repeat).
    pub name: String,
    /// Intrinsics for the (downscaled) picture.
    pub camera: Camera,
    /// Pose, OpenCV axes.
    pub cam_from_world: DAffine3,
    /// Time in units of training frames.
    pub time: f32,
    /// The picture.
    pub image: Image,
}

/// A training frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Picture, camera and time. The time is the frame's index.
    pub view: View,
    /// z-depth in scene units, 0 where missing. None when the scene has no depth.
    pub depth: Option<Map>,
    /// Dynamic mask in [0, 1], 1 where something moves. None when the scene has no masks, or when
    /// they are empty in every frame.
    pub mask: Option<Map>,
}

/// Everything that is known of a scene. All training frames have the same size.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The scene's folder.
    pub root: PathBuf,
    /// The folder's name.
    pub name: String,
    /// The layout it was read from.
    pub format: SceneFormat,
    /// The factor that everything was made smaller by.
    pub downscale: usize,
    /// Training frames in time order.
    pub frames: Vec<Frame>,
    /// Test views, for scoring only; empty when the scene has none.
    pub test: Vec<View>,
    /// Sparse points; empty when there are none.
    pub points: Vec<SparsePoint>,
    /// 2D tracks through the training frames; None when there are none.
    pub tracks: Option<Tracks>,
    /// What was resized, ignored or skipped, one sentence each, for the program to print.
    pub notes: Vec<String>,
}

impl Scene {
    /// Opens a scene as it is; see [`Scene::open_with`].
    ///
    /// # Errors
    /// As [`Scene::open_with`].
    pub fn open(dir: &Path) -> Result<Self, IoError> {
        Self::open_with(dir, &LoadOptions::default())
    }

    /// Opens a folder in either layout; `transforms.json` wins where both are there.
    ///
    /// # Errors
    /// [`IoError::Unrecognised`] says what was looked for; everything else that is missing, broken,
    /// of the wrong size or distorted has its own variant and names the file.
    pub fn open_with(dir: &Path, options: &LoadOptions) -> Result<Self, IoError> {
        if options.downscale == 0 {
            return Err(IoError::invalid(dir, "downscale must be at least 1"));
        }
        let root = dir.canonicalize().map_err(|e| IoError::access(dir, e))?;
        if root.join("transforms.json").is_file() {
            return assemble(root.clone(), nerfstudio::plan(&root, options)?, options);
        }
        let parts = ["images", "flow3d_preprocessed"];
        if parts.iter().all(|part| root.join(part).is_dir()) {
            return assemble(
                root.clone(),
                shape_of_motion::plan(&root, options)?,
                options,
            );
        }
        let found = match parts.iter().find(|part| root.join(part).is_dir()) {
            Some(part) => format!("only {part}/ is there"),
            None => "none of these is there".to_owned(),
        };
        Err(IoError::Unrecognised {
            looked_for: format!(
                "looked for transforms.json (nerfstudio), and for images/ with flow3d_preprocessed/ \
                 (Shape-of-Motion); {found}"
            ),
            path: dir.into(),
        })
    }
}

/// Where a frame's depth is.
pub(crate) enum DepthFile {
    /// An array of disparity, of the picture's size.
    Disparity(PathBuf),
    /// A 16-bit PNG or an array, in units of `scale` scene units, of any size.
    Depth { path: PathBuf, scale: f64 },
}

/// A view before its files are read. The camera may be for another size of the picture.
pub(crate) struct PlannedView {
    pub(crate) name: String,
    pub(crate) image: PathBuf,
    pub(crate) camera: Camera,
    /// The file that the camera is from, for messages.
    pub(crate) camera_file: PathBuf,
    pub(crate) cam_from_world: DAffine3,
    pub(crate) time: f32,
}

/// A training frame before its files are read.
pub(crate) struct PlannedFrame {
    pub(crate) view: PlannedView,
    pub(crate) depth: Option<DepthFile>,
    pub(crate) mask: Option<PathBuf>,
}

/// What a layout's reader finds out; the files are read by [`assemble`].
pub(crate) struct Plan {
    pub(crate) format: SceneFormat,
    pub(crate) frames: Vec<PlannedFrame>,
    pub(crate) test: Vec<PlannedView>,
    pub(crate) points: Vec<SparsePoint>,
    /// Masks are black where something moves, and anything else is white.
    pub(crate) inverted_masks: bool,
    /// Where the masks are from, for messages.
    pub(crate) masks_at: PathBuf,
    pub(crate) tracks: TrackFiles,
    pub(crate) notes: Vec<String>,
}

fn assemble(root: PathBuf, plan: Plan, options: &LoadOptions) -> Result<Scene, IoError> {
    let mut notes = plan.notes;
    let mut loader = Loader {
        factor: options.downscale,
        size: None,
        rescaled: false,
        resized_depth: false,
        largest_mask: 0.0,
    };

    let has_masks = plan.frames.iter().any(|f| f.mask.is_some());
    let stems: Vec<_> = plan.frames.iter().map(|f| f.view.name.clone()).collect();
    let tracks = if options.static_scene {
        if has_masks || plan.tracks.exist()? {
            notes.push("static scene asked for: masks and tracks are ignored".into());
        }
        None
    } else {
        plan.tracks.read(&stems, options.downscale)?
    };

    let mut frames = Vec::with_capacity(plan.frames.len());
    for planned in &plan.frames {
        let view = loader.view(&planned.view)?;
        let depth = match &planned.depth {
            Some(file) => Some(loader.depth(file)?),
            None => None,
        };
        let mask = match &planned.mask {
            Some(path) if !options.static_scene => Some(loader.mask(path, plan.inverted_masks)?),
            _ => None,
        };
        frames.push(Frame { view, depth, mask });
    }
    let mut test = Vec::with_capacity(plan.test.len());
    for planned in &plan.test {
        test.push(loader.view(planned)?);
    }

    settle_masks(&mut frames, loader.largest_mask, &mut notes);
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
    loader.explain(&mut notes);

    Ok(Scene {
        name: root
            .file_name()
            .map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned()),
        root,
        format: plan.format,
        downscale: options.downscale,
        frames,
        test,
        points: plan.points,
        tracks,
        notes,
    })
}

/// Masks that are empty in every frame count as none; masks stored as 0 and 1 of 255 are stretched; in
/// masks that hold small numbers (of instances, say) everything above 0 moves.
fn settle_masks(frames: &mut [Frame], largest: f32, notes: &mut Vec<String>) {
    const ONE_STEP: f32 = 1.0 / 255.0;
    if frames.iter().all(|f| f.mask.is_none()) {
        return;
    }
    if largest < 0.5 * ONE_STEP {
        notes.push("the masks are empty in every frame: nothing moves".into());
        for frame in frames {
            frame.mask = None;
        }
    } else if largest < 1.5 * ONE_STEP {
        notes.push("the masks hold 0 and 1 of 255: read as 0 and 255".into());
        for mask in frames.iter_mut().filter_map(|f| f.mask.as_mut()) {
            for value in &mut mask.values {
                *value /= largest;
            }
        }
    } else if largest <= 0.5 {
        notes.push(format!(
            "the masks' largest value is {:.0} of 255: read as numbers of instances, all above 0 moves",
            255.0 * largest
        ));
        for mask in frames.iter_mut().filter_map(|f| f.mask.as_mut()) {
            for value in &mut mask.values {
                *value = f32::from(*value >= 0.5 * ONE_STEP);
            }
        }
    }
}

/// Reads files and brings them to one size.
struct Loader {
    factor: usize,
    /// Size of the training frames' files, (width, height), from the first one.
    size: Option<(usize, usize)>,
    rescaled: bool,
    resized_depth: bool,
    /// Largest value of all masks at their own size.
    largest_mask: f32,
}

impl Loader {
    fn view(&mut self, planned: &PlannedView) -> Result<View, IoError> {
        let image = read_image(&planned.image)?;
        let found = (image.width, image.height);
        let expected = *self.size.get_or_insert(found);
        if found != expected {
            return Err(IoError::size(
                &planned.image,
                "the picture",
                found,
                expected,
            ));
        }
        if self.factor > image.width.min(image.height) {
            return Err(IoError::invalid(
                &planned.image,
                format!(
                    "downscale {} leaves nothing of {}x{}",
                    self.factor, found.0, found.1
                ),
            ));
        }
        let mut camera = planned.camera.clone();
        if (camera.width, camera.height) != found {
            let scale_x = image.width as f64 / camera.width as f64;
            let scale_y = image.height as f64 / camera.height as f64;
            // A side rounded to whole pixels may be off by one.
            let tolerance = 1.0 / image.width.min(image.height) as f64 + 1e-9;
            if (scale_x / scale_y - 1.0).abs() > tolerance {
                let what = format!(
                    "the picture has another aspect ratio than its camera in {}; it",
                    planned.camera_file.display()
                );
                let of_camera = (camera.width, camera.height);
                return Err(IoError::size(&planned.image, what, found, of_camera));
            }
            camera = resize_camera(&camera, image.width, image.height);
            self.rescaled = true;
        }
        let (camera, image) = if self.factor == 1 {
            (camera, image)
        } else {
            (
                shrink_camera(&camera, self.factor),
                shrink_image(&image, self.factor),
            )
        };
        Ok(View {
            name: planned.name.clone(),
            camera,
            cam_from_world: planned.cam_from_world,
            time: planned.time,
            image,
        })
    }

    fn training_size(&self) -> (usize, usize) {
        self.size
            .expect("a frame's picture is read before its maps")
    }

    fn depth(&mut self, file: &DepthFile) -> Result<Map, IoError> {
        let (path, mut map) = match file {
            DepthFile::Disparity(path) => (path, read_array_map(path)?),
            DepthFile::Depth { path, .. } => {
                let is_array = path
                    .extension()
                    .is_some_and(|e| e.eq_ignore_ascii_case("npy"));
                let map = if is_array {
                    read_array_map(path)?
                } else {
                    read_depth_png(path)?
                };
                (path, map)
            }
        };
        if let Some(at) = map.values.iter().position(|v| v.is_nan()) {
            let (x, y) = (at % map.width, at / map.width);
            return Err(IoError::not_a_number(
                path,
                format!("the value at column {x}, row {y},"),
            ));
        }
        for value in &mut map.values {
            let v = f64::from(*value);
            let z = match file {
                DepthFile::Disparity(_) => 1.0 / v,
                DepthFile::Depth { scale, .. } => v * scale,
            } as f32;
            *value = if v > 0.0 && z.is_finite() && z > 0.0 {
                z
            } else {
                0.0
            };
        }
        let (found, expected) = ((map.width, map.height), self.training_size());
        if found != expected {
            // A sensor's depth has its own size; an estimator's was made from the picture.
            let same_aspect = found.0 * expected.1 == found.1 * expected.0;
            if matches!(file, DepthFile::Disparity(_)) || !same_aspect {
                return Err(IoError::size(path, "the depth", found, expected));
            }
            map = resize_nearest(&map, expected.0, expected.1);
            self.resized_depth = true;
        }
        Ok(if self.factor == 1 {
            map
        } else {
            shrink_depth(&map, self.factor)
        })
    }

    /// A mask of the training frames' size, 1 where something moves, shrunk.
    fn mask(&mut self, path: &Path, inverted: bool) -> Result<Map, IoError> {
        let mut map = read_map(path)?;
        let (found, expected) = ((map.width, map.height), self.training_size());
        if found != expected {
            return Err(IoError::size(path, "the mask", found, expected));
        }
        for value in &mut map.values {
            if inverted {
                *value = if *value > 0.0 { 0.0 } else { 1.0 };
            }
            self.largest_mask = self.largest_mask.max(*value);
        }
        Ok(if self.factor == 1 {
            map
        } else {
            shrink_map(&map, self.factor)
        })
    }

    fn explain(&self, notes: &mut Vec<String>) {
        let Some((width, height)) = self.size else {
            return;
        };
        if self.rescaled {
            notes.push(format!(
                "intrinsics were scaled to the pictures' size {width}x{height}"
            ));
        }
        if self.resized_depth {
            notes.push(format!(
                "depth was resized to {width}x{height} (nearest neighbour)"
            ));
        }
        let f = self.factor;
        if width % f != 0 || height % f != 0 {
            notes.push(format!(
                "{width}x{height} is no multiple of {f}: cropped to {}x{} at the right and bottom",
                width / f * f,
                height / f * f
            ));
        }
    }
}

/// An array [H, W] as a map; sides of length 1 around it do not matter.
fn read_array_map(path: &Path) -> Result<Map, IoError> {
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
