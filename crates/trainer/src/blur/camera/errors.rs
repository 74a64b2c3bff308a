//! Errors: how far what the camera would have seen is from the frames, by which trials judge.

use super::CameraBlur;
use super::softness::{SOFTNESS, softened, softened_along};
use crate::TrainError;
use crate::look::{Look, render_posed};
use crate::losses::mean;
use crate::tensors::host;
use crate::views::ViewRef;
use crate::world::World;
use burn::tensor::Tensor;

impl CameraBlur {
    /// The error of every frame.
    pub(super) fn errors(&self, world: &World, looks: &[Look<'_>]) -> Result<Vec<f64>, TrainError> {
        looks.iter().map(|look| self.error(world, look)).collect()
    }

    /// The error of all frames together with the scene as soft as explains them best.
    pub(super) fn softer_scene_error(
        &self,
        world: &World,
        looks: &[Look<'_>],
    ) -> Result<f64, TrainError> {
        let (mut sharp, mut softer) = (0.0, [0.0; SOFTNESS.len()]);
        for look in looks {
            let Some(view) = look.view else { continue };
            let seen = self.seen(world, look, view)?;
            for (total, variance) in softer.iter_mut().zip(SOFTNESS) {
                *total += squared_error(softened(&seen, variance), view);
            }
            sharp += squared_error(seen, view);
        }
        Ok(softer.into_iter().fold(sharp, f64::min))
    }

    /// The error of every frame, and that of all together with each by itself as soft as explains it best.
    pub(super) fn softer_frames_errors(
        &self,
        world: &World,
        looks: &[Look<'_>],
    ) -> Result<(Vec<f64>, f64), TrainError> {
        let (mut errors, mut softer) = (Vec::new(), 0.0);
        for look in looks {
            let mut error = 0.0;
            if let Some(view) = look.view {
                let seen = self.seen(world, look, view)?;
                error = squared_error(seen.clone(), view);
                softer += softened_error(seen, error, view);
            }
            errors.push(error);
        }
        Ok((errors, softer))
    }

    /// Mean squared difference between what the camera would have seen and the frame.
    pub(super) fn error(&self, world: &World, look: &Look<'_>) -> Result<f64, TrainError> {
        match look.view {
            Some(view) => Ok(squared_error(self.seen(world, look, view)?, view)),
            None => Ok(0.0),
        }
    }

    /// What the camera would have seen, [H, W, 3].
    fn seen(
        &self,
        world: &World,
        look: &Look<'_>,
        view: &ViewRef<'_>,
    ) -> Result<Tensor<3>, TrainError> {
        let posed = world.pose(look.viewpoint.time);
        let taken = self.view(view.frame, look.iteration);
        let seen = if taken.frame.is_sharp() {
            let viewpoint = look.viewpoint_of(&posed.splats);
            render_posed(posed, &viewpoint, None)?.color()
        } else {
            let splats = posed.splats;
            // Always the same points of the lens: by others the error would be another one.
            self.exposed(world, look, splats, (view.frame, &taken), 0.0)?
                .color
        };
        Ok(look.gained(seen))
    }
}

/// The least error of a frame that is made softer along its columns, and then along its rows; `error` is that of what was seen.
fn softened_error(seen: Tensor<3>, error: f64, view: &ViewRef<'_>) -> f64 {
    let mut best = (error, seen);
    for dim in [0, 1] {
        let seen = best.1.clone();
        for variance in SOFTNESS {
            let softer = softened_along(dim, &seen, variance);
            let error = squared_error(softer.clone(), view);
            if error < best.0 {
                best = (error, softer);
            }
        }
    }
    best.0
}

fn squared_error(seen: Tensor<3>, view: &ViewRef<'_>) -> f64 {
    let target = view.target(&seen);
    f64::from(host(mean((seen - target).square()))[0])
}

pub(super) fn total(errors: &[f64]) -> f64 {
    errors.iter().sum()
}
