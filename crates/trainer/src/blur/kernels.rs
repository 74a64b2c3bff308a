//! The paper's blur model: a kernel and an intensity per pixel, predicted by BP-Net from the sharp render.

use super::gauge::Gauge;
use crate::TrainError;
use crate::look::{Look, Shown, Terms, render_sharp};
use crate::losses;
use crate::parameter::{Group, Parameter};
use crate::random::{Purpose, derived_seed};
use crate::schedule::scaled_moment;
use crate::settings::Settings;
use crate::tensors::{constant, host};
use crate::views::Views;
use crate::world::World;
use bpnet::{
    BlurField, BlurInputs, BpNet, BpNetConfig, Composite, Extractor, HeadInit, cell_means,
    composite_trusted, kernel_center_loss,
};
use burn::tensor::{DType, Device, Tensor};
use io::Map;
use serde::{Deserialize, Serialize};
use splat_core::Rendered;
use std::fmt;
use tracing::trace_span;

/// BP-Net, the gauge that holds its kernels in place, and when what of it counts.
#[derive(Clone, Debug)]
pub struct Kernels {
    net: BpNet,
    gauge: Gauge,
    weights: Weights,
    moments: Moments,
    extractor: Extractor,
    /// Scene size S, scene units.
    scene_size: f64,
}

/// What a checkpoint holds of kernels beside their parameters: the gauge's table.
const TABLE: &str = "gauge";

/// Weights of its own terms.
#[derive(Clone, Copy, Debug)]
struct Weights {
    kernel_center: f64,
    intensity: f64,
    gauge: f64,
    downsample: f64,
}

/// Iterations after which something begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Moments {
    /// Blur is modelled.
    from: usize,
    /// BP-Net is stepped.
    step_from: usize,
    /// L_spa and the intensity penalty count.
    kernel_center_from: usize,
    /// The downsample loss counts.
    downsample_from: usize,
}

impl Moments {
    /// Of a run in which blur is modelled so not before `earliest`.
    fn new(settings: &Settings, earliest: usize) -> Self {
        let n = settings.iterations;
        let at = |moment| scaled_moment(moment, n);
        let from = at(settings.blur.from).max(250.min(n / 4)).max(earliest);
        Self {
            from,
            step_from: from.saturating_add(settings.blur.hold.min(n / 8)),
            kernel_center_from: at(settings.loss.kernel_center_from)
                .max(from.saturating_add(500.min(n / 4))),
            downsample_from: from.saturating_add(at(settings.loss.downsample_after)),
        }
    }
}

/// What it keeps of a view that it showed.
#[derive(Clone, Debug)]
pub(crate) struct KernelTrace {
    field: BlurField,
    composite: Composite,
    /// The kernels' shifts by cell, for the gauge's table; `None` where the gauge does not count.
    shifts: Option<Tensor<2>>,
}

impl Kernels {
    /// Kernels that begin after the iteration `earliest`, or where the settings say, whichever is later; with heads as in `mild`,
    /// unless the settings ask for a framework's.
    pub(super) fn new(
        settings: &Settings,
        scene_size: f64,
        views: &Views,
        (earliest, mild): (usize, HeadInit),
        (device, dtype): (&Device, DType),
    ) -> Result<Self, TrainError> {
        let (blur, loss) = (&settings.blur, &settings.loss);
        let num_frames = views.train.len();
        let config = BpNetConfig {
            kernel_size: blur.kernel_size,
            num_frames,
            shortcut: blur.shortcut,
            downscale: blur.downscale,
            head: if blur.mild_start {
                mild
            } else {
                HeadInit::Framework
            },
            seed: derived_seed(settings.seed, Purpose::BlurModel),
        };
        Ok(Self {
            net: BpNet::new(&config, device, dtype)?,
            gauge: Gauge::new(blur.gauge_cells, num_frames),
            weights: Weights {
                kernel_center: loss.kernel_center,
                intensity: loss.intensity,
                gauge: loss.gauge,
                downsample: loss.downsample,
            },
            moments: Moments::new(settings, earliest),
            extractor: if blur.train_extractor {
                Extractor::Trained
            } else {
                Extractor::Frozen
            },
            scene_size,
        })
    }

    /// Whether frames are blurred at iteration `it`, or once `it` iterations are done.
    pub(super) fn is_on(&self, it: usize) -> bool {
        it > self.moments.from
    }

    /// The iteration after which frames are blurred.
    pub(super) fn begins_behind(&self) -> usize {
        self.moments.from
    }

    /// The iteration after which BP-Net is trained: it only runs forward before that.
    pub(super) fn trained_behind(&self) -> usize {
        self.moments.step_from
    }

    pub(super) fn moments(&self) -> [usize; 4] {
        let m = &self.moments;
        [m.from, m.step_from, m.kernel_center_from, m.downsample_from]
    }

    /// See [`super::BlurModel::show`].
    pub(super) fn show(
        &self,
        world: &World,
        look: &Look<'_>,
        fixed: Option<(&Rendered, Option<&KernelTrace>)>,
    ) -> Result<Shown<KernelTrace>, TrainError> {
        let (mut shown, trace) =
            self.over(Shown::sharp(render_sharp(world, look)?), look, fixed)?;
        shown.trace = trace;
        Ok(shown)
    }

    /// Blurs what is shown, and adds its own terms. Kernels are predicted from the sharp render.
    ///
    /// `fixed` is what the gradient stops at, where that is not what is shown: BP-Net's inputs and the intensity
    /// that L_spa pulls kernels to.
    pub(super) fn over<T>(
        &self,
        mut shown: Shown<T>,
        look: &Look<'_>,
        fixed: Option<(&Rendered, Option<&KernelTrace>)>,
    ) -> Result<(Shown<T>, Option<KernelTrace>), TrainError> {
        let Some(frame) = look.frame.filter(|_| self.is_on(look.iteration)) else {
            return Ok((shown, None));
        };
        let sees = fixed.map_or(&shown.rendered, |(rendered, _)| rendered);
        let field =
            trace_span!("blur field").in_scope(|| self.field(frame, sees, look.iteration))?;
        let composite = composite_trusted(shown.seen, &field)?;
        let fixed_intensity = fixed.and_then(|(_, trace)| trace).map_or_else(
            || composite.intensity(),
            |trace| trace.composite.intensity(),
        );
        let mut trace = KernelTrace {
            field,
            composite,
            shifts: None,
        };
        let terms = self.terms(look, &shown.rendered, &mut trace, fixed_intensity);
        shown.terms.0.extend(terms.0);
        shown.seen = trace.composite.picture();
        Ok((shown, Some(trace)))
    }

    /// Kernel and intensity of every pixel. During the hold no graph is recorded.
    fn field(&self, frame: usize, sees: &Rendered, it: usize) -> Result<BlurField, TrainError> {
        let inputs = self.inputs(sees);
        Ok(if it > self.moments.step_from {
            self.net.forward_trusted(frame, &inputs, self.extractor)?
        } else {
            let mut net = self.net.clone();
            for (_, parameter) in net.parameters_mut() {
                *parameter = constant(parameter);
            }
            net.forward_trusted(frame, &inputs, self.extractor)?
        })
    }

    /// What BP-Net sees of a render: colour, disparity times S, dynamic mask.
    fn inputs(&self, rendered: &Rendered) -> BlurInputs {
        let alpha = rendered.alpha().clamp_min(1e-3);
        let depth = (rendered.depth() / alpha).clamp_min(0.05 * self.scene_size);
        let mask = match rendered.features() {
            Some(dynamic) => dynamic.squeeze_dim(2),
            None => rendered.alpha().zeros_like(),
        };
        BlurInputs {
            color: rendered.color(),
            disparity: depth.recip().mul_scalar(self.scene_size),
            mask,
        }
    }

    /// The terms of a view's loss that kernels have; `fixed_intensity` is what L_spa pulls them to.
    fn terms(
        &self,
        look: &Look<'_>,
        rendered: &Rendered,
        trace: &mut KernelTrace,
        fixed_intensity: Tensor<2>,
    ) -> Terms {
        let mut terms = Terms::default();
        let Some(view) = look.view else {
            return terms;
        };
        let (it, blur) = (look.iteration, &trace.composite);
        if it > self.moments.downsample_from && !view.is_unseen {
            terms.add("downsample", self.weights.downsample, || {
                let sharp = look.gained(rendered.color());
                let target = view.target(&sharp);
                losses::downsample_loss(sharp, target, 4)
            });
        }
        if it <= self.moments.step_from {
            return terms;
        }
        if it > self.moments.kernel_center_from {
            terms.add("kernel_center", self.weights.kernel_center, || {
                kernel_center_loss(blur.center_weight(), fixed_intensity)
            });
            terms.add("intensity", self.weights.intensity, || {
                losses::intensity_penalty(blur.intensity())
            });
        }
        if view.is_unseen || self.weights.gauge == 0.0 {
            return terms;
        }
        let [rows, columns] = self.gauge.cells;
        let shifts = cell_means(blur.centroid(), rows, columns);
        terms.add("gauge", self.weights.gauge, || {
            self.gauge.penalty(view.frame, shifts.clone())
        });
        trace.shifts = Some(shifts);
        terms
    }

    /// See [`super::BlurModel::learned`].
    pub(super) fn learned(&mut self, frame: usize, shifts: Vec<f32>) {
        self.gauge.record(frame, shifts);
    }

    pub(super) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        let parameters = self.net.parameters_mut().into_iter();
        let named = parameters.map(|(name, tensor)| {
            (
                Parameter::new(format!("blur.{name}"), Group::BlurNet),
                tensor,
            )
        });
        named.collect()
    }

    pub(super) fn table(&self, device: &Device) -> (&'static str, Tensor<2>) {
        (TABLE, self.gauge.to_tensor(device))
    }

    pub(super) fn restore<E>(
        &mut self,
        read: &mut impl FnMut(&str, [usize; 2]) -> Result<Tensor<2>, E>,
    ) -> Result<(), E> {
        let [rows, columns] = self.gauge.cells;
        let shape = [self.net.num_frames(), 1 + 2 * rows * columns];
        self.gauge = Gauge::from_tensor(self.gauge.cells, read(TABLE, shape)?);
        Ok(())
    }
}

/// How a view was blurred, for pictures and figures.
#[derive(Clone, Debug)]
pub struct KernelView {
    /// Blur intensity m per pixel.
    pub intensity: Map,
    /// Kernels, [H, W, K²], K² weights per pixel.
    pub kernels: Vec<f32>,
    /// Mean of m Σ k Δx over the pixels (px; x, y).
    pub centroid: [f64; 2],
}

impl KernelTrace {
    /// The kernels' mean shift per cell, where the view counts for the gauge.
    pub(super) fn shifts(&self) -> Option<Tensor<2>> {
        self.shifts.clone()
    }

    pub(super) fn view(&self) -> KernelView {
        let [height, width, _] = self.composite.picture().dims();
        let mut mean = [0.0; 2];
        for shift in host(self.composite.centroid()).chunks_exact(2) {
            mean[0] += f64::from(shift[0]);
            mean[1] += f64::from(shift[1]);
        }
        KernelView {
            intensity: Map {
                width,
                height,
                values: host(self.field.intensity()),
            },
            kernels: host(self.field.kernel()),
            centroid: mean.map(|m| m / (width * height) as f64),
        }
    }
}

/// Figures of [`BlurModel::Kernels`](super::BlurModel::Kernels) over all training frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KernelFigures {
    /// Length of the mean of m Σ k Δx over all pixels of all training frames, px.
    pub kernel_centroid_px: f64,
    /// Mean blur intensity m over all pixels of all training frames.
    pub mean_intensity: f64,
}

impl fmt::Display for KernelFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (m, shift) = (self.mean_intensity, self.kernel_centroid_px);
        write!(
            f,
            "mean blur intensity {m:.2}, kernels' common shift {shift:.2} px"
        )
    }
}

/// What [`KernelFigures`] are the means of.
#[derive(Debug, Default)]
pub(super) struct KernelSums {
    count: usize,
    shift: [f64; 2],
    intensity: f64,
}

impl KernelSums {
    pub(super) fn add(&mut self, view: &KernelView) {
        self.count += 1;
        let [x, y] = view.centroid;
        self.shift = [self.shift[0] + x, self.shift[1] + y];
        let values = &view.intensity.values;
        self.intensity += values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
    }

    /// `None` of no view.
    pub(super) fn means(&self) -> Option<KernelFigures> {
        let count = self.count as f64;
        (self.count > 0).then(|| KernelFigures {
            kernel_centroid_px: self.shift[0].hypot(self.shift[1]) / count,
            mean_intensity: self.intensity / count,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::{Modelled, Schedule};

    fn moments(n: usize) -> [usize; 4] {
        let settings = Settings {
            iterations: n,
            ..Settings::default()
        };
        let m = Moments::new(&settings, 0);
        [m.from, m.step_from, m.kernel_center_from, m.downsample_from]
    }

    #[test]
    fn moments_are_the_papers_and_keep_their_distances_in_short_runs() {
        assert_eq!(moments(40_000), [3500, 3700, 5500, 4500]);
        assert_eq!(moments(3000), [262, 462, 762, 337]);
        assert_eq!(moments(300)[..3], [75, 112, 150]);
        for n in [200, 300, 1200, 3000, 10_000, 40_000] {
            let [from, step_from, kernel_center_from, _] = moments(n);
            assert!(0 < from && from < step_from && step_from < kernel_center_from);
            assert!(kernel_center_from < n, "at {n}");
            let modelled = Modelled {
                motion: true,
                unseen: true,
                blur_moments: moments(n).to_vec(),
                camera_settled: None,
            };
            let settings = Settings {
                iterations: n,
                ..Settings::default()
            };
            let unseen_from = Schedule::new(&settings, 24, modelled).unseen_from;
            assert!(unseen_from.expect("unseen views") < from, "at {n}");
        }
    }

    #[test]
    fn moments_after_any_end_never_come() {
        let mut settings = Settings::default();
        settings.blur.from = usize::MAX;
        settings.loss.downsample_after = usize::MAX;
        let m = Moments::new(&settings, 0);
        let all = [m.from, m.step_from, m.kernel_center_from, m.downsample_from];
        assert!(
            all.iter().all(|&moment| moment >= settings.iterations),
            "{m:?}"
        );
    }
}
