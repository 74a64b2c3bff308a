//! One iteration: the loss of a view, backward, Adam, density control.

use crate::TrainError;
use crate::adam::{NonFiniteGradient, finite_gradient};
use crate::density::{
    DensityOptions, DensityStats, RowEdit, add_to_rows, gather_rows, plan_density, reset_opacity,
    split_offsets,
};
use crate::dynamics::{densify, densify_share};
use crate::model::{Model, host, rows_from};
use crate::objective::Objective;
use crate::optimizer::Rates;
use crate::random::{Purpose, generator};
use crate::real::leaf;
use crate::trainer::Trainer;
use crate::views::ViewRef;
use burn::tensor::{Gradients, Tensor};
use tracing::trace_span;

/// Opacities are reset to at most this.
const RESET_OPACITY: f64 = 0.01;

/// A run may always have so many Gaussians, however small its pictures.
const LEAST_MAX_GAUSSIANS: usize = 20_000;

/// What an iteration did.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// 1-based iteration.
    pub iteration: usize,
    /// The sum of all weighted terms.
    pub loss: f64,
    /// The weighted terms by name.
    pub terms: Vec<(&'static str, f64)>,
    /// PSNR of what the model says the camera saw against the frame, in dB.
    pub psnr: f64,
    /// Name of the view.
    pub view: String,
    /// Number of Gaussians after the iteration.
    pub gaussians: usize,
}

impl Trainer {
    /// Does one iteration.
    ///
    /// # Errors
    /// All iterations are done; a loss term or a gradient is not finite; the renderer refuses its input.
    /// After an error the trainer holds the state of the last whole iteration.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let _span = trace_span!("step").entered();
        if self.is_done() {
            return Err(TrainError::Finished {
                iterations: self.settings.iterations,
            });
        }
        let it = self.progress.iteration + 1;
        let unseen = self.schedule.is_unseen(it);
        let view = if unseen {
            self.next_unseen_view()
        } else {
            self.next_training_view()
        };
        let (frame, name) = (view.frame, view.name.to_owned());

        let gathers = self.schedule.gathers_density(it);
        let screen_grad = gathers
            .then(|| Tensor::<1>::zeros([self.model.num_gaussians()], &self.device).require_grad());
        let shown = self.show(&self.model, it, &view, None, screen_grad.clone())?;
        let target = shown.target(&view);
        let psnr = trace_span!("psnr").in_scope(|| current_psnr(&shown.blurred, &target));
        let Objective { terms, shifts } = trace_span!("losses")
            .in_scope(|| self.objective(&self.model, it, &view, &shown, &shown, target));

        let (names, values): (Vec<_>, Vec<_>) = terms.into_iter().unzip();
        let stacked = Tensor::cat(values, 0);
        let values: Vec<f64> = host(stacked.clone().detach())
            .into_iter()
            .map(f64::from)
            .collect();
        if values.iter().any(|v| !v.is_finite()) {
            return Err(self.find_fault(it, &view)?);
        }
        let mut grads = trace_span!("backward").in_scope(|| stacked.sum().backward());

        let norms = screen_grad.and_then(|screen| screen.grad_remove(&mut grads));
        // All are checked before one is stepped: after an error the state is whole.
        let Ok(gradients) = take_gradients(&self.model, &mut grads) else {
            return Err(self.find_fault(it, &view)?);
        };
        if let Some(norms) = norms {
            self.density
                .accumulate(&host(norms), &host(shown.rendered.radii()));
        }
        if let Some(shifts) = shifts {
            self.gauge.record(frame, shifts);
        }
        self.step_parameters(it, gradients);
        self.change_gaussians(it);

        self.progress.iteration = it;
        if unseen {
            self.progress.unseen_draws += 1;
        } else {
            self.progress.training_draws += 1;
        }
        Ok(StepReport {
            iteration: it,
            loss: values.iter().sum(),
            terms: names.into_iter().zip(values).collect(),
            psnr,
            view: name,
            gaussians: self.model.num_gaussians(),
        })
    }

    fn step_parameters(&mut self, it: usize, gradients: Vec<Option<Tensor<2>>>) {
        let _span = trace_span!("adam").entered();
        let rates = Rates {
            rates: &self.settings.learning_rates,
            schedule: &self.schedule,
            scene_size: self.survey.scene_size,
            sh_columns: self.model.sh.dims()[1],
        };
        for ((name, parameter), grad) in self.model.parameters_mut().into_iter().zip(gradients) {
            if let Some(grad) = grad {
                self.optimizer
                    .step(&name, parameter, grad, &rates.of(&name, it));
            }
        }
    }

    /// Says where a number that is not finite arose: goes back through each loss term by itself. Costs as many backward passes
    /// as there are terms, but only a run that stops pays them.
    fn find_fault(&self, it: usize, view: &ViewRef<'_>) -> Result<TrainError, TrainError> {
        let fault = |term, parameter: &str, problem| TrainError::NotFinite {
            iteration: it,
            view: view.name.to_owned(),
            term,
            parameter: parameter.to_owned(),
            problem,
        };
        let terms = || -> Result<_, TrainError> {
            let shown = self.show(&self.model, it, view, None, None)?;
            let target = shown.target(view);
            Ok(self
                .objective(&self.model, it, view, &shown, &shown, target)
                .terms)
        };
        for index in 0..=terms()?.len() {
            // Each pass back uses its graph up.
            let mut terms = terms()?;
            let (term, loss) = if index < terms.len() {
                terms.swap_remove(index)
            } else {
                let values = terms.into_iter().map(|(_, value)| value).collect();
                ("all", Tensor::cat(values, 0).sum())
            };
            let value = host(loss.clone().detach())[0];
            if let Err((parameter, problem)) = take_gradients(&self.model, &mut loss.backward()) {
                let problem = format!("the gradient is not finite ({problem})");
                return Ok(fault(term, &parameter, problem));
            }
            if !value.is_finite() {
                return Ok(fault(term, "none", format!("the loss is {value}")));
            }
        }
        let problem = "not finite at first, but finite when computed again".to_owned();
        Ok(fault("all", "none", problem))
    }

    /// Dynamic densification, density control and opacity reset, each at its moment.
    fn change_gaussians(&mut self, it: usize) {
        let _span = trace_span!("density control").entered();
        if self.schedule.densify_dynamic_at == Some(it) {
            self.densify_dynamic();
        }
        if self.schedule.controls_density(it) {
            self.control_density(it);
        }
        if self.schedule.resets_opacity(it) {
            self.model.opacity_logits = reset_opacity(&self.model.opacity_logits, RESET_OPACITY);
            if let Some(state) = self.optimizer.states.get_mut("gaussians.opacity_logits") {
                state.zero_moments();
            }
        }
    }

    /// The most Gaussians this run may have.
    fn max_gaussians(&self) -> usize {
        let per_pixel = self.settings.gaussians.max_per_pixel;
        if per_pixel == 0.0 {
            return usize::MAX;
        }
        let pixels = self.scene.frames[0].view.camera.num_pixels();
        LEAST_MAX_GAUSSIANS.max((per_pixel * pixels as f64) as usize)
    }

    /// Room that density control leaves at iteration `it` for the dynamic densification to come.
    fn reserved(&self, it: usize) -> usize {
        let is_to_come = self.schedule.densify_dynamic_at.is_some_and(|at| it < at);
        if is_to_come {
            self.scene.frames.len() * densify_share(&self.scene, &self.settings)
        } else {
            0
        }
    }

    fn control_density(&mut self, it: usize) {
        let g = &self.settings.gaussians;
        let size = self.survey.scene_size;
        let height = self.scene.frames[0].view.camera.height as f64;
        let options = DensityOptions {
            grad_threshold: (g.gradient_threshold * 288.0 / height) as f32,
            split_scale: (g.split_scale * size) as f32,
            prune_scale: self
                .schedule
                .prunes_scale(it)
                .then_some((g.prune_scale * size) as f32),
            prune_opacity: g.prune_opacity as f32,
            max_gaussians: self.max_gaussians().saturating_sub(self.reserved(it)),
        };
        let (log_scales, quats) = (
            host(self.model.log_scales.clone()),
            host(self.model.quats.clone()),
        );
        let logits = host(self.model.opacity_logits.clone());
        let edit = plan_density(
            &self.density.average(),
            &log_scales,
            &logits,
            self.model.num_dynamic,
            &options,
        );
        let offsets = split_offsets(
            &edit,
            &log_scales,
            &quats,
            &mut generator(self.settings.seed, Purpose::Split, it as u64),
        );
        self.density = DensityStats::new(edit.len());
        if edit.is_identity(self.model.num_gaussians()) {
            return;
        }
        for (name, parameter) in self.model.parameters_mut() {
            let Some(edit) = edit_of(&name, &edit) else {
                continue;
            };
            *parameter = gather_rows(parameter, &edit);
            self.optimizer.edit(&name, &edit);
        }
        self.model.means = add_to_rows(&self.model.means, offsets.means);
        self.model.log_scales = add_to_rows(&self.model.log_scales, offsets.log_scales);
        self.model.num_dynamic = edit.num_dynamic;
    }

    fn densify_dynamic(&mut self) {
        let (old, dynamic) = (self.model.num_gaussians(), self.model.num_dynamic);
        let room = self.max_gaussians().saturating_sub(old);
        let Some(new) = densify(&self.model, &self.scene, &self.settings, room, &self.device)
        else {
            return;
        };
        let edit = RowEdit::append_dynamic(old, dynamic, &new.parents);
        let rows = new.gaussians.by_name();
        for (name, parameter) in self.model.parameters_mut() {
            let Some(edit) = edit_of(&name, &edit) else {
                continue;
            };
            *parameter = match rows.get(name.as_str()) {
                Some(rows) => insert_rows(parameter, dynamic, rows),
                None => gather_rows(parameter, &edit),
            };
            self.optimizer.edit(&name, &edit);
        }
        self.model.num_dynamic = edit.num_dynamic;
        self.density = DensityStats::new(edit.len());
    }
}

/// The gradients of all parameters in their order, `None` for one that has none; or the first that is not finite, and where.
fn take_gradients(
    model: &Model,
    grads: &mut Gradients,
) -> Result<Vec<Option<Tensor<2>>>, (String, NonFiniteGradient)> {
    let _span = trace_span!("check gradients").entered();
    let take = |(name, parameter): (String, Tensor<2>)| {
        let grad = parameter.grad_remove(grads).map(finite_gradient);
        grad.transpose().map_err(|problem| (name, problem))
    };
    model.parameters().into_iter().map(take).collect()
}

/// What an edit of the Gaussians' rows means for a parameter; `None` for one that has no row per Gaussian.
fn edit_of(name: &str, edit: &RowEdit) -> Option<RowEdit> {
    if name.starts_with("gaussians.") {
        Some(edit.clone())
    } else {
        (name == "motion.coefficients").then(|| edit.dynamic())
    }
}

/// `tensor` with `rows` inserted before row `at`: a new leaf.
fn insert_rows(tensor: &Tensor<2>, at: usize, rows: &Tensor<2>) -> Tensor<2> {
    let old = tensor.clone().inner();
    let mut parts = vec![old.clone().narrow(0, 0, at), rows.clone().inner()];
    parts.extend(rows_from(&old, at));
    leaf(Tensor::cat(parts, 0), tensor.is_autodiff())
}

/// PSNR in dB of detached pictures.
fn current_psnr(a: &Tensor<3>, b: &Tensor<3>) -> f64 {
    let (a, b) = (host(a.clone().detach()), host(b.clone().detach()));
    let squares = a.iter().zip(&b).map(|(a, b)| f64::from(a - b).powi(2));
    let error = squares.sum::<f64>() / a.len() as f64;
    -10.0 * error.max(1e-12).log10()
}
