//! Our blur model: the camera itself. A frame is the light of many moments of the camera's path and many points of its
//! lens, each a render of the sharp scene.

mod account;
mod errors;
mod foretold;
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
use crate::scene_shift::{SceneShift, Shared};
use crate::settings::{CameraSettings, DiscKind, Settings, When};
use crate::survey::Survey;
use crate::tensors::{constant, host, leaf};
use crate::views::{Views, pose_tensor, poses_of};
use crate::world::World;
use burn::tensor::{DType, Device, Tensor, TensorData};
use capture::{Capture, GOLDEN_ANGLE, RIGID, Sample, samples, samples_for, turns};
use foretold::{Accelerations, Foretold};
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
    scene_shift: SceneShift,
    accelerations: Accelerations,
    /// What the paths that are there have in common, in a scene that stays and in one that may drift, and what is foretold of them;
    /// made where it is needed, and anew behind a trial, which may put paths in and out.
    shared: Option<([Shared; 2], Foretold)>,
    /// Frames that were not explained far worse than others at the last trial: the paths of those that were do not tell what is the
    /// scene's.
    explained: Vec<bool>,
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
            scene_shift: SceneShift::of(&views.train),
            accelerations: Accelerations::of(&views.train, survey.scene_size),
            shared: None,
            explained: vec![true; focal.len()],
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
            view = self.with_spots(frame, view);
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
        let CameraSettings {
            spacing_px,
            samples,
            ..
        } = self.settings;
        let limit = if by_both {
            self.settings.most_samples()
        } else {
            samples
        };
        samples_for(blur_px, disc_px, spacing_px, limit).max(LEAST_SAMPLES)
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

    /// Takes out of the paths' means what all frames have in common, which is the scene's: of the shifts in the image what a scene
    /// that lies elsewhere shows, and of the turns about the optical axis and of the translations all that goes with the camera's
    /// place. Where the poses do not foretell what the frames have of their own, slow waves of all these are a drift of the scene, too.
    /// (A path that a trial left out stays out.)
    pub(super) fn hold(&mut self, it: usize) {
        if self.settings.path == When::Never || self.settings.path_degree < 2 || !self.is_on(it) {
            return;
        }
        let mut held = Capture {
            paths: self.capture.paths.clone().inner(),
            ..self.capture.clone()
        };
        let options = (&held.paths.device(), held.paths.dtype());
        let ([steady, drifting], foretold) = self.shared.get_or_insert_with(|| {
            let paths = host(held.paths.clone());
            let width = held.paths.dims()[1];
            let moving = paths
                .chunks_exact(width)
                .map(|path| path.iter().any(|p| *p != 0.0));
            let moving: Vec<bool> = moving.collect();
            let well: Vec<bool> = moving
                .iter()
                .zip(&self.explained)
                .map(|(moves, explained)| *moves && *explained)
                .collect();
            let told = self.accelerations.known(&well);
            let drifting = self.scene_shift.clone().drifting();
            let shared = [&self.scene_shift, &drifting];
            let shared = shared.map(|shift| shift.among(&moving, &told, options));
            let foretold = self.accelerations.foretold(&told, &shared[1], options);
            (shared, foretold)
        });
        let belief = foretold.belief(held.mean_shifts());
        // Where the poses are believed, slow waves are the hand's.
        let drifts = belief.clone().floor().neg() + 1.0;
        let scenes = |steady: Tensor<2>, drifting: Tensor<2>| {
            steady.clone() + (drifting - steady) * drifts.clone()
        };
        // Turns about x and y shift the image: those are held with the shifts, below.
        let others = Tensor::<2>::from_data([[0.0, 0.0, 1.0, 1.0, 1.0, 1.0]], options);
        let motions = held.mean_motions();
        let common = scenes(steady.of_any(motions.clone()), drifting.of_any(motions));
        held.bend(-common * others);
        let missed = foretold.missed(held.mean_shifts(), belief);
        let common = scenes(steady.of_shifts(missed.clone()), drifting.of_shifts(missed));
        held.bend(-turns(common));
        self.capture.paths = leaf(held.paths, true);
    }

    /// What a checkpoint keeps of it beside its parameters.
    pub(super) fn table(&self, device: &Device) -> (&'static str, Tensor<2>) {
        let rows: Vec<f32> = self.explained.iter().map(|e| f32::from(*e)).collect();
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
        let rows = host(read(TABLE, [self.explained.len(), 1])?);
        self.explained = rows.iter().map(|row| *row != 0.0).collect();
        Ok(())
    }

    /// Whether frames try other paths once `it` iterations are done.
    pub(super) fn revises(&self, it: usize) -> bool {
        self.moments.trials.contains(&it)
    }

    /// Those that are trained.
    pub(super) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Where the camera of a frame stands.
    fn place(t: f64) -> glam::DVec3 {
        glam::DVec3::new(0.2 * t, 0.1 * (1.7 * t).sin(), 0.3 * (0.9 * t).cos())
    }

    /// The paths of some frames, [N, 12], once they are held; those of `unexplained` do not tell.
    fn held(paths: Vec<f64>, unexplained: Option<usize>) -> Vec<f64> {
        let frame = |k: usize| {
            let t = k as f64;
            let center = place(t);
            io::Frame {
                view: io::View {
                    name: k.to_string(),
                    camera: splat_core::Camera::pinhole([8, 6], [7.0; 2], [4.0, 3.0]),
                    cam_from_world: DAffine3::from_translation(-center),
                    time: k as f32,
                    image: io::Image {
                        width: 8,
                        height: 6,
                        pixels: vec![0.5; 8 * 6 * 3],
                    },
                },
                depth: Some(io::Map {
                    width: 8,
                    height: 6,
                    values: vec![5.0; 8 * 6],
                }),
                mask: None,
            }
        };
        let mut scene = io::Scene::of_frames((0..9).map(frame).collect());
        let settings = Settings::default();
        let survey = crate::survey::survey(&mut scene, settings.motion.when).expect("a survey");
        let views = Views::of(&scene, 0.01);
        let options = (&Device::flex().autodiff(), DType::F64);
        let mut camera = CameraBlur::new(&settings, &survey, &views, options);
        let paths = TensorData::new(paths, [9, 2 * RIGID]);
        camera.capture.paths = Tensor::from_data(paths, options);
        if let Some(frame) = unexplained {
            camera.explained[frame] = false;
        }
        camera.hold(camera.moments.from + 1);
        let held = camera.capture.paths.inner();
        held.try_into_vec_as::<f64>().expect("f64")
    }

    #[test]
    fn a_frame_that_was_not_explained_moves_no_other() {
        let tame: Vec<f64> = (0..9 * 2 * RIGID)
            .map(|k| 0.01 * (1.3 * k as f64 + 0.2).sin())
            .collect();
        let mut wild = tame.clone();
        let bend = 4 * 2 * RIGID + RIGID;
        (wild[bend], wild[bend + 1]) = (0.7, -0.9);
        let others = |paths: Vec<f64>| -> Vec<f64> {
            let rows = paths.chunks_exact(2 * RIGID).enumerate();
            let others = rows.filter(|(frame, _)| *frame != 4);
            others.flat_map(|(_, row)| row.to_vec()).collect()
        };
        let off = |unexplained| {
            let [one, other] = [&tame, &wild].map(|p| others(held(p.clone(), unexplained)));
            let pairs = one.iter().zip(&other);
            pairs.fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()))
        };
        assert!(off(Some(4)) < 1e-12, "{}", off(Some(4)));
        assert!(off(None) > 1e-2, "{}", off(None));
    }

    #[test]
    fn slow_waves_are_the_hands_where_the_poses_foretell_paths_and_the_scenes_elsewhere() {
        let bends = |of: &dyn Fn(f64) -> [f64; RIGID]| -> Vec<f64> {
            let frames = (0..9).map(f64::from);
            frames
                .flat_map(|t| [[0.0; RIGID], of(t)])
                .flatten()
                .collect()
        };
        // As the camera is accelerated, in its own axes.
        let foretold = bends(&|t| {
            let second = 2.0 * place(t) - place(t - 1.0) - place(t + 1.0);
            [0.0, 0.0, 0.0, second.x, second.y, second.z].map(|v| 0.1 * v)
        });
        let other = bends(&|t| {
            [
                0.01 * (2.9 * t).sin(),
                0.01 * (2.3 * t).cos(),
                0.0,
                0.0,
                0.0,
                0.0,
            ]
        });
        // Down in the picture and up again, which is no matter of where the camera stands.
        let wave = bends(&|t| {
            let swing = (std::f64::consts::PI * (t + 0.5) / 9.0).cos();
            [0.02 * swing, 0.0, 0.0, 0.0, 0.0, 0.0]
        });
        let left = |paths: &[f64]| -> f64 {
            let waving = paths.iter().zip(&wave).map(|(p, w)| p + w).collect();
            let pairs = held(waving, None)
                .into_iter()
                .zip(held(paths.to_vec(), None));
            let most = pairs.fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()));
            most / 0.02
        };
        assert!(left(&foretold) > 0.5, "{}", left(&foretold));
        assert!(left(&other) < 1e-12, "{}", left(&other));
    }
}
