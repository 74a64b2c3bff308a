//! What was decided before the first iteration, and stays.

use crate::changes::Change;
use crate::inputs::Inputs;
use crate::model::Model;
use crate::schedule::{Modelled, Schedule};
use crate::settings::Settings;
use crate::survey::Survey;
use crate::views::Views;
use io::Scene;

/// What was asked for, what was found in the scene, and when things happen because of both. Where a run became longer than it was
/// to be, the schedule is still the one of the first settings.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) settings: Settings,
    /// What was changed of the settings on the way.
    pub(crate) changes: Vec<Change>,
    /// What there is to learn from.
    pub(crate) inputs: Inputs,
    pub(crate) survey: Survey,
    pub(crate) views: Views,
    pub(crate) schedule: Schedule,
}

impl Plan {
    /// Near plane, scene units.
    pub(crate) fn near(&self) -> f64 {
        self.settings.gaussians.near * self.survey.scene_size
    }

    /// The views of a scene, as this run looks at them.
    pub(crate) fn views_of(&self, scene: &Scene) -> Views {
        Views::of(scene, self.near())
    }

    /// The most Gaussians this run may have.
    pub(crate) fn max_gaussians(&self) -> usize {
        let pixels = self.views.train[0].camera.num_pixels();
        self.settings.gaussians.most(pixels)
    }
}

/// When things happen in the training of `model`; `unseen` says whether there are unseen views.
pub(crate) fn schedule_of(
    settings: &Settings,
    views: &Views,
    model: &Model,
    unseen: bool,
) -> Schedule {
    let modelled = Modelled {
        motion: model.world.motion.is_some(),
        unseen,
        blur_moments: model.blur.moments(),
        camera_settled: model.blur.camera_settled(),
    };
    Schedule::new(settings, views.train.len(), modelled)
}
