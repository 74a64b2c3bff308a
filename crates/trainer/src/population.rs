//! How the set of Gaussians changes: dynamic densification, density control and opacity reset, each at its moment.

use crate::density::{
    DensityOptions, DensityRows, DensityStats, RowEdit, add_to_rows, gather_rows, plan_density,
    reset_opacity, split_offsets,
};
use crate::dynamics::{densify, densify_share};
use crate::optimizer::edit_of;
use crate::parameter::Group;
use crate::plan::Plan;
use crate::random::{Purpose, generator};
use crate::run::Run;
use crate::state::State;
use crate::tensors::leaf;
use crate::tensors::{host, rows_from};
use crate::trainer::Trainer;
use burn::tensor::Tensor;
use io::Scene;
use tracing::trace_span;

/// Opacities are reset to at most this.
const RESET_OPACITY: f64 = 0.01;

impl Trainer {
    /// Changes the set of Gaussians at the end of iteration `it`.
    pub(crate) fn change_gaussians(&mut self, it: usize) {
        let _span = trace_span!("density control").entered();
        let densifies = self.run.plan.schedule.densify_dynamic_at == Some(it);
        let Run { plan, state, .. } = &mut self.run;
        if plan.schedule.controls_density(it) {
            let reserved = reserved(plan, &self.data.scene, it);
            state.control_density(plan, reserved, it);
        }
        // Behind density control, whose statistics begin anew by it.
        if densifies {
            self.densify_dynamic();
        }
        let Run { plan, state, .. } = &mut self.run;
        if plan.schedule.resets_opacity(it) {
            let world = &mut state.model.world;
            world.opacity_logits = reset_opacity(&world.opacity_logits, RESET_OPACITY);
            for (parameter, _) in state.model.parameters_mut() {
                if parameter.group == Group::OpacityLogits {
                    state.optimizer.zero_moments(&parameter);
                }
            }
        }
    }

    fn densify_dynamic(&mut self) {
        let Run {
            plan,
            state,
            device,
            ..
        } = &mut self.run;
        let (old, dynamic) = (state.model.num_gaussians(), state.model.num_dynamic());
        let room = plan.max_gaussians().saturating_sub(old);
        let world = state.model.world.detached();
        let Some(new) = densify(&world, &self.data.scene, &plan.settings, room, device) else {
            return;
        };
        let edit = RowEdit::append_dynamic(old, dynamic, &new.parents);
        let rows = new.gaussians;
        state.edit(&edit, |group, tensor, edit| {
            let rows = match group {
                Group::Means => &rows.means,
                Group::Quats => &rows.quats,
                Group::LogScales => &rows.log_scales,
                Group::OpacityLogits => &rows.opacity_logits,
                Group::Sh => &rows.sh,
                Group::MotionCoefficients
                | Group::BasisRotations
                | Group::BasisTranslations
                | Group::BlurNet
                | Group::CameraPath
                | Group::CameraFocus
                | Group::CameraAperture
                | Group::CameraShutter
                | Group::FrameOffset
                | Group::FrameGain => return gather_rows(tensor, edit),
            };
            insert_rows(tensor, dynamic, rows)
        });
    }
}

/// Room that density control leaves at iteration `it` for the dynamic densification to come.
fn reserved(plan: &Plan, scene: &Scene, it: usize) -> usize {
    let is_to_come = plan.schedule.densify_dynamic_at.is_some_and(|at| it <= at);
    if is_to_come {
        scene.frames.len() * densify_share(scene, &plan.settings)
    } else {
        0
    }
}

impl State {
    fn control_density(&mut self, plan: &Plan, reserved: usize, it: usize) {
        let g = &plan.settings.gaussians;
        let size = plan.survey.scene_size;
        let height = plan.views.train[0].camera.height as f64;
        let options = DensityOptions {
            grad_threshold: (g.gradient_threshold * 288.0 / height) as f32,
            split_scale: (g.split_scale * size) as f32,
            prune_scale: plan
                .schedule
                .prunes_scale(it)
                .then_some((g.prune_scale * size) as f32),
            prune_opacity: g.prune_opacity as f32,
            max_gaussians: plan.max_gaussians().saturating_sub(reserved),
        };
        let Judged {
            average,
            log_scales,
            quats,
            logits,
        } = self.judged();
        let edit = plan_density(
            &DensityRows {
                average: &average,
                log_scales: &log_scales,
                opacity_logits: &logits,
                num_dynamic: self.model.num_dynamic(),
            },
            &options,
        );
        let offsets = split_offsets(
            &edit,
            &log_scales,
            &quats,
            &mut generator(plan.settings.seed, Purpose::Split, it as u64),
        );
        if edit.is_identity(self.model.num_gaussians()) {
            self.forget_density(edit.len());
            return;
        }
        self.edit(&edit, |_, tensor, edit| gather_rows(tensor, edit));
        let world = &mut self.model.world;
        world.means = add_to_rows(&world.means, offsets.means);
        world.log_scales = add_to_rows(&world.log_scales, offsets.log_scales);
    }

    /// Edits the rows of all that has a row per Gaussian: parameters, by `new_rows`, their moments, and the statistics, which
    /// begin anew.
    fn edit(
        &mut self,
        edit: &RowEdit,
        new_rows: impl Fn(Group, &Tensor<2>, &RowEdit) -> Tensor<2>,
    ) {
        for (parameter, tensor) in self.model.parameters_mut() {
            if let Some(edit) = edit_of(&parameter, edit) {
                *tensor = new_rows(parameter.group, tensor, &edit);
                self.optimizer.edit(&parameter, &edit);
            }
        }
        self.model.world.num_dynamic = edit.num_dynamic;
        self.forget_density(edit.len());
    }

    /// Statistics begin anew, of so many Gaussians.
    fn forget_density(&mut self, rows: usize) {
        self.density = DensityStats::new(rows, &self.model.world.means.device());
    }

    /// What density control looks at: the device is waited for once.
    fn judged(&self) -> Judged {
        let world = &self.model.world;
        let plain = |tensor: &Tensor<2>| tensor.clone().inner();
        let table = Tensor::cat(
            vec![
                self.density.average().unsqueeze_dim(1),
                plain(&world.log_scales),
                plain(&world.quats),
                plain(&world.opacity_logits),
            ],
            1,
        );
        let mut judged = Judged::default();
        for row in host(table).as_chunks::<9>().0 {
            judged.average.push(row[0]);
            judged.log_scales.extend(&row[1..4]);
            judged.quats.extend(&row[4..8]);
            judged.logits.push(row[8]);
        }
        judged
    }
}

/// Rows of all Gaussians in main memory.
#[derive(Default)]
struct Judged {
    /// Mean screen-space gradients, `[N]`.
    average: Vec<f32>,
    /// [N, 3].
    log_scales: Vec<f32>,
    /// [N, 4].
    quats: Vec<f32>,
    /// Of opacities, `[N]`.
    logits: Vec<f32>,
}

/// `tensor` with `rows` inserted before row `at`: a new leaf.
fn insert_rows(tensor: &Tensor<2>, at: usize, rows: &Tensor<2>) -> Tensor<2> {
    let old = tensor.clone().inner();
    let mut parts = vec![old.clone().narrow(0, 0, at), rows.clone().inner()];
    parts.extend(rows_from(&old, at));
    leaf(Tensor::cat(parts, 0), tensor.is_autodiff())
}
