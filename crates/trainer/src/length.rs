//! The length of a run, chosen by whoever has tried how long an iteration takes.

use crate::TrainError;
use crate::blur::BlurModel;
use crate::corrections::Corrections;
use crate::metrics::{decibel, masked_error};
use crate::model::Model;
use crate::plan::{Plan, schedule_of};
use crate::run::Run;
use crate::settings::{LEAST_ITERATIONS, Settings};
use crate::state::State;
use crate::trainer::Trainer;
use crate::world::World;
use burn::tensor::DType;

/// What a run begins with, whatever its length.
#[derive(Clone, Debug)]
pub struct Start(World);

/// A run as it was at some moment.
#[derive(Clone, Debug)]
pub struct Kept {
    plan: Plan,
    state: State,
}

/// When the costly parts of a run come, and how costly they are.
#[derive(Clone, Debug, PartialEq)]
pub struct Course {
    /// A model of blur is trained after this iteration; `None` where there is none. (BP-Net only runs forward for some iterations
    /// before, which cost hardly more than those without it.)
    pub blur_trained_from: Option<usize>,
    /// An iteration behind that takes so many times as long as one before it, within a factor of two: fitted to what runs took on the
    /// CPU (RESULTS.md, "Time foretold").
    pub blur_pace: f64,
    /// Every frame is looked at in several ways after each of these iterations.
    pub trials: Vec<usize>,
}

impl Trainer {
    /// The shortest run that there is.
    pub const LEAST_ITERATIONS: usize = LEAST_ITERATIONS;

    /// What this run begins with, to [begin again](Self::begin_again) from; to be asked for before the first iteration.
    #[must_use]
    pub fn start(&self) -> Start {
        Start(self.model().world.clone())
    }

    /// Begins again as a run of so many iterations, as if this one had not been.
    ///
    /// # Errors
    /// The number of iterations is out of its range; the run is as it was then.
    pub fn begin_again(&mut self, start: &Start, iterations: usize) -> Result<(), TrainError> {
        let settings = self.settings_of(iterations);
        settings.validate()?;
        let blur = self.untrained_blur(&settings)?;
        let Run {
            plan,
            state,
            device,
            ..
        } = &mut self.run;
        let options = (&*device, DType::F32);
        let model = Model {
            world: start.0.clone(),
            blur,
            corrections: Corrections::new(&settings, &plan.survey, &plan.views, options),
        };
        let unseen = !self.data.unseen.is_empty();
        plan.schedule = schedule_of(&settings, &plan.views, &model, unseen);
        plan.settings = settings;
        *state = State::new(model);
        Ok(())
    }

    /// The run as it is, to [go back](Self::go_back) to from another length.
    #[must_use]
    pub fn keep(&self) -> Kept {
        let Run { plan, state, .. } = &self.run;
        Kept {
            plan: plan.clone(),
            state: state.clone(),
        }
    }

    /// Goes back to this trainer's run as it was.
    pub fn go_back(&mut self, kept: Kept) {
        let Kept { plan, state } = kept;
        self.run.plan = plan;
        self.run.state = state;
    }

    /// The course of a run of so many iterations on this scene.
    ///
    /// # Errors
    /// There is no blur model for such views.
    pub fn course(&self, iterations: usize) -> Result<Course, TrainError> {
        self.course_with(&self.settings_of(iterations))
    }

    /// The course of a run with other settings on this scene as it was surveyed.
    ///
    /// # Errors
    /// There is no blur model for such views.
    pub fn course_with(&self, settings: &Settings) -> Result<Course, TrainError> {
        let blur = self.untrained_blur(settings)?;
        let moments = blur.moments();
        let is_trial = |moment: &usize| *moment < settings.iterations && blur.revises(*moment);
        let mut trials: Vec<usize> = moments.iter().copied().filter(is_trial).collect();
        // With both models, one of them may begin where the other's last trial is.
        trials.dedup();
        Ok(Course {
            blur_trained_from: blur.trained_behind(),
            blur_pace: blur_pace(&blur, settings),
            trials,
        })
    }

    /// Which pixels of a training frame are learned from, [H, W]; `None` where all are (`frames.held_back`).
    #[must_use]
    pub fn learned_pixels(&self, frame: usize) -> Option<&[bool]> {
        self.data.learned.get(frame).map(Vec::as_slice)
    }

    /// How well the model explains the pixels of the training frames that are held back (`frames.held_back`): PSNR over all of
    /// them, dB; `None` where there are none.
    ///
    /// # Errors
    /// The renderer refuses its input.
    pub fn held_back_psnr(&self) -> Result<Option<f64>, TrainError> {
        let (mut sum, mut count) = (0.0, 0_usize);
        for (frame, learned) in self.data.learned.iter().enumerate() {
            let seen = self.run.render_training_view(frame)?.seen;
            let taken = &self.data.scene.frames[frame].view.image;
            let held: Vec<bool> = learned.iter().map(|learned| !learned).collect();
            let (error, samples) = masked_error(&seen.pixels, &taken.pixels, &held);
            sum += error;
            count += samples;
        }
        Ok((count > 0).then(|| decibel(sum, count)))
    }

    fn settings_of(&self, iterations: usize) -> Settings {
        Settings {
            iterations,
            ..self.settings().clone()
        }
    }

    fn untrained_blur(&self, settings: &Settings) -> Result<BlurModel, TrainError> {
        let Run { plan, device, .. } = &self.run;
        BlurModel::new(settings, &plan.survey, &plan.views, (device, DType::F32))
    }
}

/// Each render that a frame is averaged from, of iterations without one.
const RENDER: f64 = 1.0 / 3.0;
/// BP-Net, at the frames' own resolution.
const NET: f64 = 1.8;

/// How many times as long as without it an iteration takes with a model of blur, about.
fn blur_pace(blur: &BlurModel, settings: &Settings) -> f64 {
    let camera = RENDER * settings.camera.samples as f64;
    let net = NET / settings.blur.downscale as f64;
    match blur {
        BlurModel::Off => 1.0,
        BlurModel::Kernels(_) => 1.0 + net,
        BlurModel::Camera(_) => 1.0 + camera,
        // Kernels over the camera begin in the middle of a run.
        BlurModel::Both(_) => 1.0 + camera + 0.5 * net,
    }
}
