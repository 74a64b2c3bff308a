//! Everything that is trained: the sharp world, and how frames of it were blurred.

use crate::TrainError;
use crate::blur::{BlurModel, Shown};
use crate::corrections::Corrections;
use crate::look::Look;
use crate::parameter::Parameter;
use crate::tensors::constant;
use crate::world::World;
use burn::tensor::Tensor;

/// Everything that is trained.
#[derive(Clone, Debug)]
pub struct Model {
    /// Gaussians and their motion.
    pub world: World,
    /// How frames were blurred.
    pub blur: BlurModel,
    /// What was given wrong of them.
    pub corrections: Corrections,
}

impl Model {
    /// Number N of Gaussians.
    #[must_use]
    pub fn num_gaussians(&self) -> usize {
        self.world.num_gaussians()
    }

    /// Number F of dynamic Gaussians, which are the first.
    #[must_use]
    pub fn num_dynamic(&self) -> usize {
        self.world.num_dynamic
    }

    /// All parameters.
    #[must_use]
    pub fn parameters(&self) -> Vec<(Parameter, Tensor<2>)> {
        self.clone()
            .parameters_mut()
            .into_iter()
            .map(|(parameter, tensor)| (parameter, tensor.clone()))
            .collect()
    }

    /// All parameters, to be replaced.
    pub fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        let Self {
            world,
            blur,
            corrections,
        } = self;
        let mut all = world.parameters_mut();
        all.extend(blur.parameters_mut());
        all.extend(corrections.parameters_mut());
        all
    }

    /// The same values without a graph behind them: for evaluation.
    #[must_use]
    pub fn detached(&self) -> Self {
        let mut detached = Self {
            world: self.world.detached(),
            ..self.clone()
        };
        let Self {
            blur, corrections, ..
        } = &mut detached;
        let others = blur.parameters_mut();
        for (_, tensor) in others.into_iter().chain(corrections.parameters_mut()) {
            *tensor = constant(tensor);
        }
        detached
    }

    /// What it shows at a look; see [`BlurModel::show`].
    pub(crate) fn show(&self, look: &Look<'_>, fixed: Option<&Shown>) -> Result<Shown, TrainError> {
        let look = self.corrections.applied(look);
        let mut shown = self.blur.show(&self.world, &look, fixed)?;
        shown.seen = look.gained(shown.seen);
        self.corrections.add_terms(&look, &mut shown.terms);
        Ok(shown)
    }
}
