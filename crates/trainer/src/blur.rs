//! The blur model: what a camera makes of the sharp scene while it takes a frame.
//!
//! A variant owns everything about itself: its parameters, the settings it was made from, its moments in the run and
//! its terms of the loss. [`BlurModel::show`] is the one way in, for training, scores, gradient checks and pictures alike.

mod both;
pub(crate) mod camera;
mod gauge;
pub(crate) mod kernels;

pub use both::Both;
pub use camera::{CameraBlur, CameraFigures, CameraFrame, Spot, TakenView};
pub use kernels::{KernelFigures, KernelView, Kernels};

use crate::TrainError;
use crate::look::{self, Look, render_sharp};
use crate::parameter::{Group, Parameter};
use crate::settings::{BlurKind, Settings};
use crate::survey::Survey;
use crate::views::Views;
use crate::world::World;
use bpnet::HeadInit;
use burn::tensor::{DType, Device, Tensor};
use camera::Decision;
use glam::DAffine3;
use kernels::{KernelSums, KernelTrace};
use serde::{Deserialize, Serialize};
use std::fmt;

/// How frames were blurred.
#[derive(Clone, Debug)]
pub enum BlurModel {
    /// What is rendered is what the camera saw.
    Off,
    /// The paper's: BP-Net predicts a kernel and an intensity for every pixel.
    Kernels(Box<Kernels>),
    /// Ours: what the camera did while it took the frame.
    Camera(Box<CameraBlur>),
    /// The paper's over ours.
    Both(Box<Both>),
}

/// What a variant keeps of a view that it showed.
#[derive(Clone, Debug)]
pub(crate) enum Trace {
    /// Kernels and what they made of the sharp render.
    Kernels(Box<KernelTrace>),
    /// What the camera did.
    Camera(camera::CameraTrace),
    /// Both of them.
    Both(camera::CameraTrace, Box<KernelTrace>),
}

/// What [`BlurModel::revise`] did.
#[derive(Default)]
pub(crate) struct Revision {
    /// Parameters with rows that are others now, and these rows.
    pub(crate) changed: Vec<(Parameter, Vec<usize>)>,
    /// What a lens and paths explain of the frames, where that was found out.
    pub(crate) decision: Option<Decision>,
}

/// What a model shows of a view.
pub(crate) type Shown = look::Shown<Trace>;

impl BlurModel {
    /// The model that the settings ask for, untrained.
    pub(crate) fn new(
        settings: &Settings,
        survey: &Survey,
        views: &Views,
        options: (&Device, DType),
    ) -> Result<Self, TrainError> {
        let size = survey.scene_size;
        Ok(match settings.blur.model {
            BlurKind::Off => Self::Off,
            BlurKind::Auto if !survey.blurred && !settings.camera.is_asked_for() => Self::Off,
            BlurKind::Kernels => {
                let kernels = Kernels::new(settings, size, views, (0, HeadInit::Mild), options)?;
                Self::Kernels(Box::new(kernels))
            }
            BlurKind::Auto | BlurKind::Camera => {
                let camera = CameraBlur::new(settings, survey, views, options);
                Self::Camera(Box::new(camera))
            }
            BlurKind::Both => {
                let camera = CameraBlur::new(settings, survey, views, options);
                let both = Both::over(camera, settings, survey, views, options)?;
                Self::Both(Box::new(both))
            }
        })
    }

    /// The iterations after which something about it changes, its start first; none where blur is not modelled.
    pub(crate) fn moments(&self) -> Vec<usize> {
        match self {
            Self::Off => Vec::new(),
            Self::Kernels(kernels) => kernels.moments().to_vec(),
            Self::Camera(camera) => camera.moments(),
            Self::Both(both) => both.moments(),
        }
    }

    /// The iteration after which it is trained, at the price of all that follows; `None` where blur is not modelled.
    pub(crate) fn trained_behind(&self) -> Option<usize> {
        match self {
            Self::Kernels(kernels) => Some(kernels.trained_behind()),
            _ => self.moments().first().copied(),
        }
    }

    /// The iteration after which trials leave the camera alone; `None` where there is no camera.
    pub(crate) fn camera_settled(&self) -> Option<usize> {
        match self {
            Self::Off | Self::Kernels(_) => None,
            Self::Camera(camera) => Some(camera.settled()),
            Self::Both(both) => Some(both.camera.settled()),
        }
    }

    /// Whether frames are blurred at iteration `it`, or once `it` iterations are done.
    pub(crate) fn is_on(&self, it: usize) -> bool {
        match self {
            Self::Off => false,
            Self::Kernels(kernels) => kernels.is_on(it),
            Self::Camera(camera) => camera.is_on(it),
            Self::Both(both) => both.camera.is_on(it),
        }
    }

    /// The sharp render of a view, what the camera saw, and the model's own terms of the loss.
    ///
    /// `fixed` is what the gradient stops at, where that is not what is shown: see [`crate::Trainer::loss_terms`].
    pub(crate) fn show(
        &self,
        world: &World,
        look: &Look<'_>,
        fixed: Option<&Shown>,
    ) -> Result<Shown, TrainError> {
        let fixed = fixed.map(|fixed| {
            let trace = fixed.trace.as_ref().and_then(Trace::kernels);
            (&fixed.rendered, trace)
        });
        match self {
            Self::Off => Ok(Shown::sharp(render_sharp(world, look)?)),
            Self::Kernels(kernels) => {
                let shown = kernels.show(world, look, fixed)?;
                Ok(shown.map(|trace| Trace::Kernels(Box::new(trace))))
            }
            Self::Camera(camera) => Ok(camera.show(world, look)?.map(Trace::Camera)),
            Self::Both(both) => {
                let shown = both.show(world, look, fixed)?;
                Ok(shown.map(|(camera, over)| match over {
                    Some(kernels) => Trace::Both(camera, Box::new(kernels)),
                    None => Trace::Camera(camera),
                }))
            }
        }
    }

    /// Where the camera was in a frame of some pose at moments from -1/2 to 1/2 of its exposure, and how long after the
    /// frame's own time that was, in units of frames; `None` where the model does not know.
    pub(crate) fn taken(
        &self,
        frame: usize,
        middle: &DAffine3,
        moments: impl Iterator<Item = f64>,
    ) -> Option<Vec<(f64, DAffine3)>> {
        match self {
            Self::Off | Self::Kernels(_) => None,
            Self::Camera(camera) => Some(camera.taken(frame, middle, moments)),
            Self::Both(both) => Some(both.camera.taken(frame, middle, moments)),
        }
    }

    /// The cameras from which a frame's light comes in equal parts, so many of them, each as a map from the frame's camera to it;
    /// `None` where the model knows of none.
    pub(crate) fn cameras(&self, frame: usize, count: usize) -> Option<Vec<DAffine3>> {
        match self {
            Self::Off | Self::Kernels(_) => None,
            Self::Camera(camera) => Some(camera.cameras(frame, count)),
            Self::Both(both) => Some(both.camera.cameras(frame, count)),
        }
    }

    /// Keeps what later iterations want to know of a frame that was learned from: the values of [`Trace::lesson`].
    pub(crate) fn learned(&mut self, frame: usize, lesson: Vec<f32>) {
        match self {
            Self::Off | Self::Camera(_) => {}
            Self::Kernels(kernels) => kernels.learned(frame, lesson),
            Self::Both(both) => both.kernels.learned(frame, lesson),
        }
    }

    /// Takes out what cannot be told from the scene, after iteration `it`.
    pub(crate) fn hold(&mut self, it: usize) {
        match self {
            Self::Off | Self::Kernels(_) => {}
            Self::Camera(camera) => camera.hold(it),
            Self::Both(both) => both.camera.hold(it),
        }
    }

    /// Whether [`Self::revise`] has something to do once `it` iterations are done.
    pub(crate) fn revises(&self, it: usize) -> bool {
        match self {
            Self::Off | Self::Kernels(_) => false,
            Self::Camera(camera) => camera.revises(it),
            Self::Both(both) => both.camera.revises(it),
        }
    }

    /// Changes what gradients do not; `looks` are those at all training frames.
    pub(crate) fn revise(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
    ) -> Result<Revision, TrainError> {
        let (camera, kernels_from) = match self {
            Self::Off | Self::Kernels(_) => return Ok(Revision::default()),
            Self::Camera(camera) => (camera.as_mut(), None),
            Self::Both(both) => (&mut both.camera, Some(both.kernels.begins_behind())),
        };
        let mut revised = camera.revise(world, looks)?;
        if let Some(decision) = &mut revised.decision {
            decision.kernels_from = kernels_from;
        }
        let paths = Parameter::new("camera.paths", Group::CameraPath);
        let focuses = Parameter::new("camera.focus", Group::CameraFocus);
        Ok(Revision {
            changed: vec![(paths, revised.paths), (focuses, revised.focuses)],
            decision: revised.decision,
        })
    }

    /// All parameters, to be replaced.
    pub(crate) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        match self {
            Self::Off => Vec::new(),
            Self::Kernels(kernels) => kernels.parameters_mut(),
            Self::Camera(camera) => camera.parameters_mut(),
            Self::Both(both) => {
                let mut all = both.camera.parameters_mut();
                all.extend(both.kernels.parameters_mut());
                all
            }
        }
    }

    /// What a checkpoint holds of it beside its parameters, by name.
    pub(crate) fn tables(&self, device: &Device) -> Vec<(&'static str, Tensor<2>)> {
        match self {
            Self::Off => Vec::new(),
            Self::Camera(camera) => vec![camera.table(device)],
            Self::Kernels(kernels) => vec![kernels.table(device)],
            Self::Both(both) => vec![both.camera.table(device), both.kernels.table(device)],
        }
    }

    /// Takes back what [`Self::tables`] gave; `read` finds a table of a name and a shape.
    pub(crate) fn restore<E>(
        &mut self,
        mut read: impl FnMut(&str, [usize; 2]) -> Result<Tensor<2>, E>,
    ) -> Result<(), E> {
        match self {
            Self::Off => Ok(()),
            Self::Camera(camera) => camera.restore(&mut read),
            Self::Kernels(kernels) => kernels.restore(&mut read),
            Self::Both(both) => {
                both.camera.restore(&mut read)?;
                both.kernels.restore(&mut read)
            }
        }
    }
}

impl Trace {
    /// What later iterations want to know of the view, if anything; see [`BlurModel::learned`].
    pub(crate) fn lesson(&self) -> Option<Tensor<2>> {
        self.kernels().and_then(KernelTrace::shifts)
    }

    fn kernels(&self) -> Option<&KernelTrace> {
        match self {
            Self::Kernels(trace) | Self::Both(_, trace) => Some(trace),
            Self::Camera(_) => None,
        }
    }
}

/// Figures of a blur model over all training frames, as `metrics.json` holds them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum BlurFigures {
    /// Of [`BlurModel::Both`].
    Both {
        /// What the camera did.
        #[serde(flatten)]
        camera: CameraFigures,
        /// What is left to kernels.
        #[serde(flatten)]
        kernels: KernelFigures,
    },
    /// Of [`BlurModel::Kernels`].
    Kernels(KernelFigures),
    /// Of [`BlurModel::Camera`].
    Camera(CameraFigures),
}

impl fmt::Display for BlurFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Both { camera, kernels } => write!(f, "{camera}; {kernels}"),
            Self::Kernels(figures) => figures.fmt(f),
            Self::Camera(figures) => figures.fmt(f),
        }
    }
}

/// How one view was blurred, for pictures and figures.
#[derive(Clone, Debug)]
pub enum ViewBlur {
    /// By a kernel per pixel.
    Kernels(KernelView),
    /// By what the camera did.
    Camera(TakenView),
    /// By what the camera did, and then by kernels.
    Both(TakenView, KernelView),
}

impl From<Trace> for ViewBlur {
    fn from(trace: Trace) -> Self {
        match trace {
            Trace::Kernels(trace) => Self::Kernels(trace.view()),
            Trace::Camera(trace) => Self::Camera(trace.view),
            Trace::Both(camera, kernels) => Self::Both(camera.view, kernels.view()),
        }
    }
}

/// Sums of the figures of several views, for each variant.
#[derive(Debug, Default)]
pub(crate) struct FigureSums {
    kernels: KernelSums,
    camera: Vec<TakenView>,
}

impl FigureSums {
    /// Adds a view whose picture, as the model has it, agrees with the frame to `psnr` dB.
    pub(crate) fn add(&mut self, view: &ViewBlur, psnr: f64) {
        let (camera, kernels) = match view {
            ViewBlur::Kernels(kernels) => (None, Some(kernels)),
            ViewBlur::Camera(camera) => (Some(camera), None),
            ViewBlur::Both(camera, kernels) => (Some(camera), Some(kernels)),
        };
        if let Some(kernels) = kernels {
            self.kernels.add(kernels);
        }
        if let Some(camera) = camera {
            let mut view = camera.clone();
            view.frame.psnr = Some(psnr);
            self.camera.push(view);
        }
    }

    /// Of all views; `None` where no view was blurred.
    pub(crate) fn figures(self) -> Option<BlurFigures> {
        match (CameraFigures::of(&self.camera), self.kernels.means()) {
            (Some(camera), Some(kernels)) => Some(BlurFigures::Both { camera, kernels }),
            (None, Some(kernels)) => Some(BlurFigures::Kernels(kernels)),
            (Some(camera), None) => Some(BlurFigures::Camera(camera)),
            (None, None) => None,
        }
    }
}
