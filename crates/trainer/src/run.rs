//! A run: what was decided and what has been learned. It needs no data set to be rendered, exported and looked at.

use crate::TrainError;
use crate::blur::ViewBlur;
use crate::changes::{Change, changes};
use crate::guarded::guarded;
use crate::look::Look;
use crate::model::Model;
use crate::plan::Plan;
use crate::schedule::Schedule;
use crate::settings::Settings;
use crate::state::State;
use crate::survey::Survey;
use crate::tensors::host;
use crate::views::{CameraView, ViewRef, Views};
use crate::world::MotionArrays;
use burn::tensor::{Device, Tensor};
use glam::DAffine3;
use io::{Image, Map};
use splat_core::{Camera, Gaussians};

/// A run at some iteration.
#[derive(Debug)]
pub struct Run {
    pub(crate) plan: Plan,
    pub(crate) state: State,
    pub(crate) device: Device,
    /// See [`Self::setback`].
    pub(crate) setback: Option<TrainError>,
}

/// A training view, sharp and as the model says that the camera saw it.
#[derive(Clone, Debug)]
pub struct TrainingView {
    /// The sharp render.
    pub sharp: Image,
    /// What the model says the camera saw; the sharp render where blur is not modelled.
    pub seen: Image,
    /// How it was blurred; `None` where blur is not modelled, or not yet.
    pub blur: Option<ViewBlur>,
}

/// What a sharp camera sees.
#[derive(Clone, Debug)]
pub struct Layers {
    /// The picture.
    pub color: Image,
    /// z-depth in scene units where something is seen (the mean over what is), 0 where nothing is.
    pub depth: Map,
    /// The movers' share of each pixel, 0 to 1; `None` where nothing moves.
    pub movers: Option<Map>,
}

/// A pixel that holds back less than this share of the light shows nothing that has a depth.
const SEEN: f32 = 0.05;

impl Run {
    /// The settings of this run.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        &self.plan.settings
    }

    /// Goes on with these settings from here on. The intervals between checkpoints are anyone's; a run may become longer, and
    /// with `rates` learning rates may change. All else stays what it was, or the result would be neither settings'.
    ///
    /// The schedule of a run that becomes longer stays what it was: its moments come when they would have come, and behind its end
    /// learning rates stay as they were there. So the longer run is the shorter one, bit for bit, and what follows on it.
    ///
    /// Gives back what becomes other of what is learned; [`Self::changes`] keeps it.
    ///
    /// # Errors
    /// Names a setting that is out of its range or may not change; nothing has changed then.
    pub fn change(&mut self, asked: Settings, rates: bool) -> Result<Vec<Change>, TrainError> {
        let made = changes(&self.plan.settings, &asked, self.iteration(), rates)?;
        self.plan.settings = asked;
        self.plan.changes.extend(made.iter().cloned());
        Ok(made)
    }

    /// What was changed of the settings on the way, in order.
    #[must_use]
    pub fn changes(&self) -> &[Change] {
        &self.plan.changes
    }

    /// What was found in the scene and decided from it.
    #[must_use]
    pub fn survey(&self) -> &Survey {
        &self.plan.survey
    }

    /// What trials have decided so far of what blurs the frames, and why, for people.
    #[must_use]
    pub fn decisions(&self) -> &[String] {
        &self.state.decisions
    }

    /// When things happen.
    #[must_use]
    pub fn schedule(&self) -> &Schedule {
        &self.plan.schedule
    }

    /// From where the scene was filmed.
    #[must_use]
    pub fn views(&self) -> &Views {
        &self.plan.views
    }

    /// Gaussians, motion and blur model as they are now.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.state.model
    }

    /// Iterations done.
    #[must_use]
    pub fn iteration(&self) -> usize {
        self.state.progress.iteration
    }

    /// The seconds that training took, as far as whoever trained has said so ([`crate::Trainer::count_seconds`]).
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.state.progress.seconds
    }

    /// Whether all iterations are done.
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.iteration() >= self.plan.settings.iterations
    }

    /// Plain arrays for a file: the scene at a time (training frames, may be fractional), or the canonical scene.
    ///
    /// # Errors
    /// The device fails.
    pub fn gaussians(&self, time: Option<f32>) -> Result<Gaussians, TrainError> {
        guarded(&self.device, || Ok(self.model().world.gaussians(time)))
    }

    /// How the movers move, as plain arrays; `None` where nothing does.
    ///
    /// # Errors
    /// The device fails.
    pub fn motion_arrays(&self) -> Result<Option<MotionArrays>, TrainError> {
        guarded(&self.device, || Ok(self.model().world.motion_arrays()))
    }

    /// The scene as a camera sees it at a time (training frames, may be fractional), sharp.
    ///
    /// # Errors
    /// The renderer refuses its input; the device fails.
    pub fn render_view(
        &self,
        camera: &Camera,
        cam_from_world: &DAffine3,
        time: f32,
    ) -> Result<Image, TrainError> {
        let viewpoint = CameraView {
            name: String::new(),
            camera: camera.clone().with_near(self.plan.near()),
            cam_from_world: *cam_from_world,
            time,
        };
        self.render_viewpoint(&viewpoint)
    }

    /// The same, with depth and the movers' share.
    ///
    /// # Errors
    /// The renderer refuses its input; the device fails.
    pub fn render_layers(&self, viewpoint: &CameraView) -> Result<Layers, TrainError> {
        guarded(&self.device, || {
            let model = self.state.model.detached();
            let shown = model.show(&self.look(viewpoint, self.iteration()), None)?;
            let rendered = &shown.rendered;
            let color = to_image(rendered.color());
            let map = |values: Vec<f32>| Map {
                width: color.width,
                height: color.height,
                values,
            };
            let seen = host(rendered.alpha());
            let depth = host(rendered.depth()).into_iter().zip(seen);
            let depth = depth.map(|(depth, seen)| if seen > SEEN { depth / seen } else { 0.0 });
            Ok(Layers {
                depth: map(depth.collect()),
                movers: rendered.features().map(|movers| map(host(movers))),
                color,
            })
        })
    }

    /// The same from a viewpoint of [`Self::views`].
    pub(crate) fn render_viewpoint(&self, viewpoint: &CameraView) -> Result<Image, TrainError> {
        guarded(&self.device, || {
            let model = self.state.model.detached();
            let look = self.look(viewpoint, self.iteration());
            let shown = model.show(&look, None)?;
            Ok(to_image(shown.rendered.color()))
        })
    }

    /// A training view, sharp and as the model says that the camera saw it.
    ///
    /// # Errors
    /// The renderer refuses its input; the device fails.
    ///
    /// # Panics
    /// Panics if there is no such frame.
    pub fn render_training_view(&self, frame: usize) -> Result<TrainingView, TrainError> {
        guarded(&self.device, || {
            let model = self.state.model.detached();
            let look = Look {
                frame: Some(frame),
                ..self.look(&self.plan.views.train[frame], self.iteration())
            };
            let shown = model.show(&look, None)?;
            Ok(TrainingView {
                sharp: to_image(shown.rendered.color()),
                seen: to_image(shown.seen),
                blur: shown.trace.map(ViewBlur::from),
            })
        })
    }

    /// Where a training frame was taken from: the given pose as corrected, which [`Self::render_training_view`] looks from.
    ///
    /// # Panics
    /// Panics if there is no such frame.
    #[must_use]
    pub fn training_pose(&self, frame: usize) -> DAffine3 {
        let given = &self.plan.views.train[frame].cam_from_world;
        self.state.model.corrections.pose(frame, given)
    }

    /// A look at a view that is learned from, at iteration `it`.
    pub(crate) fn look_at<'a>(&self, view: &'a ViewRef<'a>, it: usize) -> Look<'a> {
        Look {
            frame: Some(view.frame),
            view: Some(view),
            ..self.look(view.viewpoint, it)
        }
    }

    /// A look from a viewpoint as a sharp camera has it, at iteration `it`.
    fn look<'a>(&self, viewpoint: &'a CameraView, it: usize) -> Look<'a> {
        Look {
            viewpoint,
            frame: None,
            iteration: it,
            sh_degree: self.plan.schedule.sh_degree_at(it),
            view: None,
            pose: None,
            gain: None,
            screen_grad: None,
        }
    }
}

pub(crate) fn to_image(picture: Tensor<3>) -> Image {
    let [height, width, _] = picture.dims();
    Image {
        width,
        height,
        pixels: host(picture),
    }
}
