//! Trains a sharp scene that moves from one blurry handheld video: dynamic Gaussian splats, together
//! with a model of how every pixel was blurred.
//!
//! The paper is "Dynamic Gaussian Splatting from Defocused and Motion-blurred Monocular Videos" (NeurIPS 2025).
//!
//! ```no_run
//! use trainer::{Device, Settings, Trainer};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let scene = io::Scene::open("my-scene".as_ref())?;
//! let settings = Settings { iterations: 3000, ..Settings::default() };
//! let mut trainer = Trainer::new(scene, settings, &Device::flex())?;
//! while !trainer.is_done() {
//!     let report = trainer.step()?;
//!     // report.loss, report.psnr, trainer.model() …
//! }
//! trainer.save("checkpoint".as_ref())?;
//! io::write_ply("frame.ply".as_ref(), &trainer.run().gaussians(Some(0.0))?)?;
//! # Ok(())
//! # }
//! ```

pub mod adam;
pub mod check;
pub mod density;
pub mod losses;
pub mod metrics;
pub mod schedule;
pub mod settings;

mod alignment;
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod backends;
mod blur;
mod brightness;
mod changes;
mod checkpoint;
mod checksum;
mod columns;
mod corrections;
mod correspondence;
mod coverage;
mod cpu;
#[cfg(feature = "cube")]
mod cube;
mod dynamics;
mod error;
mod gpu;
mod grouping;
mod guarded;
mod held;
mod inputs;
mod length;
mod lifting;
mod look;
mod memory;
mod model;
mod neighbors;
mod objective;
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod ops;
mod optimizer;
mod parameter;
mod pixel_kernel;
mod placement;
mod plan;
mod population;
mod random;
mod readings;
mod rigid;
mod run;
mod saves;
mod scene_shift;
mod scores;
mod sent;
mod sharpness;
mod shot;
mod state;
mod statistics;
mod step;
mod survey;
mod tensors;
mod track_motion;
mod track_sample;
mod track_smoothing;
mod trainer;
mod trajectory;
mod true_kernels;
mod unseen;
mod views;
mod world;

pub use blur::{
    BlurFigures, BlurModel, Both, CameraBlur, CameraFigures, CameraFrame, KernelFigures,
    KernelView, Kernels, Spot, TakenView, ViewBlur,
};
pub use burn::tensor::Device;
pub use changes::{Change, Difference, differences};
pub use corrections::{Corrections, FrameCorrection};
pub use error::{CheckpointProblem, OtherScene, SceneProblem, TrainError, with_causes};
pub use glam;
pub use gpu::{Gpu, MemoryUse, NoGpu, Table};
pub use length::{Course, Kept, Start};
pub use lifting::Liftable;
pub use memory::MemoryNeed;
pub use model::Model;
pub use parameter::{Group, Parameter, Rows};
pub use pixel_kernel::PixelKernel;
pub use rigid::{RigidPart, RigidParts};
pub use run::{Layers, Run, TrainingView};
pub use saves::{FILE_NAME as CHECKPOINT_FILE, PREVIOUS_NAME as PREVIOUS_CHECKPOINT_FILE};
pub use scores::{ColorMap, Evaluation, Figures, GaussianCounts, Scores, ViewScores};
pub use settings::Settings;
pub use shot::Shot;
pub use step::StepReport;
pub use survey::{Survey, survey};
pub use track_motion::TrackMotion;
pub use trainer::Trainer;
pub use true_kernels::{KernelScore, KernelScores};
pub use unseen_views::{Orbit, PoseSpline};
pub use views::{CameraView, Views};
pub use world::{MotionArrays, MotionModel, Posed, World};
