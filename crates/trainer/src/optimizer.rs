//! Adam for every parameter, by name, and each parameter's learning rate.

use crate::adam::{AdamState, AdamStep, LearningRate, adam_step};
use crate::density::RowEdit;
use crate::parameter::{Group, Parameter, Rows};
use crate::plan::Plan;
use crate::schedule::{REFERENCE_ITERATIONS, Schedule};
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
        parameter: &Parameter,
        tensor: &mut Tensor<2>,
        grad: Tensor<2>,
        step: &AdamStep<'_>,
    ) {
        let state = self
            .states
            .entry(parameter.name.clone())
            .or_insert_with(|| AdamState::of(tensor, parameter.rows()));
        adam_step(tensor, grad, state, step);
    }

    /// Forgets a parameter's moments; its step count stays.
    pub(crate) fn zero_moments(&mut self, parameter: &Parameter) {
        if let Some(state) = self.states.get_mut(&parameter.name) {
            state.zero_moments();
        }
    }

    /// Forgets the moments of some rows of a parameter; their step counts stay.
    pub(crate) fn zero_rows(&mut self, parameter: &Parameter, rows: &[usize]) {
        if let Some(state) = self.states.get_mut(&parameter.name) {
            state.zero_rows(rows);
        }
    }

    /// Follows an edit of a parameter's rows.
    pub(crate) fn edit(&mut self, parameter: &Parameter, edit: &RowEdit) {
        if let Some(state) = self.states.get_mut(&parameter.name) {
            state.gather(edit);
        }
    }
}

/// What an edit of the Gaussians' rows means for a parameter; `None` for one that has no row per Gaussian.
pub(crate) fn edit_of(parameter: &Parameter, edit: &RowEdit) -> Option<RowEdit> {
    match parameter.rows() {
        Rows::Gaussians => Some(edit.clone()),
        Rows::DynamicGaussians => Some(edit.dynamic()),
        Rows::Frames | Rows::Whole => None,
    }
}

/// The learning rate of a parameter at iteration `it`; `columns` are the parameter's, and of Gaussians so many move.
pub(crate) fn learning_rate(
    plan: &Plan,
    parameter: &Parameter,
    (columns, num_dynamic): (usize, usize),
    it: usize,
) -> LearningRate {
    let at_pace = |pace| rate_at_pace(plan, parameter.group, columns, it, pace);
    let schedule = &plan.schedule;
    match parameter.rows() {
        Rows::Gaussians => {
            let share = plan.settings.learning_rates.static_final_share;
            let rest = at_pace(pace_at_rest(schedule, parameter.group, share, it));
            at_pace(schedule.dynamic_pace()).then(num_dynamic, &rest, columns)
        }
        Rows::DynamicGaussians | Rows::Frames | Rows::Whole => at_pace(1.0),
    }
}

/// How many times as fast Gaussians that stand still learn at iteration `it`; means, whose rate falls by itself, do not settle.
fn pace_at_rest(schedule: &Schedule, group: Group, final_share: f64, it: usize) -> f64 {
    let left = match group {
        Group::Means => 1.0,
        // A run that was made longer keeps the rates of its schedule's end.
        _ => Schedule::settled(it.min(schedule.iterations), final_share),
    };
    schedule.static_pace() * left
}

/// The learning rate of a group with so many columns; what Gaussians are learns `pace` times as fast.
fn rate_at_pace(plan: &Plan, group: Group, columns: usize, it: usize, pace: f64) -> LearningRate {
    let (r, schedule) = (&plan.settings.learning_rates, &plan.schedule);
    let size = plan.survey.scene_size;
    let decay = |share: f64, length: usize| schedule.decay(it, share, length);
    let motion = decay(r.motion_final_share, REFERENCE_ITERATIONS);
    let camera = decay(r.camera_final_share, REFERENCE_ITERATIONS);
    LearningRate::Uniform(match group {
        Group::Means => {
            let start = r.means * pace;
            start * size * decay(r.means_final / start, r.means_decay)
        }
        Group::Quats => r.rotations * pace,
        Group::LogScales => r.scales * pace,
        Group::OpacityLogits => r.opacity * pace,
        Group::Sh => {
            let (dc, rest) = (r.sh_dc * pace, r.sh_rest * pace);
            return LearningRate::first_and_rest(dc, 3, rest, columns);
        }
        Group::BasisRotations => r.bases * motion,
        Group::BasisTranslations => r.bases * motion * size,
        Group::MotionCoefficients => r.coefficients * motion,
        Group::BlurNet => {
            let (share, length) = if schedule.iterations < REFERENCE_ITERATIONS {
                (r.blur_short_run_share, REFERENCE_ITERATIONS)
            } else {
                (r.blur_final_share, r.blur_decay)
            };
            r.blur * schedule.short_run_boost(r.short_run_boost) * decay(share, length)
        }
        Group::CameraPath => {
            return rigid(r.camera_path * camera * schedule.path_pace(), columns);
        }
        Group::CameraFocus => r.camera_focus * camera * schedule.path_pace().max(1.0),
        // Before its frames have found their focus an aperture shrinks to nothing, where it has no gradient.
        Group::CameraAperture if schedule.camera_settled >= Some(it) => 0.0,
        Group::CameraAperture => r.camera_aperture * camera,
        Group::CameraShutter => r.camera_shutter * camera,
        Group::FrameOffset => {
            let pace = schedule.path_pace().max(1.0);
            return rigid(r.frame_offset * camera * pace, columns);
        }
        Group::FrameGain => r.frame_gain * camera,
    })
}

/// A rate for turns, and a fifth of it for the translations (in units of S) beside them: in a narrow view the two
/// are nearly the same thing, and run off against each other at equal rates.
fn rigid(rate: f64, columns: usize) -> LearningRate {
    let rates = [rate, rate, rate, 0.2 * rate, 0.2 * rate, 0.2 * rate];
    LearningRate::PerColumn(rates.repeat(columns / 6))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::Modelled;
    use crate::settings::Settings;

    #[test]
    fn what_stands_still_settles_and_its_means_by_their_own_rule() {
        let modelled = Modelled {
            motion: false,
            unseen: false,
            blur_moments: vec![],
            camera_settled: None,
        };
        let of = |iterations| {
            let settings = Settings {
                iterations,
                ..Settings::default()
            };
            Schedule::new(&settings, 24, modelled.clone())
        };
        let (schedule, short) = (of(40_000), of(2000));
        let pace = |group, it| pace_at_rest(&schedule, group, 0.1, it) / schedule.static_pace();
        for group in [
            Group::Quats,
            Group::LogScales,
            Group::OpacityLogits,
            Group::Sh,
        ] {
            assert!((1..=1000).all(|it| pace(group, it) == 1.0));
            assert!((1000..3000).all(|it| pace(group, it) > pace(group, it + 1)));
            assert!((pace(group, 2000) - 0.25).abs() < 1e-12);
            assert!((pace(group, 40_000) - 0.1).abs() < 1e-12);
            assert!(pace_at_rest(&schedule, group, 1.0, 40_000) == schedule.static_pace());
            let end = pace_at_rest(&short, group, 0.1, 2000);
            assert_eq!(pace_at_rest(&short, group, 0.1, 3000), end, "made longer");
        }
        assert!((1..=3000).all(|it| pace(Group::Means, it) == 1.0));
    }
}
