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
//! io::write_ply("frame.ply".as_ref(), &trainer.model().gaussians(Some(0.0)))?;
//! # Ok(())
//! # }
//! ```

pub mod adam;
pub mod density;
pub mod losses;
pub mod metrics;
pub mod schedule;
pub mod settings;

#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod backends;
mod checkpoint;
mod cpu;
mod dynamics;
mod error;
mod evaluate;
mod gauge;
mod lifting;
mod model;
mod neighbors;
mod objective;
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod ops;
mod optimizer;
mod placement;
mod random;
mod step;
mod survey;
mod tensors;
mod trainer;
mod views;

pub use burn::tensor::Device;
pub use checkpoint::FILE_NAME as CHECKPOINT_FILE;
pub use error::TrainError;
pub use evaluate::{
    BlurredView, ColorMap, Evaluation, Figures, GaussianCounts, Scores, ViewScores,
};
pub use model::{Model, MotionModel, Posed};
pub use settings::Settings;
pub use step::StepReport;
pub use survey::{Survey, survey};
pub use trainer::Trainer;
