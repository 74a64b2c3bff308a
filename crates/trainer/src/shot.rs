//! The scene as another exposure would have it: sharp slow motion out of a blurry video, or more blur on purpose.

use crate::TrainError;
use crate::guarded::guarded;
use crate::run::{Run, to_image};
use crate::views::pose_tensor;
use burn::tensor::{DType, Tensor, TensorData};
use capture::{Capture, Sample, samples};
use glam::DAffine3;
use io::Image;
use splat_core::{Exposure, Viewpoint, expose};

/// How a picture is taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Its middle, in units of training frames; may be fractional.
    pub time: f32,
    /// Time for which the shutter is open, in units of training frames.
    pub shutter: f64,
    /// Radius of the lens, scene units.
    pub aperture: f64,
    /// Depth that is in focus, scene units.
    pub focus: f64,
    /// Renders that are averaged, of as many moments and points of the lens.
    pub samples: usize,
}

impl Shot {
    /// Whether a picture can be taken like that.
    ///
    /// # Errors
    /// A number is not finite or out of range; which, and what is expected.
    pub fn check(&self) -> Result<(), TrainError> {
        let Self {
            time,
            shutter,
            aperture,
            focus,
            samples,
        } = *self;
        let problem = if !time.is_finite() {
            "the time is a finite number of training frames"
        } else if !(shutter.is_finite() && shutter >= 0.0) {
            "the shutter is open for a number of training frames, 0 or more"
        } else if !(aperture.is_finite() && aperture >= 0.0) {
            "the aperture is a radius in scene units, 0 or more"
        } else if !(focus.is_finite() && focus > 0.0) {
            "the focus is a depth in scene units, over 0"
        } else if !(1..=Self::MAX_SAMPLES).contains(&samples) {
            "a picture is averaged from 1 to 1024 renders"
        } else {
            return Ok(());
        };
        Err(TrainError::Shot { problem })
    }

    /// The most renders that a picture is averaged from.
    pub const MAX_SAMPLES: usize = 1024;
}

impl Run {
    /// The picture that the video's own camera would have taken, from where it was at the shot's moments.
    ///
    /// # Errors
    /// The shot is out of range; the renderer refuses its input; the device fails.
    pub fn render_shot(&self, shot: &Shot) -> Result<Image, TrainError> {
        shot.check()?;
        guarded(&self.device, || self.take(shot))
    }

    fn take(&self, shot: &Shot) -> Result<Image, TrainError> {
        let trajectory = self.trajectory();
        let view = self.view_on(&trajectory, shot.time);
        if shot.shutter == 0.0 && shot.aperture == 0.0 {
            return self.render_viewpoint(&view);
        }
        let world = self.model().world.detached();
        let taken = samples(shot.samples, 0.0);
        let times: Vec<f64> = taken
            .iter()
            .map(|sample| f64::from(shot.time) + shot.shutter * sample.moment)
            .collect();
        let poses = taken
            .iter()
            .zip(&times)
            .map(|(sample, time)| self.through_lens(shot, sample, &trajectory.pose(*time)));
        let poses = Tensor::cat(poses.collect(), 0);
        let options = (&world.means.device(), world.means.dtype());
        let moments =
            Tensor::<1>::from_data(TensorData::new(times.clone(), [taken.len()]), options);
        let splats = world.pose(shot.time).splats;
        let middle = Viewpoint::new(
            &view.camera,
            &view.cam_from_world,
            self.schedule().sh_degree_at(self.iteration()),
            &splats,
        );
        let exposure = Exposure {
            poses,
            movers: world.exposed_at(&moments, &times),
            transfer: self.settings().camera.transfer.into(),
        };
        Ok(to_image(expose(splats, &middle, exposure, None)?.color))
    }

    /// The pose [1, 3, 4] of a camera as a point of its lens sees it.
    fn through_lens(&self, shot: &Shot, sample: &Sample, pose: &DAffine3) -> Tensor<3> {
        let size = self.survey().scene_size;
        let options = (&self.device.clone().inner(), DType::F32);
        let mut lens = Capture::still(1, 1, options);
        lens.aperture = lens.aperture + shot.aperture / size;
        lens.focus = lens.focus * (size / shot.focus);
        let pose = pose_tensor(pose, options);
        let point = Sample {
            moment: 0.0,
            ..*sample
        };
        lens.poses(0, &pose, &[point], size)
    }
}
