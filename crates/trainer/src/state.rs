//! What changes from iteration to iteration. A checkpoint holds it whole.

use crate::density::DensityStats;
use crate::model::Model;
use crate::optimizer::Optimizer;

/// The state between two iterations.
#[derive(Clone, Debug)]
pub(crate) struct State {
    pub(crate) model: Model,
    pub(crate) optimizer: Optimizer,
    pub(crate) density: DensityStats,
    pub(crate) progress: Progress,
    /// What trials have decided so far, and why, for people.
    pub(crate) decisions: Vec<String>,
}

impl State {
    /// Before the first iteration.
    pub(crate) fn new(model: Model) -> Self {
        Self {
            density: DensityStats::new(model.num_gaussians(), &model.world.means.device()),
            optimizer: Optimizer::default(),
            progress: Progress::default(),
            decisions: Vec::new(),
            model,
        }
    }
}

/// Where a run is; with the seed it determines every draw to come.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Progress {
    /// Iterations done.
    pub(crate) iteration: usize,
    /// Training views shown.
    pub(crate) training_draws: usize,
    /// Unseen views shown.
    pub(crate) unseen_draws: usize,
    /// Seconds that training took.
    pub(crate) seconds: f64,
}
