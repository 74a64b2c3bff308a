//! Our blur model: the camera itself. A frame is the light of many moments of the camera's path and many points of its
//! lens, each a render of the sharp scene.

mod account;
mod errors;
mod foretold;
mod gauge;
mod grown;
mod layers;
mod lens;
mod moments;
mod parts;
mod softness;
mod taken;
mod trials;

pub(crate) use parts::Decision;
pub use taken::{CameraFigures, CameraFrame, Spot, TakenView};

use crate::TrainError;
use crate::look::{Look, Shown, render_posed};
use crate::parameter::{Group, Parameter};
use crate::settings::{CameraSettings, DiscKind, Settings, When};
use crate::survey::Survey;
use crate::tensors::{constant, host, leaf};
use crate::views::{Views, pose_tensor, poses_of};
use crate::world::World;
use burn::tensor::{DType, Device, Tensor, TensorData};
use capture::{
    BlurSize, Capture, GOLDEN_ANGLE, RIGID, Sample, Spacing, Taken, samples, samples_for,
};
use gauge::Gauge;
use glam::DAffine3;
use grown::grown;
use layers::layered;
use lens::Lens;
use moments::Moments;
use splat_core::{Exposed, Exposure, Extra, Movers, Splats, expose, render};
use tracing::trace_span;

/// By what part of a full turn the points of the lens turn from iteration to iteration: no two are alike.
const LENS_TURN: f64 = 0.754_877_666_2;
/// A frame that is blurred at all is averaged from so many renders or more.
const LEAST_SAMPLES: usize = 3;
/// Name of its table in checkpoints.
const TABLE: &str = "camera.explained";

/// Path, lens and pose of every frame, and when and how they are used.
#[derive(Clone, Debug)]
pub struct CameraBlur {
    capture: Capture,
    /// What it says of every frame, as it was last read; `None` where it may have changed since.
    known: Option<Vec<Taken>>,
    gauge: Gauge,
    settings: CameraSettings,
    moments: Moments,
    /// Focal length of each frame, px.
    focal: Vec<f64>,
    /// Scene size S, scene units.
    scene_size: f64,
    /// Depths between which most of the scene lies, near and far, scene units: discs are measured there.
    depth_range: [f64; 2],
}

/// What it keeps of a view that it showed.
#[derive(Clone, Debug)]
pub(crate) struct CameraTrace {
    pub(super) view: TakenView,
}

impl CameraBlur {
    pub(super) fn new(
        settings: &Settings,
        survey: &Survey,
        views: &Views,
        (device, dtype): (&Device, DType),
    ) -> Self {
        let (n, camera) = (settings.iterations, &settings.camera);
        let focal: Vec<f64> = views.train.iter().map(|view| view.camera.fx).collect();
        let width = RIGID * camera.path_degree;
        let mut paths = vec![0.0; focal.len() * width];
        for (i, (path, (view, focal))) in paths
            .chunks_exact_mut(width)
            .zip(views.train.iter().zip(&focal))
            .enumerate()
        {
            // No motion is a saddle: a path of no length has no direction to grow in. No two frames' first ones are alike.
            let angle = i as f64 * GOLDEN_ANGLE;
            let length = camera.start_px * view.camera.width as f64 / 256.0 / focal;
            path[0] = length * angle.cos();
            path[1] = length * angle.sin();
        }
        let mut capture = Capture::still(focal.len(), camera.path_degree, (device, dtype));
        let table = |values: Vec<f64>, shape| {
            Tensor::<2>::from_data(TensorData::new(values, shape), (device, dtype))
        };
        if camera.path != When::Never {
            capture.paths = table(paths, [focal.len(), width]);
            capture.shutter = table(vec![camera.shutter], [1, 1]);
        }
        if camera.lens != When::Never {
            capture.aperture = table(vec![camera.aperture], [1, 1]);
        }
        let mut model = Self {
            capture,
            known: None,
            gauge: Gauge::of(&views.train, survey.scene_size),
            settings: camera.clone(),
            moments: Moments::new(n, focal.len()),
            focal,
            scene_size: survey.scene_size,
            depth_range: survey.depth_range,
        };
        for (_, tensor) in model.parameters_mut() {
            *tensor = tensor.clone().require_grad();
        }
        model
    }

    /// Whether frames are exposed at iteration `it`, or once `it` iterations are done.
    pub(super) fn is_on(&self, it: usize) -> bool {
        it > self.moments.from
    }

    /// The iteration after which trials leave it alone.
    pub(super) fn settled(&self) -> usize {
        self.moments
            .trials
            .last()
            .copied()
            .unwrap_or(self.moments.from)
    }

    pub(super) fn moments(&self) -> Vec<usize> {
        let mut all = vec![self.moments.from];
        all.extend(&self.moments.trials);
        all
    }

    pub(super) fn show(
        &self,
        world: &World,
        look: &Look<'_>,
    ) -> Result<Shown<CameraTrace>, TrainError> {
        let posed = trace_span!("pose").in_scope(|| world.pose(look.viewpoint.time));
        let viewpoint = look.viewpoint_of(&posed.splats);
        let on = look.frame.filter(|_| self.is_on(look.iteration));
        let Some(frame) = on else {
            let rendered = render_posed(posed, &viewpoint, look.screen_grad.clone())?;
            return Ok(Shown::sharp(rendered));
        };
        let mut view = self.view(frame, look.iteration);
        if look.view.is_none() {
            view = self.with_spots(frame, view, viewpoint.camera.width);
        }
        let trace = CameraTrace { view };
        if trace.view.frame.is_sharp() {
            let rendered = render_posed(posed, &viewpoint, look.screen_grad.clone())?;
            return Ok(Shown {
                trace: Some(trace),
                ..Shown::sharp(rendered)
            });
        }
        let splats = posed.splats.clone();
        let rendered = render_posed(posed, &viewpoint, None)?;
        // Training sees other points of the lens in each iteration; pictures always the same.
        let turn = match look.view {
            Some(_) => (LENS_TURN * look.iteration as f64).fract(),
            None => 0.0,
        };
        let exposed = self.exposed(world, look, splats, (frame, &trace.view), turn)?;
        Ok(Shown {
            seen: exposed.color,
            radii: exposed.radii,
            trace: Some(trace),
            ..Shown::sharp(rendered)
        })
    }

    /// What the camera collects of these Gaussians where they are not seen sharp, through a lens turned by `turn` of a full turn.
    fn exposed(
        &self,
        world: &World,
        look: &Look<'_>,
        splats: Splats,
        (frame, view): (usize, &TakenView),
        turn: f64,
    ) -> Result<Exposed, TrainError> {
        let middle = look.viewpoint_of(&splats);
        let mut taken = samples(view.frame.samples, turn);
        let capture = self.learned(view);
        let lens = Lens {
            aperture: capture.aperture.clone(),
            focus: capture.focus.clone().narrow(0, frame, 1),
            size: self.scene_size,
        };
        let splats = match self.settings.disc {
            DiscKind::Points => splats,
            DiscKind::Grown => {
                for sample in &mut taken {
                    *sample = Sample::through_the_middle(sample.moment);
                }
                grown(splats, &middle, &lens)
            }
            DiscKind::Layers => {
                let extra = Extra {
                    screen_grad: look.screen_grad.clone(),
                    ..Extra::default()
                };
                let rendered = render(splats, &middle, extra)?;
                let (focal, range) = (self.focal[frame], self.depth_range);
                return Ok(Exposed {
                    color: layered(&rendered, &lens, focal, range, self.settings.transfer),
                    radii: rendered.radii(),
                });
            }
        };
        let exposure = Exposure {
            poses: capture.poses(frame, &middle.cam_from_world, &taken, self.scene_size),
            movers: self.movers(world, look.viewpoint.time, &taken, view.shutter),
            transfer: self.settings.transfer.into(),
        };
        Ok(expose(splats, &middle, exposure, look.screen_grad.clone())?)
    }

    /// The capture as a view learns from it: what trials left out altogether stays out.
    fn learned(&self, view: &TakenView) -> Capture {
        let mut capture = self.capture.clone();
        if view.frame.blur_px == 0.0 {
            capture.paths = constant(&capture.paths);
        }
        if view.aperture == 0.0 {
            capture.aperture = constant(&capture.aperture);
            capture.focus = constant(&capture.focus);
        }
        capture
    }

    /// Where moving Gaussians are at the samples' moments, with the shutter open for so long.
    fn movers(&self, world: &World, time: f32, taken: &[Sample], shutter: f64) -> Option<Movers> {
        let times = self.capture.moments(taken).add_scalar(time);
        let known = taken.iter().map(|s| f64::from(time) + shutter * s.moment);
        world.exposed_at(&times, &known.collect::<Vec<_>>())
    }

    /// How many renders a frame with such a blur is averaged from at iteration `it`. A blur that is there at all has a gradient: with
    /// a single render, one that became small could never grow again.
    fn samples(&self, blur_px: f64, disc_px: f64, it: usize) -> usize {
        let disc_px = match self.settings.disc {
            DiscKind::Points => disc_px,
            DiscKind::Grown | DiscKind::Layers => 0.0,
        };
        if blur_px + disc_px == 0.0 {
            return 1;
        }
        // Before the first trial a lens and paths are only supposed.
        let by_both = blur_px > 0.0 && disc_px > 0.0 && self.moments.trials.first() < Some(&it);
        let settings = &self.settings;
        let limit = if by_both {
            settings.most_samples()
        } else {
            settings.samples
        };
        let blur = BlurSize {
            path_px: blur_px,
            disc_px,
        };
        let spacing = Spacing {
            path_px: settings.spacing_px,
            disc_px: settings.lens_spacing_px,
        };
        samples_for(blur, spacing, limit).max(LEAST_SAMPLES.min(limit))
    }

    /// See [`super::BlurModel::taken`].
    pub(super) fn taken(
        &self,
        frame: usize,
        middle: &DAffine3,
        moments: impl Iterator<Item = f64>,
    ) -> Vec<(f64, DAffine3)> {
        let taken: Vec<Sample> = moments.map(Sample::through_the_middle).collect();
        let options = (&self.capture.paths.device(), self.capture.paths.dtype());
        let middle = pose_tensor(middle, options);
        let poses = self.capture.poses(frame, &middle, &taken, self.scene_size);
        let times = host(self.capture.moments(&taken).detach());
        let times = times.into_iter().map(f64::from);
        times.zip(poses_of(poses)).collect()
    }

    /// See [`super::BlurModel::cameras`].
    pub(super) fn cameras(&self, frame: usize, count: usize) -> Vec<DAffine3> {
        let options = (&self.capture.paths.device(), self.capture.paths.dtype());
        let still = pose_tensor(&DAffine3::IDENTITY, options);
        let taken = samples(count, 0.0);
        let poses = self.capture.poses(frame, &still, &taken, self.scene_size);
        poses_of(poses)
    }

    /// Fixes the gauge of the paths once `it` iterations are done: what all frames have in common is the scene's.
    pub(super) fn hold(&mut self, it: usize) {
        if self.settings.path == When::Never || self.settings.path_degree < 2 || !self.is_on(it) {
            return;
        }
        let mut taken = self.capture.all_taken();
        self.gauge.fix(&mut taken);
        let paths = &self.capture.paths;
        let (shape, device, dtype) = (paths.dims(), paths.device(), paths.dtype());
        let held = taken.iter().flat_map(|frame| frame.path.iter().copied());
        let held = TensorData::new(held.collect::<Vec<f64>>(), shape).convert_dtype(dtype);
        // As the device has them.
        let rounded: Vec<f64> = held.iter().collect();
        for (frame, path) in taken.iter_mut().zip(rounded.chunks_exact(shape[1])) {
            frame.path.copy_from_slice(path);
        }
        let held = Tensor::<2>::from_data(held, (&device, dtype)).inner();
        self.capture.paths = leaf(held, true);
        self.known = Some(taken);
    }

    /// What a checkpoint keeps of it beside its parameters.
    pub(super) fn table(&self, device: &Device) -> (&'static str, Tensor<2>) {
        let rows: Vec<f32> = self.gauge.explained.iter().map(|e| f32::from(*e)).collect();
        let shape = [rows.len(), 1];
        (
            TABLE,
            Tensor::from_data(TensorData::new(rows, shape), device),
        )
    }

    /// Takes back what [`Self::table`] gave.
    pub(super) fn restore<E>(
        &mut self,
        read: &mut impl FnMut(&str, [usize; 2]) -> Result<Tensor<2>, E>,
    ) -> Result<(), E> {
        let rows = host(read(TABLE, [self.gauge.explained.len(), 1])?);
        self.gauge.explained = rows.iter().map(|row| *row != 0.0).collect();
        Ok(())
    }

    /// Whether frames try other paths once `it` iterations are done.
    pub(super) fn revises(&self, it: usize) -> bool {
        self.moments.trials.contains(&it)
    }

    /// Those that are trained.
    pub(super) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        self.known = None;
        let Capture {
            paths,
            focus,
            aperture,
            shutter,
        } = &mut self.capture;
        let mut all = Vec::new();
        if self.settings.path != When::Never {
            all.push((Parameter::new("camera.paths", Group::CameraPath), paths));
            all.push((
                Parameter::new("camera.shutter", Group::CameraShutter),
                shutter,
            ));
        }
        if self.settings.lens != When::Never {
            all.push((Parameter::new("camera.focus", Group::CameraFocus), focus));
            all.push((
                Parameter::new("camera.aperture", Group::CameraAperture),
                aperture,
            ));
        }
        all
    }
}
