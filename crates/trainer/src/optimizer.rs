//! Adam for every parameter, by name, and each parameter's learning rate.

use crate::adam::{AdamState, AdamStep, LearningRate, adam_step};
use crate::density::RowEdit;
use crate::schedule::{REFERENCE_ITERATIONS, Schedule};
use crate::settings::LearningRates;
use burn::tensor::Tensor;
use std::collections::BTreeMap;

/// Moments of all parameters, by the parameters' names.
#[derive(Clone, Debug, Default)]
pub(crate) struct Optimizer {
    pub(crate) states: BTreeMap<String, AdamState>,
}

impl Optimizer {
    /// Steps one parameter with its gradient, which is finite.
    pub(crate) fn step(
        &mut self,
        name: &str,
        parameter: &mut Tensor<2>,
        grad: Tensor<2>,
        rate: &LearningRate,
    ) {
        let state = self
            .states
            .entry(name.to_owned())
            .or_insert_with(|| AdamState::new(parameter));
        adam_step(parameter, grad, state, &AdamStep { rate, drawn: &[] });
    }

    /// Follows an edit of a parameter's rows.
    pub(crate) fn edit(&mut self, name: &str, edit: &RowEdit) {
        if let Some(state) = self.states.get_mut(name) {
            state.gather(edit);
        }
    }
}

/// Learning rates at an iteration.
pub(crate) struct Rates<'a> {
    pub(crate) rates: &'a LearningRates,
    pub(crate) schedule: &'a Schedule,
    pub(crate) scene_size: f64,
    pub(crate) sh_columns: usize,
}

impl Rates<'_> {
    /// The rate of a parameter (names as in [`crate::Model::parameters`]) at iteration `it`.
    pub(crate) fn of(&self, name: &str, it: usize) -> LearningRate {
        let r = self.rates;
        let decay = |share: f64, length: usize| self.schedule.decay(it, share, length);
        let motion = decay(r.motion_final_share, REFERENCE_ITERATIONS);
        LearningRate::Uniform(match name {
            "gaussians.means" => {
                let share = r.means_final / r.means;
                r.means * self.scene_size * decay(share, r.means_decay)
            }
            "gaussians.quats" => r.rotations,
            "gaussians.log_scales" => r.scales,
            "gaussians.opacity_logits" => r.opacity,
            "gaussians.sh" => {
                return LearningRate::first_and_rest(r.sh_dc, 3, r.sh_rest, self.sh_columns);
            }
            "motion.rots" => r.bases * motion,
            "motion.transls" => r.bases * motion * self.scene_size,
            "motion.coefficients" => r.coefficients * motion,
            _ => {
                let (share, length) = if self.schedule.iterations < REFERENCE_ITERATIONS {
                    (r.blur_short_run_share, REFERENCE_ITERATIONS)
                } else {
                    (r.blur_final_share, r.blur_decay)
                };
                let boost = self.schedule.short_run_boost(r.short_run_boost);
                r.blur * boost * decay(share, length)
            }
        })
    }
}
