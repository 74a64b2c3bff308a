//! A scene: what every layout is turned into.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec3};
use splat_core::Camera;

use crate::{Image, Map, Tracks, Undistortion};

/// How a scene is opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoadOptions {
    /// Pictures, maps, intrinsics and tracks are made this many times smaller (1 leaves them as they
    /// are): pictures and masks by averaging blocks, depth by averaging the blocks' valid disparity.
    /// Sides that are no multiple of it are cropped at the right and at the bottom.
    pub downscale: usize,
    /// Takes the training frames from this folder (relative to the scene) instead of their own, by
    /// file stem. Everything else stays, brought to their size.
    pub images: Option<PathBuf>,
    /// Nothing moves: masks and tracks are not read, and need not be complete.
    pub static_scene: bool,
    /// Lens distortion is an error. Without this it is undone: pictures, depth, masks and tracks become
    /// those of a pinhole of the same size whose every pixel lies inside the source picture.
    pub refuse_distortion: bool,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            downscale: 1,
            images: None,
            static_scene: false,
            refuse_distortion: false,
        }
    }
}

/// A sparse 3D point of the structure from motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparsePoint {
    /// Position in the world, scene units.
    pub position: DVec3,
    /// sRGB in [0, 1].
    pub color: [f32; 3],
}

impl SparsePoint {
    /// The colour in 8 bits a channel, rounded and clamped.
    pub(crate) fn color_bytes(&self) -> [u8; 3] {
        self.color.map(|c| (255.0 * c).round() as u8)
    }
}

/// A picture with its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The file's stem (with its folders where stems repeat).
    pub name: String,
    /// Intrinsics for the (downscaled) picture.
    pub camera: Camera,
    /// The camera's pose, OpenCV axes.
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

/// Folders of truth; what is not there is not known.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TruthFolders {
    /// The training frames without blur.
    pub sharp: PathBuf,
    /// What of test views is seen by some training frame.
    pub covisible: PathBuf,
    /// What moves in test views.
    pub masks_test: PathBuf,
    /// z-depth of the training frames.
    pub depth: PathBuf,
    /// The cameras from which training frames collected their light.
    pub exposure: PathBuf,
}

impl TruthFolders {
    /// Those in `truth/` of a scene.
    pub(crate) fn of(root: &Path) -> Self {
        let truth = root.join("truth");
        Self {
            sharp: truth.join("images_sharp"),
            covisible: truth.join("covisible"),
            masks_test: truth.join("masks_test"),
            depth: truth.join("depth"),
            exposure: truth.join("exposure"),
        }
    }
}

/// Everything that is known of a scene. All training frames have the same size; test views have their own.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The scene's folder.
    pub root: PathBuf,
    /// The folder's name.
    pub name: String,
    /// The name of the layout it was read from, such as `nerfstudio`.
    pub layout: &'static str,
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
    /// What was undone of each training frame's lens, then of each test view's; empty where no lens
    /// distorts.
    pub undistorted: Vec<Option<Undistortion>>,
    /// Where what is known of its truth lies.
    pub truth_folders: TruthFolders,
    /// What was resized, ignored or skipped, one sentence each, for the program to print.
    pub notes: Vec<String>,
}

impl Scene {
    /// A scene of frames that are in memory, in time order, and of nothing else: what else is known is added to it.
    #[must_use]
    pub fn of_frames(frames: Vec<Frame>) -> Self {
        Self {
            root: PathBuf::new(),
            name: "scene".to_owned(),
            layout: "in memory",
            downscale: 1,
            frames,
            test: Vec::new(),
            points: Vec::new(),
            tracks: None,
            undistorted: Vec::new(),
            truth_folders: TruthFolders::default(),
            notes: Vec::new(),
        }
    }
}
