//! The trainer: a run, and the data that it learns from.

use crate::TrainError;
use crate::alignment::point_depths;
use crate::blur::BlurModel;
use crate::corrections::Corrections;
use crate::coverage::fill;
use crate::dynamics::start_dynamics;
use crate::error::{CheckpointProblem, OtherScene, SceneProblem};
use crate::guarded::guarded;
use crate::held::learned;
use crate::inputs::Inputs;
use crate::lifting::liftable;
use crate::model::Model;
use crate::objective::Objective;
use crate::placement::{Seeds, place_points, place_static};
use crate::plan::{Plan, schedule_of};
use crate::random::{Purpose, generator, permutation};
use crate::run::Run;
use crate::saves::FILE_NAME;
use crate::schedule::Schedule;
use crate::scores::Evaluation;
use crate::sent::Sent;
use crate::settings::Settings;
use crate::state::State;
use crate::survey::{Survey, survey};
use crate::tensors::tensor;
use crate::unseen::Filmed;
use crate::views::{UnseenView, ViewRef, Views};
use crate::world::{GaussianTensors, World};
use burn::tensor::{DType, Device, Tensor};
use io::Scene;
use splat_core::Gaussians;
use std::path::Path;
use tracing::trace_span;
use unseen_views::Warped;

/// Trains one scene.
///
/// A library: it draws no progress bar, writes no file but checkpoints, and reads no clock.
#[derive(Debug)]
pub struct Trainer {
    pub(crate) run: Run,
    pub(crate) data: Data,
}

/// What was read, and what was made from it alone.
#[derive(Debug)]
pub(crate) struct Data {
    /// The scene, its depth aligned to the sparse points.
    pub(crate) scene: Scene,
    pub(crate) unseen: Vec<UnseenView>,
    /// z-depth of the sparse points in every training frame, 0 where there is none, [H, W]; `None` with too few of them.
    pub(crate) points: Vec<Option<Vec<f32>>>,
    /// Which pixels of every training frame are learned from, [H, W]; empty where all are.
    pub(crate) learned: Vec<Vec<bool>>,
    sent: Vec<Sent>,
}

impl Data {
    fn new(
        scene: Scene,
        unseen: Vec<UnseenView>,
        learned: Vec<Vec<bool>>,
        device: &Device,
    ) -> Self {
        let frames = scene.frames.iter();
        let points = frames.map(|frame| point_depths(frame, &scene.points));
        let pixels = scene.frames.iter().map(|f| f.view.camera.num_pixels());
        Self {
            points: points.collect(),
            learned,
            sent: Sent::to(device, scene.frames.len(), pixels.max().unwrap_or(0)),
            scene,
            unseen,
        }
    }

    /// A training frame to learn from.
    pub(crate) fn training_view<'a>(&'a self, views: &'a Views, frame: usize) -> ViewRef<'a> {
        let mut view = ViewRef::training(views, &self.scene, frame);
        view.points = self.points[frame].as_deref();
        view.valid = self.learned.get(frame).map(Vec::as_slice);
        view.sent = self.sent.get(frame);
        view
    }
}

/// What was launched is done before a trainer goes: a program that ends earlier may take the driver from under it.
impl Drop for Trainer {
    fn drop(&mut self) {
        // A device that has failed said so before.
        self.run.device.sync().ok();
    }
}

impl Trainer {
    /// Surveys the scene and sets up everything for the first iteration.
    ///
    /// `device` names the backend, with or without autodiff.
    ///
    /// # Errors
    /// Settings out of range, a scene without frames or without anything to place Gaussians on, or movers that cannot be lifted;
    /// the device fails.
    pub fn new(scene: Scene, settings: Settings, device: &Device) -> Result<Self, TrainError> {
        settings.validate()?;
        guarded(device, || Self::begin(scene, settings, device))
    }

    fn begin(mut scene: Scene, settings: Settings, device: &Device) -> Result<Self, TrainError> {
        if scene.frames.is_empty() {
            return Err(SceneProblem::NoFrames.into());
        }
        let inputs = Inputs::of(&scene);
        let mut survey = survey(&mut scene, settings.motion.when)?;
        let device = device.clone().autodiff();
        let dtype = DType::F32;

        let dynamics = if survey.movers {
            start_dynamics(&scene, &settings, &device, dtype)?
        } else {
            None
        };
        if survey.movers && dynamics.is_none() {
            let found = liftable(&scene);
            return Err(SceneProblem::TracksNotLifted { found }.into());
        }
        let still = if survey.depth {
            place_static(&scene, &settings.gaussians, settings.seed)
        } else {
            place_points(&scene, &settings.gaussians, settings.seed)
        };
        let (moving, motion) = match dynamics {
            Some(start) => {
                survey.notes.push(start.note);
                (start.seeds, Some(start.motion))
            }
            None => (Seeds::default(), None),
        };
        let num_dynamic = moving.means.len();
        survey.notes.push(format!(
            "{} static Gaussians at the start",
            still.means.len()
        ));
        let seeds = moving.followed_by(still);
        if seeds.means.is_empty() {
            return Err(SceneProblem::NothingToPlace.into());
        }
        let size = survey.scene_size;
        let views = Views::of(&scene, settings.gaussians.near * size);
        let world = |more: Seeds| {
            let GaussianTensors {
                means,
                quats,
                log_scales,
                opacity_logits,
                sh,
            } = GaussianTensors::new(
                &seeds.clone().followed_by(more),
                settings.gaussians.initial_opacity,
                settings.gaussians.sh_degree,
                (&device, dtype),
            );
            World {
                means: means.require_grad(),
                quats: quats.require_grad(),
                log_scales: log_scales.require_grad(),
                opacity_logits: opacity_logits.require_grad(),
                sh: sh.require_grad(),
                num_dynamic,
                motion: motion.clone(),
            }
        };
        let most = settings.gaussians.most(views.train[0].camera.num_pixels());
        let room = most.saturating_sub(seeds.means.len());
        let filled = fill(&scene, &views, size, room, world)?;
        survey.notes.push(filled.note());
        let model = Model {
            world: filled.world,
            blur: BlurModel::new(&settings, &survey, &views, (&device, dtype))?,
            corrections: Corrections::new(&settings, &survey, &views, (&device, dtype)),
        };
        let decided = survey.decided(&settings);
        survey.notes.extend(decided);
        let learned = learned(&scene, &settings);
        let filmed = Filmed {
            scene: &scene,
            views: &views,
            settings: &settings,
            learned: &learned,
        };
        let unseen = filmed.unseen_views(&model.blur, size)?;
        if !unseen.is_empty() {
            survey.notes.push(format!(
                "{} unseen views (`unseen.when = \"never\"` has none)",
                unseen.len()
            ));
        }
        let plan = Plan {
            schedule: schedule_of(&settings, &views, &model, !unseen.is_empty()),
            settings,
            changes: Vec::new(),
            inputs,
            survey,
            views,
        };
        let state = State::new(model);
        let data = Data::new(scene, unseen, learned, &device);
        Ok(Self {
            run: Run {
                plan,
                state,
                device,
                setback: None,
            },
            data,
        })
    }

    /// Goes on with a run on the scene that it was trained on.
    ///
    /// # Errors
    /// The scene is another, or was read in another way; the device fails.
    pub fn resume(run: Run, scene: Scene) -> Result<Self, TrainError> {
        guarded(&run.device.clone(), || Self::go_on(run, scene))
    }

    fn go_on(mut run: Run, mut scene: Scene) -> Result<Self, TrainError> {
        run.check_scene(&scene)?;
        run.plan.inputs.check(&scene)?;
        // The survey is made again for what it does to the scene's depth, and must agree.
        let found = survey(&mut scene, run.plan.settings.motion.when)?.scene_size;
        let trained = run.plan.survey.scene_size;
        if found != trained {
            return Err(OtherScene::OtherSize { found, trained }.into());
        }
        run.plan.views.test = run.plan.views_of(&scene).test;
        let plan = &run.plan;
        let learned = learned(&scene, &plan.settings);
        let filmed = Filmed {
            scene: &scene,
            views: &plan.views,
            settings: &plan.settings,
            learned: &learned,
        };
        let unseen = filmed.unseen_views(&run.state.model.blur, trained)?;
        if plan.schedule.unseen_from.is_some() == unseen.is_empty() {
            let found = unseen.len();
            return Err(OtherScene::UnseenViews { found }.into());
        }
        let data = Data::new(scene, unseen, learned, &run.device);
        Ok(Self { run, data })
    }

    /// Reads a checkpoint back and goes on from it: [`Run::open`] and [`Self::resume`] in a row.
    ///
    /// # Errors
    /// As those.
    pub fn load(folder: &Path, scene: Scene, device: &Device) -> Result<Self, TrainError> {
        Self::resume(Run::open(folder, device)?, scene).map_err(|error| match error {
            TrainError::OtherScene(problem) => TrainError::Checkpoint {
                path: folder.join(FILE_NAME),
                problem: CheckpointProblem::Scene(problem),
            },
            other => other,
        })
    }

    /// Starts from these Gaussians, all of them static, in place of those that were placed.
    ///
    /// # Errors
    /// There is none, training has begun, their arrays do not fit each other, or their SH degree is not that of the settings;
    /// the device fails.
    pub fn start_from(&mut self, gaussians: &Gaussians) -> Result<(), TrainError> {
        gaussians.check()?;
        let degree = self.run.plan.settings.gaussians.sh_degree;
        let iteration = self.run.iteration();
        if gaussians.is_empty() || iteration > 0 || gaussians.sh_degree != degree {
            return Err(TrainError::StartFrom {
                degree,
                found: gaussians.sh_degree,
                gaussians: gaussians.len(),
                iteration,
            });
        }
        let device = self.run.device.clone();
        guarded(&device, || {
            self.replace(gaussians);
            Ok(())
        })
    }

    fn replace(&mut self, gaussians: &Gaussians) {
        let n = gaussians.len();
        let Run {
            plan,
            state,
            device,
            ..
        } = &mut self.run;
        let leaf = |values: Vec<f32>, columns| tensor(values, [n, columns], device).require_grad();
        let Model {
            blur, corrections, ..
        } = state.model.clone();
        *state = State::new(Model {
            world: World {
                means: leaf(gaussians.means.as_flattened().to_vec(), 3),
                quats: leaf(gaussians.quats.as_flattened().to_vec(), 4),
                log_scales: leaf(gaussians.log_scales.as_flattened().to_vec(), 3),
                opacity_logits: leaf(gaussians.opacity_logits.clone(), 1),
                sh: leaf(gaussians.sh.clone(), gaussians.sh.len() / n),
                num_dynamic: 0,
                motion: None,
            },
            blur,
            corrections,
        });
        plan.survey.movers = false;
        let unseen = !self.data.unseen.is_empty();
        plan.schedule = schedule_of(&plan.settings, &plan.views, &state.model, unseen);
    }

    /// The run as it is now.
    #[must_use]
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// The scene, its depth aligned to the sparse points.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.data.scene
    }

    /// See [`Run::settings`].
    #[must_use]
    pub fn settings(&self) -> &Settings {
        self.run.settings()
    }

    /// See [`Run::survey`].
    #[must_use]
    pub fn survey(&self) -> &Survey {
        self.run.survey()
    }

    /// See [`Run::schedule`].
    #[must_use]
    pub fn schedule(&self) -> &Schedule {
        self.run.schedule()
    }

    /// See [`Run::model`].
    #[must_use]
    pub fn model(&self) -> &Model {
        self.run.model()
    }

    /// See [`Run::iteration`].
    #[must_use]
    pub fn iteration(&self) -> usize {
        self.run.iteration()
    }

    /// See [`Run::is_done`].
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.run.is_done()
    }

    /// Adds to [`Run::seconds`]: a trainer looks at no clock, but a checkpoint keeps what was told.
    pub fn count_seconds(&mut self, seconds: f64) {
        self.run.state.progress.seconds += seconds;
    }

    /// See [`Run::save`].
    ///
    /// # Errors
    /// As there.
    pub fn save(&self, folder: &Path) -> Result<(), TrainError> {
        self.run.save(folder)
    }

    /// Scores of all test views (and, where the truth is there, of the sharp training views), now; see [`Run::evaluate`].
    ///
    /// # Errors
    /// As there.
    pub fn evaluate(&self) -> Result<Evaluation, TrainError> {
        self.run.evaluate(&self.data.scene, None)
    }

    /// The weighted terms of the loss of training frame `frame` at iteration `it` (1-based), each of shape `[1]`.
    ///
    /// `model` is the trainer's own or one like it, in f64 for example. What the gradient stops at comes from `fixed`: BP-Net's
    /// inputs, alpha under the depth, the intensity that kernels are pulled to. Training takes both to be its own; a check
    /// by finite differences moves `model` alone.
    ///
    /// # Errors
    /// The renderer or the blur model refuses the model.
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
        let plan = &self.run.plan;
        let view = self.data.training_view(&plan.views, frame);
        let look = self.run.look_at(&view, it);
        let fixed = fixed.show(&look, None)?;
        let shown = model.show(&look, Some(&fixed))?;
        let objective = Objective {
            plan,
            world: &model.world,
            view: &view,
        };
        Ok(objective.terms(&shown, &fixed, view.target(&shown.seen)).0)
    }

    /// The view that iteration `it` learns from: every epoch shows each training frame once, in an order of its own, and so for
    /// the unseen views.
    pub(crate) fn next_view(&self, it: usize) -> Result<NextView<'_>, TrainError> {
        let (plan, progress) = (&self.run.plan, &self.run.state.progress);
        let seed = plan.settings.seed;
        if plan.schedule.is_unseen(it) {
            let (count, n) = (progress.unseen_draws, self.data.unseen.len());
            let view = &self.data.unseen[draw(seed, Purpose::UnseenOrder, count, n)];
            let _span = trace_span!("warp").entered();
            let filmed = Filmed {
                scene: &self.data.scene,
                views: &plan.views,
                settings: &plan.settings,
                learned: &self.data.learned,
            };
            Ok(NextView::Unseen(view, filmed.warped(view)?))
        } else {
            let (count, n) = (progress.training_draws, plan.views.train.len());
            let frame = draw(seed, Purpose::TrainOrder, count, n);
            Ok(NextView::Frame(self.data.training_view(&plan.views, frame)))
        }
    }
}

/// What an iteration learns from.
#[derive(Debug)]
pub(crate) enum NextView<'a> {
    /// A training frame.
    Frame(ViewRef<'a>),
    /// An unseen view, and what it sees.
    Unseen(&'a UnseenView, Warped),
}

impl NextView<'_> {
    pub(crate) fn view(&self) -> ViewRef<'_> {
        match self {
            Self::Frame(view) => *view,
            Self::Unseen(view, warped) => ViewRef::unseen(view, warped),
        }
    }
}

/// The `count`-th draw without replacement from n, refilled when empty.
fn draw(seed: u64, purpose: Purpose, count: usize, n: usize) -> usize {
    permutation(&mut generator(seed, purpose, (count / n) as u64), n)[count % n]
}
