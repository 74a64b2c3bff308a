//! The trainer: a scene, a model, and the state between iterations.

use crate::TrainError;
use crate::density::DensityStats;
use crate::dynamics::start_dynamics;
use crate::gauge::Gauge;
use crate::model::{GaussianTensors, Model, tensor};
use crate::optimizer::Optimizer;
use crate::placement::{Seeds, place_points, place_static};
use crate::random::{Purpose, derived_seed, generator, permutation};
use crate::schedule::{Modelled, Schedule};
use crate::settings::Settings;
use crate::survey::{Survey, survey};
use crate::views::{UnseenView, ViewRef, unseen_views};
use bpnet::{BpNet, BpNetConfig, HeadInit};
use burn::tensor::{DType, Device};
use io::Scene;
use splat_core::Gaussians;

/// Trains one scene.
///
/// A library: it draws no progress bar, writes no file but checkpoints, and reads no clock.
#[derive(Debug)]
pub struct Trainer {
    pub(crate) settings: Settings,
    pub(crate) scene: Scene,
    pub(crate) survey: Survey,
    pub(crate) schedule: Schedule,
    pub(crate) device: Device,
    pub(crate) model: Model,
    pub(crate) optimizer: Optimizer,
    pub(crate) density: DensityStats,
    pub(crate) gauge: Gauge,
    pub(crate) unseen: Vec<UnseenView>,
    pub(crate) progress: Progress,
}

/// Where a run is; with the seed it determines every draw to come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Progress {
    /// Iterations done.
    pub(crate) iteration: usize,
    /// Training views shown.
    pub(crate) training_draws: usize,
    /// Unseen views shown.
    pub(crate) unseen_draws: usize,
}

impl Trainer {
    /// Surveys the scene and sets up everything for the first iteration.
    ///
    /// `device` names the backend, with or without autodiff.
    ///
    /// # Errors
    /// Settings out of range, a scene without frames or without anything to place Gaussians on.
    pub fn new(mut scene: Scene, settings: Settings, device: &Device) -> Result<Self, TrainError> {
        settings.validate()?;
        if scene.frames.is_empty() {
            return Err(TrainError::Scene("there is no training frame".to_owned()));
        }
        let mut survey = survey(&mut scene)?;
        let device = device.clone().autodiff();
        let dtype = DType::F32;

        let dynamics = if survey.movers {
            start_dynamics(&scene, &settings, &device, dtype)?
        } else {
            None
        };
        if survey.movers && dynamics.is_none() {
            let note = "no track can be lifted (all are hidden, outside the masks or without depth): no motion bases";
            survey.notes.push(note.to_owned());
        }
        survey.movers = dynamics.is_some();
        let still = if survey.depth {
            place_static(&scene, &settings.gaussians, settings.seed)
        } else {
            place_points(&scene)
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
            return Err(TrainError::Scene(
                "no Gaussian can be placed: all pixels are masked, on depth edges, or without depth".to_owned(),
            ));
        }
        let start = GaussianTensors::new(
            &seeds,
            settings.gaussians.initial_opacity,
            settings.gaussians.sh_degree,
            &device,
            dtype,
        );
        let blur = settings
            .blur
            .enabled
            .then(|| new_blur(&settings, scene.frames.len(), &device, dtype))
            .transpose()?;
        let near = settings.gaussians.near * survey.scene_size;
        let unseen = make_unseen(&scene, &settings, &survey, near)?;
        if settings.unseen.enabled && survey.depth {
            survey.notes.push(format!("{} unseen views", unseen.len()));
        }
        let modelled = Modelled {
            motion: motion.is_some(),
            blur: blur.is_some(),
            unseen: !unseen.is_empty(),
        };
        let schedule = Schedule::new(&settings, scene.frames.len(), modelled);
        let model = Model {
            means: start.means.require_grad(),
            quats: start.quats.require_grad(),
            log_scales: start.log_scales.require_grad(),
            opacity_logits: start.opacity_logits.require_grad(),
            sh: start.sh.require_grad(),
            num_dynamic,
            motion,
            blur,
        };
        Ok(Self {
            density: DensityStats::new(model.num_gaussians()),
            gauge: Gauge::new(settings.blur.gauge_cells, scene.frames.len()),
            optimizer: Optimizer::default(),
            progress: Progress::default(),
            settings,
            scene,
            survey,
            schedule,
            device,
            model,
            unseen,
        })
    }

    /// Starts from these Gaussians, all of them static, in place of those that were placed.
    ///
    /// # Errors
    /// There is none, their arrays do not fit each other, training has begun, or their SH degree is not that of the settings.
    pub fn start_from(&mut self, gaussians: &Gaussians) -> Result<(), TrainError> {
        gaussians.check()?;
        let degree = self.settings.gaussians.sh_degree;
        if gaussians.is_empty() || self.progress.iteration > 0 || gaussians.sh_degree != degree {
            return Err(TrainError::Scene(format!(
                "training starts from at least one Gaussian of SH degree {degree}, before its first iteration; \
                 given are {} of degree {} at iteration {}",
                gaussians.len(),
                gaussians.sh_degree,
                self.progress.iteration
            )));
        }
        let n = gaussians.len();
        let leaf =
            |values: Vec<f32>, columns| tensor(values, [n, columns], &self.device).require_grad();
        self.model = Model {
            means: leaf(gaussians.means.as_flattened().to_vec(), 3),
            quats: leaf(gaussians.quats.as_flattened().to_vec(), 4),
            log_scales: leaf(gaussians.log_scales.as_flattened().to_vec(), 3),
            opacity_logits: leaf(gaussians.opacity_logits.clone(), 1),
            sh: leaf(gaussians.sh.clone(), gaussians.sh.len() / n),
            num_dynamic: 0,
            motion: None,
            blur: self.model.blur.take(),
        };
        self.density = DensityStats::new(n);
        Ok(())
    }

    /// The settings of this run.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The scene, its depth aligned to the sparse points.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// What was found in the scene and decided from it.
    #[must_use]
    pub fn survey(&self) -> &Survey {
        &self.survey
    }

    /// When things happen.
    #[must_use]
    pub fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    /// Gaussians, motion and blur model as they are now.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Iterations done.
    #[must_use]
    pub fn iteration(&self) -> usize {
        self.progress.iteration
    }

    /// Whether all iterations are done.
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.progress.iteration >= self.settings.iterations
    }

    /// Near plane, scene units.
    pub(crate) fn near(&self) -> f64 {
        self.settings.gaussians.near * self.survey.scene_size
    }

    /// The training frame that comes next: every epoch shows each once, in an order of its own.
    pub(crate) fn next_training_view(&self) -> ViewRef<'_> {
        let n = self.scene.frames.len();
        let frame = draw(
            self.settings.seed,
            Purpose::TrainOrder,
            self.progress.training_draws,
            n,
        );
        ViewRef::training(&self.scene, frame)
    }

    /// The unseen view that comes next.
    pub(crate) fn next_unseen_view(&self) -> ViewRef<'_> {
        let n = self.unseen.len();
        let index = draw(
            self.settings.seed,
            Purpose::UnseenOrder,
            self.progress.unseen_draws,
            n,
        );
        ViewRef::unseen(&self.scene, &self.unseen[index])
    }
}

/// The `count`-th draw without replacement from n, refilled when empty.
fn draw(seed: u64, purpose: Purpose, count: usize, n: usize) -> usize {
    permutation(&mut generator(seed, purpose, (count / n) as u64), n)[count % n]
}

/// A fresh blur model.
pub(crate) fn new_blur(
    settings: &Settings,
    num_frames: usize,
    device: &Device,
    dtype: DType,
) -> Result<BpNet, TrainError> {
    let config = BpNetConfig {
        kernel_size: settings.blur.kernel_size,
        num_frames,
        shortcut: settings.blur.shortcut,
        downscale: settings.blur.downscale,
        head: if settings.blur.mild_start {
            HeadInit::Mild
        } else {
            HeadInit::Framework
        },
        seed: derived_seed(settings.seed, Purpose::BlurModel),
    };
    Ok(BpNet::new(&config, device, dtype)?)
}

/// The unseen views of a run; they depend on scene, settings and seed alone.
pub(crate) fn make_unseen(
    scene: &Scene,
    settings: &Settings,
    survey: &Survey,
    near: f64,
) -> Result<Vec<UnseenView>, TrainError> {
    if !settings.unseen.enabled || !survey.depth {
        return Ok(Vec::new());
    }
    unseen_views(
        scene,
        &settings.unseen,
        survey.scene_size,
        near,
        settings.gaussians.depth_edge,
        settings.seed,
    )
}
