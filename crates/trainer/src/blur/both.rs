//! Kernels on top of the camera: what path and lens do not explain of the blur.

use super::camera::{CameraBlur, CameraTrace};
use super::kernels::{KernelTrace, Kernels};
use crate::TrainError;
use crate::look::{Look, Shown};
use crate::settings::Settings;
use crate::survey::Survey;
use crate::views::Views;
use crate::world::World;
use bpnet::HeadInit;
use burn::tensor::{DType, Device};
use splat_core::Rendered;

/// The camera, and over what it saw, once trials leave it alone and half of the run is over, BP-Net's kernels.
#[derive(Clone, Debug)]
pub struct Both {
    pub(super) camera: CameraBlur,
    pub(super) kernels: Kernels,
}

impl Both {
    /// Untrained kernels over a camera.
    pub(super) fn over(
        camera: CameraBlur,
        settings: &Settings,
        survey: &Survey,
        views: &Views,
        options: (&Device, DType),
    ) -> Result<Self, TrainError> {
        let from = camera.settled().max(settings.iterations / 2);
        // Path and lens explain most of the blur: kernels that start with more of it sharpen the scene beyond the truth.
        let start = (from, HeadInit::Slight);
        let kernels = Kernels::new(settings, survey.scene_size, views, start, options)?;
        Ok(Self { camera, kernels })
    }

    pub(super) fn moments(&self) -> Vec<usize> {
        let mut all = self.camera.moments();
        all.extend(self.kernels.moments());
        all
    }

    /// See [`super::BlurModel::show`] and [`Kernels::over`].
    pub(super) fn show(
        &self,
        world: &World,
        look: &Look<'_>,
        fixed: Option<(&Rendered, Option<&KernelTrace>)>,
    ) -> Result<Shown<(CameraTrace, Option<KernelTrace>)>, TrainError> {
        let shown = self.camera.show(world, look)?;
        let (shown, over) = self.kernels.over(shown, look, fixed)?;
        Ok(shown.map(|camera| (camera, over)))
    }
}
