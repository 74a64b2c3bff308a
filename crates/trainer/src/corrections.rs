//! What was given wrong of the training frames: where they were taken from, and how bright they are against each other.

use crate::look::{Look, Terms};
use crate::parameter::{Group, Parameter};
use crate::scene_shift::SceneShift;
use crate::settings::Settings;
use crate::survey::Survey;
use crate::tensors::{host, leaf};
use crate::views::{CameraView, Views, pose_tensor, poses_of};
use burn::tensor::{DType, Device, Tensor};
use capture::{RIGID, moved, shift_in_image, turns};
use glam::DAffine3;
use host::product;
use serde::{Deserialize, Serialize};

/// Offsets and gains of all training frames. Their means over the frames are zero: what all have in common is the scene's.
#[derive(Clone, Debug, Default)]
pub struct Corrections {
    /// Offsets from the given poses, [N, 6], in the camera's axes: turns (about rad, see `capture::moved`) and translations (S);
    /// `None` where the given poses hold.
    offsets: Option<Tensor<2>>,
    /// The matrix [2 N, 2 N] that takes the frames' shifts to what they have in common: that is the scene's.
    shared: Option<Tensor<2>>,
    /// Logarithms of the gains of the pictures' values, [N, 1]; `None` where frames are equally bright.
    gains: Option<Tensor<2>>,
    /// Weight of the offsets' shifts in the loss.
    shift_weight: f64,
    /// Scene size S, scene units.
    scene_size: f64,
}

/// How one frame was corrected.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameCorrection {
    /// How far the frame's pose lies off the given one, px at the depth S.
    pub offset_px: f64,
    /// By what factor its values are brighter than the scene's.
    pub gain: f64,
}

impl Corrections {
    /// Those that the settings ask for or the survey finds necessary, still zero.
    pub(crate) fn new(
        settings: &Settings,
        survey: &Survey,
        views: &Views,
        options: (&Device, DType),
    ) -> Self {
        let num_frames = views.train.len();
        let all = vec![true; num_frames];
        let zeros = |columns| Tensor::<2>::zeros([num_frames, columns], options).require_grad();
        let frames = &settings.frames;
        Self {
            offsets: frames.offsets.then(|| zeros(RIGID)),
            shared: frames.offsets.then(|| {
                let shared = SceneShift::of(&views.train).among(&all, &all);
                shared.of_shifts_on(options)
            }),
            gains: frames.gains.holds(survey.gains_differ).then(|| zeros(1)),
            shift_weight: settings.loss.offset_shift,
            scene_size: survey.scene_size,
        }
    }

    /// The look as the frame was taken.
    pub(crate) fn applied<'a>(&self, look: &Look<'a>) -> Look<'a> {
        let mut look = look.clone();
        let Some(frame) = look.frame else {
            return look;
        };
        if let Some(offsets) = &self.offsets {
            look = look.moved(row(offsets, frame), self.scene_size);
        }
        look.gain = self.gains.as_ref().map(|gains| row(gains, frame).exp());
        look
    }

    /// Its own terms of the loss of a view.
    pub(crate) fn add_terms(&self, look: &Look<'_>, terms: &mut Terms) {
        if let (Some(view), Some(offsets)) = (look.view, &self.offsets) {
            terms.add("offset_shift", self.shift_weight, || {
                let shift = shift_in_image(row(offsets, view.frame));
                let px = shift.mul_scalar(view.viewpoint.camera.fx);
                px.square().sum().reshape([1])
            });
        }
    }

    /// Where a frame was taken from, given where it is said to be.
    pub(crate) fn pose(&self, frame: usize, given: &DAffine3) -> DAffine3 {
        let Some(offsets) = &self.offsets else {
            return *given;
        };
        let options = (&offsets.device(), offsets.dtype());
        let given = pose_tensor(given, options);
        let corrected = poses_of(moved(row(offsets, frame), &given, self.scene_size));
        corrected[0]
    }

    /// Takes out what all frames have in common, which is the scene's: the mean, and of offsets what they shift if the scene
    /// lies elsewhere.
    pub(crate) fn hold(&mut self) {
        for (_, values) in self.parameters_mut() {
            let held = values.clone().inner();
            let mean = held.clone().mean_dim(0);
            *values = leaf(held - mean, true);
        }
        if let (Some(offsets), Some(shared)) = (&mut self.offsets, &self.shared) {
            let held = offsets.clone().inner();
            let shifts = shift_in_image(held.clone());
            let shape = shifts.dims();
            let common = product(shared.clone(), shifts.reshape([2 * shape[0], 1]));
            let common = common.reshape(shape);
            *offsets = leaf(held - turns(common), true);
        }
    }

    pub(crate) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        let offsets = self.offsets.as_mut();
        let gains = self.gains.as_mut();
        let offsets = offsets.map(|t| (Parameter::new("frames.offsets", Group::FrameOffset), t));
        let gains = gains.map(|t| (Parameter::new("frames.gains", Group::FrameGain), t));
        offsets.into_iter().chain(gains).collect()
    }

    /// What was corrected in frames that were seen so; `None` where nothing is.
    pub(crate) fn figures(&self, views: &[CameraView]) -> Option<Vec<FrameCorrection>> {
        if self.offsets.is_none() && self.gains.is_none() {
            return None;
        }
        let shifts = self
            .offsets
            .clone()
            .map(|t| host(shift_in_image(t.detach())));
        let gains = self.gains.clone().map(|t| host(t.detach()));
        let frames = views.iter().enumerate();
        let corrections = frames.map(|(frame, view)| FrameCorrection {
            offset_px: shifts.as_ref().map_or(0.0, |shifts| {
                let [x, y] = [0, 1].map(|axis| f64::from(shifts[2 * frame + axis]));
                view.camera.fx * x.hypot(y)
            }),
            gain: gains
                .as_ref()
                .map_or(1.0, |gains| f64::from(gains[frame]).exp()),
        });
        Some(corrections.collect())
    }
}

fn row(values: &Tensor<2>, frame: usize) -> Tensor<2> {
    values.clone().narrow(0, frame, 1)
}
