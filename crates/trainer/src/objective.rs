//! The training loss of one view: pose, render, blur, and the weighted terms.

use crate::TrainError;
use crate::losses;
use crate::model::{Model, constant};
use crate::trainer::Trainer;
use crate::views::{ViewRef, camera_of};
use bpnet::{
    BlurField, BlurInputs, BpNet, Composite, Extractor, cell_means, composite, kernel_center_loss,
};
use burn::tensor::Tensor;
use splat_core::{Extra, Rendered, Viewpoint, render};
use tracing::trace_span;

/// What a model shows of a view.
pub(crate) struct Shown {
    pub(crate) rendered: Rendered,
    /// What the blur made of it, where blur is modelled.
    blur: Option<Composite>,
    /// What the model says the camera saw, [H, W, 3].
    pub(crate) blurred: Tensor<3>,
}

impl Shown {
    /// What the camera saw. Holes take the picture itself, so that windows over them carry no false loss.
    pub(crate) fn target(&self, view: &ViewRef<'_>) -> Tensor<3> {
        let target = view.image(&self.blurred);
        match view.holes(&self.blurred.device()) {
            Some(holes) => {
                let shape = target.dims();
                target.mask_where(holes.expand(shape), self.blurred.clone().detach())
            }
            None => target,
        }
    }
}

/// The weighted terms of a view's loss by name, none of weight zero.
pub(crate) struct Objective {
    pub(crate) terms: Vec<(&'static str, Tensor<1>)>,
    /// The kernels' shifts by cell, for the gauge's table.
    pub(crate) shifts: Option<Tensor<2>>,
}

impl Objective {
    fn add(&mut self, name: &'static str, weight: f64, value: impl FnOnce() -> Tensor<1>) {
        if weight != 0.0 {
            self.terms.push((name, value().mul_scalar(weight)));
        }
    }
}

impl Trainer {
    /// The weighted terms of the loss of training frame `frame` at iteration `it` (1-based), each of shape `[1]`.
    ///
    /// `model` is the trainer's own or one like it, in f64 for example. What the gradient stops at comes from `fixed`: BP-Net's
    /// inputs, alpha under the depth, the intensity that kernels are pulled to. Training takes both to be its own; a check
    /// by finite differences moves `model` alone.
    ///
    /// # Errors
    /// The renderer or BP-Net refuses the model.
    ///
    /// # Panics
    /// Panics if there is no such frame.
    pub fn loss_terms(
        &self,
        model: &Model,
        fixed: &Model,
        it: usize,
        frame: usize,
    ) -> Result<Vec<(&'static str, Tensor<1>)>, TrainError> {
        let view = ViewRef::training(&self.scene, frame);
        let fixed = self.show(fixed, it, &view, None, None)?;
        let shown = self.show(model, it, &view, Some(&fixed.rendered), None)?;
        let target = shown.target(&view);
        Ok(self
            .objective(model, it, &view, &shown, &fixed, target)
            .terms)
    }

    /// What a model shows of a view. BP-Net sees `blur_sees`, or the render itself.
    pub(crate) fn show(
        &self,
        model: &Model,
        it: usize,
        view: &ViewRef<'_>,
        blur_sees: Option<&Rendered>,
        screen_grad: Option<Tensor<1>>,
    ) -> Result<Shown, TrainError> {
        let posed = trace_span!("pose").in_scope(|| model.pose(view.time));
        let viewpoint = Viewpoint {
            camera: camera_of(&self.scene, view.frame, self.near()),
            cam_from_world: view.pose(&model.means),
            sh_degree: self.schedule.sh_degree_at(it),
        };
        let extra = Extra {
            features: posed.dynamic,
            screen_grad,
        };
        let rendered =
            trace_span!("render").in_scope(|| render(posed.splats, &viewpoint, extra))?;
        let field = trace_span!("blur field")
            .in_scope(|| self.blur_field(model, it, view, blur_sees.unwrap_or(&rendered)))?;
        let sharp = rendered.color();
        let blur = field
            .map(|field| composite(sharp.clone(), &field))
            .transpose()?;
        let blurred = blur.as_ref().map_or(sharp, Composite::picture);
        Ok(Shown {
            rendered,
            blur,
            blurred,
        })
    }

    /// Kernel and intensity of every pixel, where blur is modelled. During the hold no graph is recorded.
    fn blur_field(
        &self,
        model: &Model,
        it: usize,
        view: &ViewRef<'_>,
        sees: &Rendered,
    ) -> Result<Option<BlurField>, TrainError> {
        let net = model.blur.as_ref();
        let Some(net) = net.filter(|_| self.schedule.is_blurred(it)) else {
            return Ok(None);
        };
        let inputs = blur_inputs(sees, self.survey.scene_size);
        let extractor = if self.settings.blur.train_extractor {
            Extractor::Trained
        } else {
            Extractor::Frozen
        };
        Ok(Some(if self.schedule.steps_blur(it) {
            net.forward(view.frame, &inputs, extractor)?
        } else {
            without_graph(net).forward(view.frame, &inputs, extractor)?
        }))
    }

    /// All terms of a view's loss; `fixed` as in [`Self::loss_terms`].
    pub(crate) fn objective(
        &self,
        model: &Model,
        it: usize,
        view: &ViewRef<'_>,
        shown: &Shown,
        fixed: &Shown,
        target: Tensor<3>,
    ) -> Objective {
        let mut objective = Objective {
            terms: Vec::new(),
            shifts: None,
        };
        self.add_image_terms(&mut objective, it, view, shown, fixed, target);
        self.add_motion_terms(&mut objective, model, view);
        objective
    }

    fn add_image_terms(
        &self,
        objective: &mut Objective,
        it: usize,
        view: &ViewRef<'_>,
        shown: &Shown,
        fixed: &Shown,
        target: Tensor<3>,
    ) {
        let weights = &self.settings.loss;
        let rendered = &shown.rendered;
        objective.add("image", 1.0, || {
            losses::photometric(shown.blurred.clone(), target.clone(), weights.ssim)
        });
        if let Some(depth) = view.depth {
            objective.add("depth", weights.depth, || {
                losses::depth_loss(
                    rendered.depth(),
                    &fixed.rendered.alpha(),
                    depth,
                    self.survey.scene_size,
                )
            });
        }
        if let (Some(mask), Some(dynamic)) = (view.mask, rendered.features()) {
            objective.add("mask", weights.mask, || {
                let band = losses::mask_band(view.width);
                losses::mask_loss(dynamic.squeeze_dim(2), mask, view.valid, band)
            });
        }
        let (Some(blur), Some(fixed)) = (&shown.blur, &fixed.blur) else {
            return;
        };
        if self.schedule.has_downsample(it) && !view.is_unseen() {
            objective.add("downsample", weights.downsample, || {
                losses::downsample_loss(rendered.color(), target, 4)
            });
        }
        if !self.schedule.steps_blur(it) {
            return;
        }
        if self.schedule.has_kernel_center(it) {
            objective.add("kernel_center", weights.kernel_center, || {
                kernel_center_loss(blur.center_weight(), fixed.intensity())
            });
            objective.add("intensity", weights.intensity, || {
                losses::intensity_penalty(blur.intensity())
            });
        }
        if view.is_unseen() || weights.gauge == 0.0 {
            return;
        }
        let [rows, columns] = self.settings.blur.gauge_cells;
        let shifts = cell_means(blur.centroid(), rows, columns);
        objective.add("gauge", weights.gauge, || {
            self.gauge.penalty(view.frame, shifts.clone())
        });
        objective.shifts = Some(shifts);
    }

    /// Smoothness of the motion, on positions divided by S.
    fn add_motion_terms(&self, objective: &mut Objective, model: &Model, view: &ViewRef<'_>) {
        let Some(motion) = &model.motion else {
            return;
        };
        let weights = &self.settings.loss;
        let size = self.survey.scene_size;
        objective.add("bases_acceleration", weights.bases_acceleration, || {
            motion_bases::bases_acceleration(&motion.bases, size)
        });
        let last = self.scene.frames.len() as f32 - 1.0;
        if last < 2.0 || model.num_dynamic == 0 {
            return;
        }
        let middle = view.time.clamp(1.0, last - 1.0);
        let means = model.dynamic_means();
        let times = [middle - 1.0, middle, middle + 1.0];
        let at = motion.bases.means_at(&motion.coefficients, &means, &times);
        let [before, now, after] = [&at[0], &at[1], &at[2]];
        objective.add("means_acceleration", weights.means_acceleration, || {
            motion_bases::means_acceleration(before, now, after, size)
        });
        objective.add("along_ray", weights.along_ray, || {
            motion_bases::along_ray(before, now, after, view.center(), size)
        });
    }
}

/// What BP-Net sees of a render: colour, disparity times S, dynamic mask.
pub(crate) fn blur_inputs(rendered: &Rendered, scene_size: f64) -> BlurInputs {
    let alpha = rendered.alpha().clamp_min(1e-3);
    let depth = (rendered.depth() / alpha).clamp_min(0.05 * scene_size);
    let mask = match rendered.features() {
        Some(dynamic) => dynamic.squeeze_dim(2),
        None => rendered.alpha().zeros_like(),
    };
    BlurInputs {
        color: rendered.color(),
        disparity: depth.recip().mul_scalar(scene_size),
        mask,
    }
}

/// The same network with constants for parameters.
fn without_graph(net: &BpNet) -> BpNet {
    let mut net = net.clone();
    for (_, parameter) in net.parameters_mut() {
        *parameter = constant(parameter);
    }
    net
}
