//! What can go wrong while training.

use std::error::Error;
use std::path::PathBuf;

/// An error and what caused it, on one line.
#[must_use]
pub fn with_causes(error: &dyn Error) -> String {
    let causes = std::iter::successors(Some(error), |&e| e.source());
    causes
        .map(ToString::to_string)
        .collect::<Vec<_>>()
        .join(": ")
}

/// An error of the trainer, with what to do about it. Causes are its `source`, and not in its text.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A setting is out of its range, unknown, or of the wrong type.
    #[error("setting `{key}`: {problem}")]
    Setting {
        /// Dotted name of the setting.
        key: String,
        /// What is wrong and what is allowed.
        problem: String,
    },
    /// The scene cannot be trained on.
    #[error("the scene cannot be trained on")]
    Scene(#[from] SceneProblem),
    /// A run is gone on with, or scored, on another scene than it was trained on.
    #[error("this is not the scene of the run")]
    OtherScene(#[from] OtherScene),
    /// A run cannot start from the given Gaussians.
    #[error(
        "training starts from at least one Gaussian of SH degree {degree}, before its first iteration; \
         given are {gaussians} of degree {found} at iteration {iteration}"
    )]
    StartFrom {
        /// Degree of the settings.
        degree: usize,
        /// Degree of the Gaussians.
        found: usize,
        /// Their number.
        gaussians: usize,
        /// Iterations done.
        iteration: usize,
    },
    /// A checkpoint cannot be used.
    #[error("checkpoint {}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        #[source]
        problem: CheckpointProblem,
    },
    /// Neither the last checkpoint nor the one before it can be used.
    #[error(
        "neither checkpoint can be used, and only a new run helps; {}: {older}; the last one",
        before.display()
    )]
    Checkpoints {
        /// The file of the one before.
        before: PathBuf,
        /// What is wrong with it, with its causes.
        older: String,
        /// What is wrong with the last one.
        #[source]
        last: Box<TrainError>,
    },
    /// Nothing was saved.
    #[error(
        "no checkpoint was saved in {} yet: there is nothing to go on from or to show; `limpid train` with --force and without --resume starts anew",
        folder.display()
    )]
    NoCheckpoint {
        /// The folder of the checkpoints.
        folder: PathBuf,
    },
    /// A setting is another than the run was started with, and may not be.
    #[error("`{setting}` is {here} here and {there} in the checkpoint: {advice}")]
    OtherSetting {
        /// Its dotted name.
        setting: String,
        /// What is asked for.
        here: String,
        /// What the run was trained with.
        there: String,
        /// What to do.
        advice: &'static str,
    },
    /// A file cannot be read or written.
    #[error(transparent)]
    Io(#[from] io::IoError),
    /// The splatting op refused its input.
    #[error("the renderer refuses its input")]
    Splat(#[source] splat_core::SplatError),
    /// The motion model refused its input.
    #[error("the motion model refuses its input")]
    Motion(#[from] motion_bases::MotionError),
    /// The blur model refused its configuration or its input.
    #[error("the blur model refuses its input")]
    Blur(#[from] bpnet::BpNetError),
    /// A loss term or a gradient is not finite.
    #[error(
        "iteration {iteration}, view {view}, loss term `{term}`{}: {problem}; \
         the state before this iteration is unharmed; look at the view, try a lower learning rate, \
         or go without the setting that was changed last",
        parameter.as_ref().map_or_else(String::new, |name| format!(", parameter `{name}`"))
    )]
    NotFinite {
        /// 1-based iteration.
        iteration: usize,
        /// Name of the view.
        view: String,
        /// Name of the loss term where it arose; "all" where each term by itself is finite.
        term: &'static str,
        /// Name of the parameter whose gradient is at fault; `None` where all gradients are finite.
        parameter: Option<String>,
        /// What is not finite, and where in it.
        problem: String,
    },
    /// The device failed: it is lost, or has no memory left.
    #[error(
        "the device failed ({reason}); --backend flex takes the CPU; a training goes on there from its last checkpoint by `limpid train --resume --backend flex`"
    )]
    Device {
        /// What it says.
        reason: String,
    },
    /// The first fit of the motion bases diverged.
    #[error(
        "first fit of the motion bases, step {step}: the gradient of {name} is not finite ({problem}); check the tracks and the depth"
    )]
    FirstFit {
        /// Step of the fit.
        step: usize,
        /// Name of the parameter.
        name: &'static str,
        /// Where in it.
        problem: crate::adam::NonFiniteGradient,
    },
    /// A picture cannot be taken like this.
    #[error("the picture cannot be taken: {problem}")]
    Shot {
        /// What is allowed.
        problem: &'static str,
    },
    /// All iterations are done.
    #[error(
        "all {iterations} iterations are done; --resume with more --iterations goes on behind its schedule, a new run has a longer one"
    )]
    Finished {
        /// The number of iterations.
        iterations: usize,
    },
}

impl From<splat_core::SplatError> for TrainError {
    fn from(error: splat_core::SplatError) -> Self {
        match error {
            splat_core::SplatError::Device { reason } => Self::Device { reason },
            error => Self::Splat(error),
        }
    }
}

impl TrainError {
    /// An out-of-range setting.
    pub(crate) fn setting(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Setting {
            key: key.into(),
            problem: problem.into(),
        }
    }
}

/// Why a scene cannot be trained on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneProblem {
    /// It has no frame.
    #[error("there is no training frame")]
    NoFrames,
    /// Nothing says where Gaussians start.
    #[error(
        "there is neither depth nor a sparse point in front of a camera, so nothing says where to place Gaussians; \
         add depth maps or sparse points (a COLMAP model with points; for transforms.json, `ply_file_path`)"
    )]
    NoDepth,
    /// No pixel is fit for a Gaussian.
    #[error("no Gaussian can be placed: all pixels are masked, on depth edges, or without depth")]
    NothingToPlace,
    /// Movers cannot be lifted.
    #[error(
        "there are masks and tracks of movers and no depth to lift them by (none is there, or none is over zero); \
         add depth maps, or ask for a static scene (--static), which ignores masks and tracks"
    )]
    MoversWithoutDepth,
    /// Movers' tracks lie where none can be lifted.
    #[error(
        "no track of a mover can be lifted: {found}; mend the tracks, the masks or the depth (`limpid check` looks at them), \
         or ask for a static scene (--static), which ignores masks and tracks"
    )]
    TracksNotLifted {
        /// How many of their positions are visible, in the picture, on a mask, and with depth.
        found: crate::lifting::Liftable,
    },
    /// An unseen view cannot be warped.
    #[error("unseen view {name}")]
    UnseenView {
        /// Its name.
        name: String,
        /// Why.
        source: unseen_views::WarpError,
    },
}

/// Why a scene is not the one that a run was trained on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OtherScene {
    /// It has another number of frames.
    #[error(
        "the run was trained on {trained} frames and the scene has {found}; \
         --scene must be the scene that it was trained on, as it was then"
    )]
    OtherFrames {
        /// Frames of the run.
        trained: usize,
        /// Frames of the scene.
        found: usize,
    },
    /// A view differs in anything but its picture.
    #[error(
        "view {view} has another name, time, camera, pose or size than in training; \
         --scene must be the scene that it was trained on, as it was then"
    )]
    OtherView {
        /// Name of the first view that differs.
        view: String,
    },
    /// Something of it was replaced.
    #[error(
        "{what} is not what the run was trained on; put back what was there, or start anew (--force)"
    )]
    OtherInput {
        /// What, by the name of its frame.
        what: String,
    },
    /// Its depth says that it has another size.
    #[error(
        "the scene's size is {found} and was {trained} in training; --scene must be the scene that it was trained on, as it was then"
    )]
    OtherSize {
        /// Size of the scene.
        found: f64,
        /// Size in training.
        trained: f64,
    },
    /// There are unseen views now and there were none in training, or the other way round.
    #[error("it gives {found} unseen views: its depth or its masks are others than in training")]
    UnseenViews {
        /// Unseen views that the scene gives.
        found: usize,
    },
}

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointProblem {
    /// The file cannot be read.
    #[error("it cannot be read")]
    Unreadable(#[from] std::io::Error),
    /// It is no safetensors file, or was cut.
    #[error("it is not a whole safetensors file")]
    NotWhole(#[from] safetensors::SafeTensorError),
    /// Another program wrote it.
    #[error("it is no checkpoint of limpid")]
    Foreign,
    /// Another version wrote it.
    #[error(
        "it has {found}, this program reads {expected}; use the version that wrote it, or start anew"
    )]
    Format {
        /// The file's, in words.
        found: String,
        /// Format of this version.
        expected: u32,
    },
    /// A byte of it is another than when it was written.
    #[error("it is damaged: its checksum does not hold")]
    Damaged,
    /// Its header is broken.
    #[error("its header does not parse")]
    Header(#[from] serde_json::Error),
    /// A setting in it is out of its range.
    #[error("its settings are out of range")]
    Settings(#[source] Box<TrainError>),
    /// The blur model of its settings cannot be made.
    #[error("its blur model cannot be made")]
    Blur(#[source] Box<TrainError>),
    /// A tensor is missing.
    #[error("tensor {0} is missing; it is not whole")]
    Missing(String),
    /// A tensor has another type.
    #[error("tensor {tensor} is {found} and should be F32")]
    Type {
        /// Its name.
        tensor: String,
        /// Its type.
        found: String,
    },
    /// A tensor has not two axes.
    #[error("tensor {tensor} is {found:?} and should have two axes")]
    Axes {
        /// Its name.
        tensor: String,
        /// Its shape.
        found: Vec<usize>,
    },
    /// A tensor has another shape.
    #[error("tensor {tensor} is {found:?} and should be {expected:?}")]
    Shape {
        /// Its name.
        tensor: String,
        /// Its shape.
        found: Vec<usize>,
        /// The shape that fits the rest.
        expected: Vec<usize>,
    },
    /// Adam's moments or steps do not fit their parameter.
    #[error("the moments of {parameter} do not fit it")]
    Moments {
        /// Its name.
        parameter: String,
    },
    /// A tensor holds a number that is none.
    #[error("tensor {tensor} has {value} in row {row}")]
    NotFinite {
        /// Its name.
        tensor: String,
        /// The first such value.
        value: f32,
        /// Its row.
        row: usize,
    },
    /// It does not go with the scene.
    #[error("it does not go with the scene")]
    Scene(#[source] OtherScene),
    /// Its parts contradict each other.
    #[error("{0}")]
    Contradiction(&'static str),
}
