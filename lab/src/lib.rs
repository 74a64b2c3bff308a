//! The laboratory: studies of what every choice costs and gains, over scenes and seeds.
//!
//! A [`Study`] is a TOML file. It expands to [`Case`]s, each an ordinary `limpid train` whose folder is named by a hash of what
//! determines its result, so that nothing is run twice. A [`Plan`] holds them with a command each, for any scheduler;
//! [`run_all`] is the one for this machine. [`gather`] makes a [`Report`] of what is there, finished or not, and of what is [`Kept`].
//!
//! It knows no Burn and nothing of training: the program `limpid` is started, and its `metrics.json` read.

mod arrays;
mod children;
mod colmap;
mod copies;
mod engines;
mod error;
mod execute;
mod expand;
mod files;
mod gather;
mod hash;
mod kept;
mod local;
mod machine;
mod perturb;
mod plan;
mod plot;
mod poses;
mod report;
mod retake;
mod rows;
mod scenes;
mod score;
mod statistics;
mod study;
mod table;

pub use children::Children;
pub use engines::Engine;
pub use error::LabError;
pub use execute::{Failed, Outcome, execute};
pub use expand::{Arm, Case, Run, arms, cases};
pub use files::{write_json, write_whole};
pub use gather::gather;
pub use kept::Kept;
pub use local::{Tally, failure, run_all};
pub use machine::Machine;
pub use perturb::Perturb;
pub use plan::{Places, Plan, PlannedRun, Program};
pub use plot::draw;
pub use report::{Cell, FailedRun, Origin, Report, Row, SceneTable};
pub use scenes::Scenes;
pub use score::{Kind, Measured, Score};
pub use statistics::Summary;
pub use study::{BASELINE, Knob, Plot, Study, Truth, Variant};
pub use table::markdown;
