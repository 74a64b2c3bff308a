//! What can go wrong while training.

use std::path::PathBuf;

/// An error of the trainer, with what to do about it.
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
    #[error("scene: {0}")]
    Scene(String),
    /// A checkpoint cannot be used.
    #[error("checkpoint {path}: {problem}", path = path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        problem: String,
    },
    /// A file cannot be read or written.
    #[error(transparent)]
    Io(#[from] io::IoError),
    /// The splatting op refused its input.
    #[error("rendering: {0}")]
    Splat(#[from] splat_core::SplatError),
    /// The motion model refused its input.
    #[error("motion: {0}")]
    Motion(#[from] motion_bases::MotionError),
    /// The blur model refused its configuration.
    #[error("blur model: {0}")]
    Blur(#[from] bpnet::BpNetError),
    /// A loss term or a gradient is not finite.
    #[error(
        "iteration {iteration}, view {view}, loss term `{term}`, parameter `{parameter}`: {problem}; \
         the state before this iteration is unharmed and can be saved; look at the view, try a lower learning rate, \
         or go without the setting that was changed last"
    )]
    NotFinite {
        /// 1-based iteration.
        iteration: usize,
        /// Name of the view.
        view: String,
        /// Name of the loss term where it arose; "all" where each term by itself is finite.
        term: &'static str,
        /// Name of the parameter whose gradient is at fault; "none" where all gradients are finite.
        parameter: String,
        /// What is not finite, and where in it.
        problem: String,
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
    /// All iterations are done.
    #[error(
        "all {iterations} iterations are done; raise `iterations` in a new run to train for longer"
    )]
    Finished {
        /// The number of iterations.
        iterations: usize,
    },
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
