//! Our blur model: the camera itself. A frame is the light of many moments of the camera's path and many points of its
//! lens, each a render of the sharp scene.

use crate::TrainError;
use crate::look::{Look, Shown, Terms, render_posed};
use crate::parameter::{Group, Parameter};
use crate::settings::{CameraSettings, Settings};
use crate::tensors::{constant, host, leaf, tensor};
use crate::views::Views;
use crate::world::World;
use burn::tensor::{DType, Device, Tensor, TensorData};
use capture::{Capture, Sample, samples, samples_for};
use serde::{Deserialize, Serialize};
use splat_core::{Exposure, Movers, expose};
use std::fmt;
use tracing::trace_span;

/// Numbers of a rigid motion.
const RIGID: usize = 6;
/// From one frame's first direction to the next: no two are alike.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
/// Moments between which a frame's samples and points are jittered, by irrational steps from iteration to iteration.
const JITTER: [f64; 2] = [0.618_033_988_75, 0.754_877_666_2];
/// Disparities (S / depth) between which most of a scene lies; discs are measured there.
const DISPARITIES: [f64; 2] = [0.6, 1.6];
/// A frame that is blurred at all is averaged from so many renders or more.
const LEAST_SAMPLES: usize = 3;
/// Places of a spot that are drawn.
const SPOT_SAMPLES: usize = 2000;
/// Shares of a run after which every frame tries other paths.
const TRIALS: [f64; 4] = [0.133, 0.233, 0.333, 0.467];

/// Path, lens and pose of every frame, and when and how they are used.
#[derive(Clone, Debug)]
pub struct CameraBlur {
    pub(super) capture: Capture,
    settings: CameraSettings,
    moments: Moments,
    /// Focal length of each frame, px.
    focal: Vec<f64>,
    /// Scene size S, scene units.
    scene_size: f64,
}

/// Iterations after which something begins.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Moments {
    /// Frames are exposed.
    from: usize,
    /// Other paths are tried on every frame.
    trials: Vec<usize>,
}

/// What it keeps of a view that it showed.
#[derive(Clone, Debug)]
pub(crate) struct CameraTrace {
    pub(super) view: TakenView,
}

/// What the camera did in one frame, for pictures and figures.
#[derive(Clone, Debug, PartialEq)]
pub struct TakenView {
    /// Its figures.
    pub frame: CameraFrame,
    /// Time for which the shutter was open, in units of frames.
    pub shutter: f64,
    /// Radius of the lens, scene units.
    pub aperture: f64,
    /// What points in the middle of the picture become, at a few depths from near to far.
    pub spots: Vec<Spot>,
}

/// What a point becomes while the shutter is open.
#[derive(Clone, Debug, PartialEq)]
pub struct Spot {
    /// Its depth, scene units.
    pub depth: f64,
    /// Where its light falls, px from where the sharp picture has it (x, y).
    pub places: Vec<[f64; 2]>,
}

impl TakenView {
    /// How far the light of any spot strays, px.
    #[must_use]
    pub fn reach_px(&self) -> f64 {
        let places = self.spots.iter().flat_map(|spot| &spot.places);
        places.fold(0.0, |far, [x, y]| far.max(x.hypot(*y)))
    }
}

/// Figures of [`BlurModel::Camera`](super::BlurModel::Camera) over all training frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraFigures {
    /// Time for which the shutter is open, in units of frames.
    pub shutter: f64,
    /// Radius of the lens, scene units.
    pub aperture: f64,
    /// Every training frame.
    pub frames: Vec<CameraFrame>,
}

impl CameraFigures {
    /// Of some views; `None` of none.
    pub(super) fn of(views: &[TakenView]) -> Option<Self> {
        let first = views.first()?;
        Some(Self {
            shutter: first.shutter,
            aperture: first.aperture,
            frames: views.iter().map(|view| view.frame).collect(),
        })
    }
}

impl fmt::Display for CameraFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mean = |value: fn(&CameraFrame) -> f64| {
            self.frames.iter().map(value).sum::<f64>() / self.frames.len() as f64
        };
        write!(
            f,
            "shutter {:.2} frames, aperture {:.4}, mean path {:.2} px, mean disc {:.2} px, {:.1} samples a frame",
            self.shutter,
            self.aperture,
            mean(|frame| frame.blur_px),
            mean(|frame| frame.disc_px),
            mean(|frame| frame.samples as f64),
        )
    }
}

/// What the camera did in one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraFrame {
    /// Length of its path at the depth S, px.
    pub blur_px: f64,
    /// Depth that is in focus, scene units.
    pub focus: f64,
    /// Diameter of the disc of what lies nearest or farthest, px, whichever is larger.
    pub disc_px: f64,
    /// How far the middle of its exposure lies off the given pose, px at the depth S.
    pub offset_px: f64,
    /// Renders that the frame was averaged from.
    pub samples: usize,
}

impl CameraBlur {
    pub(super) fn new(
        settings: &Settings,
        scene_size: f64,
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
            // No motion is a saddle: a path of no length has no direction to grow in.
            let angle = i as f64 * GOLDEN_ANGLE;
            let length = camera.start_px * view.camera.width as f64 / 256.0 / focal;
            path[0] = length * angle.cos();
            path[1] = length * angle.sin();
        }
        let mut capture = Capture::still(focal.len(), camera.path_degree, (device, dtype));
        let table = |values: Vec<f64>, shape| {
            Tensor::<2>::from_data(TensorData::new(values, shape), (device, dtype))
        };
        if camera.path {
            capture.paths = table(paths, [focal.len(), width]);
            capture.shutter = table(vec![camera.shutter], [1, 1]);
        }
        if camera.lens {
            capture.aperture = table(vec![camera.aperture], [1, 1]);
        }
        let mut model = Self {
            capture,
            settings: camera.clone(),
            moments: Moments {
                from: 250.min(n / 4),
                trials: TRIALS.iter().map(|s| (s * n as f64) as usize).collect(),
            },
            focal,
            scene_size,
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
        let mut viewpoint = look.viewpoint_of(&posed);
        let on = look.frame.filter(|_| self.is_on(look.iteration));
        let Some(frame) = on else {
            let rendered = render_posed(posed, &viewpoint, look.screen_grad.clone())?;
            return Ok(Shown::sharp(rendered));
        };
        let given = viewpoint.cam_from_world.clone();
        viewpoint.cam_from_world = self.capture.middle(frame, &given, self.scene_size);
        let mut view = self.view(frame);
        if look.view.is_none() {
            view = self.with_spots(frame, view);
        }
        let count = view.frame.samples;
        let trace = Some(CameraTrace { view });
        if count == 1 {
            let rendered = render_posed(posed, &viewpoint, look.screen_grad.clone())?;
            return Ok(Shown {
                trace,
                ..Shown::sharp(rendered)
            });
        }
        let taken = samples(count, self.jitter(look));
        let exposure = Exposure {
            poses: self.capture.poses(frame, &given, &taken, self.scene_size),
            movers: self.movers(world, look.viewpoint.time, &taken),
            transfer: self.settings.transfer.into(),
        };
        let splats = posed.splats.clone();
        let rendered = render_posed(posed, &viewpoint, None)?;
        let exposed = trace_span!("expose")
            .in_scope(|| expose(splats, &viewpoint, exposure, look.screen_grad.clone()))?;
        Ok(Shown {
            seen: exposed.color,
            radii: exposed.radii,
            rendered,
            terms: Terms::default(),
            trace,
        })
    }

    /// Training sees other moments and points of the lens in each iteration; pictures always the same.
    fn jitter(&self, look: &Look<'_>) -> [f64; 2] {
        match look.view {
            Some(_) => JITTER.map(|step| (step * look.iteration as f64).fract()),
            None => [0.5, 0.0],
        }
    }

    /// Where moving Gaussians are at the samples' moments.
    fn movers(&self, world: &World, time: f32, taken: &[Sample]) -> Option<Movers> {
        let times = self.capture.moments(taken).add_scalar(time);
        let (means, left_rotations) = world.exposed_at(&times)?;
        Some(Movers {
            means,
            left_rotations,
        })
    }

    /// What the camera does in a frame.
    fn view(&self, frame: usize) -> TakenView {
        let focal = self.focal[frame];
        let blur_px = self.capture.path_px(frame, focal);
        let disc_px = DISPARITIES
            .map(|d| self.capture.disc_px(frame, focal, d))
            .into_iter()
            .fold(0.0, f64::max);
        let row = |tensor: &Tensor<2>, row| host(tensor.clone().detach().narrow(0, row, 1));
        let offset = row(&self.capture.offsets, frame);
        let [x, y] = [offset[1] + offset[3], offset[4] - offset[0]].map(f64::from);
        TakenView {
            frame: CameraFrame {
                blur_px,
                focus: self.scene_size / f64::from(row(&self.capture.focus, frame)[0]),
                disc_px,
                offset_px: focal * x.hypot(y),
                samples: self.samples(blur_px, disc_px),
            },
            shutter: row(&self.capture.shutter, 0)[0].into(),
            aperture: self.scene_size * f64::from(row(&self.capture.aperture, 0)[0].abs()),
            spots: Vec::new(),
        }
    }

    /// How many renders a frame with such a blur is averaged from. A blur that is there at all has a gradient: with a single
    /// render, one that became small could never grow again.
    fn samples(&self, blur_px: f64, disc_px: f64) -> usize {
        if blur_px + disc_px == 0.0 {
            return 1;
        }
        let CameraSettings {
            spacing_px,
            samples,
            ..
        } = self.settings;
        samples_for(blur_px, disc_px, spacing_px, samples).max(LEAST_SAMPLES)
    }

    /// The same with its spots, for pictures.
    fn with_spots(&self, frame: usize, view: TakenView) -> TakenView {
        let like = &self.capture.paths;
        let options = (&like.device(), like.dtype());
        let identity = [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ];
        let given = Tensor::<2>::from_data(identity, options);
        let taken = samples(SPOT_SAMPLES, [0.5, 0.0]);
        let size = self.scene_size;
        let poses = host(self.capture.poses(frame, &given, &taken, size).detach());
        let middle = host(self.capture.middle(frame, &given, size).detach());
        let focal = self.focal[frame];
        let seen = |pose: &[f32], depth: f64| {
            let at = |i: usize| f64::from(pose[4 * i + 2]) * depth + f64::from(pose[4 * i + 3]);
            [0, 1].map(|axis| focal * at(axis) / at(2))
        };
        let spot = |disparity: f64| {
            let depth = size / disparity;
            let [x, y] = seen(&middle, depth);
            let places = poses.chunks_exact(12).map(|pose| {
                let place = seen(pose, depth);
                [place[0] - x, place[1] - y]
            });
            Spot {
                depth,
                places: places.collect(),
            }
        };
        let [far, near] = DISPARITIES;
        let spots = [near, 1.0, far].map(spot).to_vec();
        TakenView { spots, ..view }
    }

    /// See [`super::BlurModel::stepped`].
    pub(super) fn stepped(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
    ) -> Result<Vec<(Parameter, Vec<usize>)>, TrainError> {
        self.hold();
        let rows = self.revise(world, looks)?;
        let paths = Parameter::new("camera.paths", Group::CameraPath);
        Ok(vec![(paths, rows)])
    }

    /// Tries other paths and focus distances on every frame, where it is time: the one that explains the frame best stays.
    /// `looks` are those at all training frames. Returns the frames whose path changed.
    fn revise(&mut self, world: &World, looks: &[Look<'_>]) -> Result<Vec<usize>, TrainError> {
        let Some(it) = looks.first().map(|look| look.iteration) else {
            return Ok(Vec::new());
        };
        if !self.settings.path || !self.moments.trials.contains(&it) || !self.is_on(it) {
            return Ok(Vec::new());
        }
        let _span = trace_span!("trials").entered();
        let world = world.detached();
        let width = RIGID * self.settings.path_degree;
        let mut paths = host(self.capture.paths.clone().detach());
        let mut now = Vec::with_capacity(looks.len());
        let mut trial = self.clone();
        for (_, tensor) in trial.parameters_mut() {
            *tensor = constant(tensor);
        }
        for (frame, look) in looks.iter().enumerate() {
            now.push(trial.error(&world, look, frame)?);
        }
        let lengths: Vec<f64> = (0..looks.len())
            .map(|frame| self.capture.path_px(frame, self.focal[frame]))
            .collect();
        let (usual, usual_px) = (median(&now), median(&lengths));
        let last = self.moments.trials.last() == Some(&it);
        let mut changed = Vec::new();
        for (frame, look) in looks.iter().enumerate() {
            let own = paths[frame * width..(frame + 1) * width].to_vec();
            let mut candidates = vec![reversed(&own)];
            // 2.5 dB under the others, or hardly moved: it does not leave a wrong direction by itself.
            if now[frame] > 1.8 * usual || lengths[frame] < 0.4 * usual_px {
                candidates.extend(self.others(own.len(), usual_px / self.focal[frame]));
            }
            let mut best = (now[frame], own.clone());
            for candidate in candidates {
                trial.set_path(frame, &candidate);
                let error = trial.error(&world, look, frame)?;
                if error < best.0 {
                    best = (error, candidate);
                }
            }
            if last && lengths[frame] < 1.0 {
                // What does not pay is left out for good.
                let still = vec![0.0; own.len()];
                trial.set_path(frame, &still);
                if trial.error(&world, look, frame)? <= 1.01 * best.0 {
                    best.1 = still;
                }
            }
            trial.set_path(frame, &best.1);
            if best.1 != own {
                paths[frame * width..(frame + 1) * width].copy_from_slice(&best.1);
                changed.push(frame);
            }
        }
        let device = self.capture.paths.device().inner();
        self.capture.paths = leaf(tensor(paths, self.capture.paths.dims(), &device), true);
        Ok(changed)
    }

    /// Straight paths in eight directions, half as long as `length` (rad), as long, and twice as long.
    fn others(&self, width: usize, length: f64) -> Vec<Vec<f32>> {
        let directions = (0..8).map(|k| std::f64::consts::TAU * f64::from(k) / 8.0);
        directions
            .flat_map(|angle| {
                [0.5, 1.0, 2.0].map(|times| {
                    let mut path = vec![0.0; width];
                    path[0] = (times * length * angle.cos()) as f32;
                    path[1] = (times * length * angle.sin()) as f32;
                    path
                })
            })
            .collect()
    }

    fn set_path(&mut self, frame: usize, path: &[f32]) {
        let paths = self.capture.paths.clone();
        let device = paths.device();
        let [frames, width] = paths.dims();
        let mut values = host(paths);
        values[frame * width..(frame + 1) * width].copy_from_slice(path);
        self.capture.paths = tensor(values, [frames, width], &device);
    }

    /// Mean absolute difference between what the camera would have seen and the frame.
    fn error(&self, world: &World, look: &Look<'_>, frame: usize) -> Result<f64, TrainError> {
        let Some(view) = look.view else {
            return Ok(0.0);
        };
        let look = Look {
            viewpoint: look.viewpoint,
            frame: Some(frame),
            iteration: look.iteration,
            sh_degree: look.sh_degree,
            view: None,
            screen_grad: None,
        };
        let seen = self.show(world, &look)?.seen;
        let difference = (seen.clone() - view.image(&seen)).square().mean();
        Ok(f64::from(host(difference)[0]))
    }

    /// What all frames have in common is the scene's: offsets have a mean of zero over the frames.
    fn hold(&mut self) {
        if self.settings.offsets {
            let offsets = self.capture.offsets.clone().inner();
            let mean = offsets.clone().mean_dim(0);
            self.capture.offsets = leaf(offsets - mean, true);
        }
    }

    /// Those that are trained.
    pub(super) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        let Capture {
            paths,
            offsets,
            focus,
            aperture,
            shutter,
        } = &mut self.capture;
        let mut all = Vec::new();
        if self.settings.path {
            all.push((Parameter::new("camera.paths", Group::CameraPath), paths));
            all.push((
                Parameter::new("camera.shutter", Group::CameraShutter),
                shutter,
            ));
        }
        if self.settings.offsets {
            all.push((
                Parameter::new("camera.offsets", Group::CameraOffset),
                offsets,
            ));
        }
        if self.settings.lens {
            all.push((Parameter::new("camera.focus", Group::CameraFocus), focus));
            all.push((
                Parameter::new("camera.aperture", Group::CameraAperture),
                aperture,
            ));
        }
        all
    }
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// The same path the other way round.
fn reversed(path: &[f32]) -> Vec<f32> {
    let odd = |k: usize| (k / RIGID).is_multiple_of(2);
    let values = path.iter().enumerate();
    values.map(|(k, v)| if odd(k) { -v } else { *v }).collect()
}
