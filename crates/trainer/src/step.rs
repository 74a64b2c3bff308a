//! One iteration: the loss of a view, backward, Adam, density control.

use crate::TrainError;
use crate::adam::{AdamState, AdamStep, NonFiniteGradient, finite_gradient};
use crate::blur::{BlurModel, Trace};
use crate::guarded::guarded;
use crate::look::Look;
use crate::metrics::SquaredError;
use crate::model::Model;
use crate::objective::Objective;
use crate::optimizer::learning_rate;
use crate::parameter::Parameter;
use crate::readings::Readings;
use crate::run::Run;
use crate::state::State;
use crate::tensors::host;
use crate::trainer::Trainer;
use crate::views::ViewRef;
use burn::tensor::{Gradients, Tensor};
use host::count_not_finite;
use std::mem;
use tracing::trace_span;

/// What an iteration did.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// 1-based iteration.
    pub iteration: usize,
    /// The sum of all weighted terms.
    pub loss: f64,
    /// The weighted terms by name.
    pub terms: Vec<(&'static str, f64)>,
    /// PSNR of what the model says the camera saw against the frame, over the pixels that have a target, in dB.
    pub psnr: f64,
    /// Name of the view.
    pub view: String,
    /// Number of Gaussians after the iteration.
    pub gaussians: usize,
    /// What was decided before the iteration, and why, for people.
    pub decided: Option<String>,
}

/// What was decided before an iteration, and what that changed as it was.
struct Revised {
    decided: Option<String>,
    blur: BlurModel,
    /// By the parameters' names.
    moments: Vec<(String, AdamState)>,
}

impl Revised {
    fn undo(self, state: &mut State) {
        state.model.blur = self.blur;
        state.optimizer.states.extend(self.moments);
    }
}

impl Trainer {
    /// Does one iteration.
    ///
    /// # Errors
    /// All iterations are done; a loss term or a gradient is not finite; the renderer refuses its input; the device fails.
    /// After an error the trainer holds the state of the last whole iteration, unless the device failed
    /// ([`TrainError::Device`]): then only checkpoints are left.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let device = self.run.device.clone();
        guarded(&device, || self.iterate())
    }

    fn iterate(&mut self) -> Result<StepReport, TrainError> {
        let _span = trace_span!("step").entered();
        if self.is_done() {
            return Err(TrainError::Finished {
                iterations: self.settings().iterations,
            });
        }
        let it = self.iteration() + 1;
        let revised = self.change_blur(it - 1)?;
        match (self.learn(it), revised) {
            (Ok(report), Some(Revised { decided, .. })) => {
                let behind = |decided: &String| format!("behind iteration {}: {decided}", it - 1);
                self.run
                    .state
                    .decisions
                    .extend(decided.as_ref().map(behind));
                Ok(StepReport { decided, ..report })
            }
            // The same trial comes again where the run goes on.
            (Err(error), Some(revised)) => {
                revised.undo(&mut self.run.state);
                Err(error)
            }
            (report, None) => report,
        }
    }

    /// Iteration `it` behind what the blur model does before it. All that can fail comes before anything is stepped: after an error
    /// the state is as it was.
    fn learn(&mut self, it: usize) -> Result<StepReport, TrainError> {
        let Run {
            plan,
            state,
            device,
            ..
        } = &self.run;
        let model = &state.model;
        let next = self.next_view(it)?;
        let view = next.view();
        let (frame, unseen) = (view.frame, view.is_unseen);
        let name = view.viewpoint.name.clone();

        let gathers = plan.schedule.gathers_density(it);
        let screen_grad =
            gathers.then(|| Tensor::<1>::zeros([model.num_gaussians()], device).require_grad());
        let look = Look {
            screen_grad: screen_grad.clone(),
            ..self.run.look_at(&view, it)
        };
        let shown = model.show(&look, None)?;
        let target = view.target(&shown.seen);
        let error =
            trace_span!("psnr").in_scope(|| SquaredError::of(&shown.seen, &target, view.valid));
        let objective = Objective {
            plan,
            world: &model.world,
            view: &view,
        };
        let terms = trace_span!("losses").in_scope(|| objective.terms(&shown, &shown, target));

        let (names, values): (Vec<_>, Vec<_>) = terms.0.into_iter().unzip();
        let stacked = Tensor::cat(values, 0);
        let mut grads = trace_span!("backward").in_scope(|| stacked.clone().sum().backward());
        let norms = screen_grad.and_then(|screen| screen.grad_remove(&mut grads));
        let gradients = take_gradients(model, &mut grads);

        let mut readings = Readings::default();
        let values = readings.add(stacked);
        let sums = readings.add(error.sums.clone());
        let lesson = shown.trace.as_ref().and_then(Trace::lesson);
        let lesson = lesson.map(|lesson| readings.add(lesson.flatten(0, 1)));
        let span = trace_span!("check gradients").entered();
        let counts = readings.add(count_all_not_finite(&gradients));
        let readings = readings.read()?;
        drop(span);
        let values = &readings[values];
        if values.iter().any(|v| !v.is_finite()) || readings[counts].iter().any(|n| *n != 0.0) {
            return Err(self.find_fault(it, &view)?);
        }
        let psnr = error.psnr(&readings[sums]);
        let state = &mut self.run.state;
        if let Some(norms) = norms {
            state.density.accumulate(norms, shown.radii);
        }
        if let Some(lesson) = lesson {
            let lesson = readings[lesson].iter().map(|v| *v as f32);
            state.model.blur.learned(frame, lesson.collect());
        }
        self.step_parameters(it, frame, gradients);
        self.run.state.model.blur.hold(it);
        self.run.state.model.corrections.hold();
        self.change_gaussians(it);

        let progress = &mut self.run.state.progress;
        progress.iteration = it;
        if unseen {
            progress.unseen_draws += 1;
        } else {
            progress.training_draws += 1;
        }
        Ok(StepReport {
            iteration: it,
            loss: values.iter().sum(),
            terms: names.into_iter().zip(values.iter().copied()).collect(),
            psnr,
            view: name,
            gaussians: self.model().num_gaussians(),
            decided: None,
        })
    }

    fn step_parameters(&mut self, it: usize, frame: usize, gradients: Vec<Option<Tensor<2>>>) {
        let _span = trace_span!("adam").entered();
        let Run { plan, state, .. } = &mut self.run;
        let num_dynamic = state.model.world.num_dynamic;
        for ((parameter, tensor), grad) in state.model.parameters_mut().into_iter().zip(gradients) {
            if let Some(grad) = grad {
                let sizes = (tensor.dims()[1], num_dynamic);
                let rate = learning_rate(plan, &parameter, sizes, it);
                let step = AdamStep {
                    rate: &rate,
                    drawn: &[frame],
                };
                state.optimizer.step(&parameter, tensor, grad, &step);
            }
        }
    }

    /// Lets the blur model do what it does once `it` iterations are done, if that is anything.
    fn change_blur(&mut self, it: usize) -> Result<Option<Revised>, TrainError> {
        let Self { run, data } = self;
        if !run.state.model.blur.revises(it) {
            return Ok(None);
        }
        let mut blur = run.state.model.blur.clone();
        let training = |frame| data.training_view(&run.plan.views, frame);
        let views: Vec<_> = (0..run.plan.views.train.len()).map(training).collect();
        let corrections = run.state.model.detached().corrections;
        let looks = views.iter().map(|view| run.look_at(view, it));
        let looks: Vec<_> = looks.map(|look| corrections.applied(&look)).collect();
        let revision = blur.revise(&run.state.model.world, &looks)?;
        let states = &run.state.optimizer.states;
        let moments = revision.changed.iter();
        let revised = Revised {
            decided: revision.decision.map(|decision| decision.to_string()),
            moments: moments
                .filter_map(|(p, _)| Some((p.name.clone(), states.get(&p.name)?.clone())))
                .collect(),
            blur: mem::replace(&mut run.state.model.blur, blur),
        };
        for (parameter, rows) in revision.changed {
            run.state.optimizer.zero_rows(&parameter, &rows);
        }
        Ok(Some(revised))
    }

    /// Says where a number that is not finite arose: goes back through each loss term by itself. Costs as many backward passes
    /// as there are terms, but only a run that stops pays them.
    fn find_fault(&self, it: usize, view: &ViewRef<'_>) -> Result<TrainError, TrainError> {
        let model = self.model();
        let fault = |term, parameter: Option<Parameter>, problem| TrainError::NotFinite {
            iteration: it,
            view: view.viewpoint.name.clone(),
            term,
            parameter: parameter.map(|p| p.name),
            problem,
        };
        let objective = Objective {
            plan: &self.run.plan,
            world: &model.world,
            view,
        };
        let terms = || -> Result<_, TrainError> {
            let shown = model.show(&self.run.look_at(view, it), None)?;
            Ok(objective.terms(&shown, &shown, view.target(&shown.seen)).0)
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
            if let Err((parameter, problem)) = check_gradients(model, &loss) {
                let problem = format!("the gradient is not finite ({problem})");
                return Ok(fault(term, Some(parameter), problem));
            }
            if !value.is_finite() {
                return Ok(fault(term, None, format!("the loss is {value}")));
            }
        }
        let problem = "not finite at first, but finite when computed again".to_owned();
        Ok(fault("all", None, problem))
    }
}

/// Names the first parameter to which a loss gives a gradient that is not finite.
fn check_gradients(model: &Model, loss: &Tensor<1>) -> Result<(), (Parameter, NonFiniteGradient)> {
    // A constant, such as the second differences of two frames, gives none and has no graph to go back through.
    if !loss.is_tracked() {
        return Ok(());
    }
    let gradients = take_gradients(model, &mut loss.backward());
    for ((parameter, _), gradient) in model.parameters().into_iter().zip(gradients) {
        let checked = gradient.map(finite_gradient).transpose();
        checked.map_err(|problem| (parameter, problem))?;
    }
    Ok(())
}

/// The gradients of all parameters in their order, `None` for one that has none.
fn take_gradients(model: &Model, grads: &mut Gradients) -> Vec<Option<Tensor<2>>> {
    let parameters = model.parameters().into_iter();
    parameters
        .map(|(_, tensor)| tensor.grad_remove(grads))
        .collect()
}

/// Numbers of entries of gradients that are not finite, for each part that is counted by itself.
fn count_all_not_finite(gradients: &[Option<Tensor<2>>]) -> Tensor<1> {
    Tensor::cat(
        gradients.iter().flatten().map(count_not_finite).collect(),
        0,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::corrections::Corrections;
    use crate::world::World;
    use burn::tensor::Device;

    #[test]
    fn a_constant_gives_no_gradient_and_a_fault_has_a_name() {
        let device = Device::flex().autodiff();
        let leaf = |columns| Tensor::<2>::ones([2, columns], &device).require_grad();
        let model = Model {
            world: World {
                means: leaf(3),
                quats: leaf(4),
                log_scales: leaf(3),
                opacity_logits: leaf(1),
                sh: leaf(3),
                num_dynamic: 0,
                motion: None,
            },
            blur: BlurModel::Off,
            corrections: Corrections::default(),
        };
        let constant = Tensor::<1>::zeros([1], &device);
        assert!(check_gradients(&model, &constant).is_ok());
        let loss = || model.world.quats.clone().sum();
        assert!(check_gradients(&model, &(loss() + constant)).is_ok());
        let fault = check_gradients(&model, &(loss() * f32::INFINITY));
        let (parameter, problem) = fault.expect_err("an infinite gradient");
        assert_eq!(parameter.name, "gaussians.quats");
        assert_eq!((problem.row, problem.column), (0, 0));
    }
}
