//! Trials: a path that points in a wrong direction, or has shrunk to nothing, does not leave it by itself. A few times in a
//! run every frame tries others, with the Gaussians as they are, and keeps what explains it best.

use super::CameraBlur;
use crate::TrainError;
use crate::look::Look;
use crate::tensors::{constant, host, leaf, tensor};
use crate::world::World;
use capture::RIGID;
use tracing::trace_span;

impl CameraBlur {
    /// Tries other paths and focus distances on every frame, where it is time: the one that explains the frame best stays.
    /// `looks` are those at all training frames. Returns the frames whose path changed.
    pub(super) fn revise(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
    ) -> Result<Vec<usize>, TrainError> {
        let Some(it) = looks.first().map(|look| look.iteration) else {
            return Ok(Vec::new());
        };
        if !self.settings.path || !self.moments.trials.contains(&it) || !self.is_on(it) {
            return Ok(Vec::new());
        }
        let _span = trace_span!("trials").entered();
        let world = world.detached();
        let width = RIGID * self.settings.path_degree;
        let mut paths = host(self.capture.paths.clone().detach());
        let mut now = Vec::with_capacity(looks.len());
        let mut trial = self.clone();
        for (_, tensor) in trial.parameters_mut() {
            *tensor = constant(tensor);
        }
        for look in looks {
            now.push(trial.error(&world, look)?);
        }
        let lengths: Vec<f64> = (0..looks.len())
            .map(|frame| self.capture.path_px(frame, self.focal[frame]))
            .collect();
        let (usual, usual_px) = (median(&now), median(&lengths));
        let last = self.moments.trials.last() == Some(&it);
        let mut changed = Vec::new();
        for (frame, look) in looks.iter().enumerate() {
            let own = paths[frame * width..(frame + 1) * width].to_vec();
            let mut candidates = vec![reversed(&own)];
            // 2.5 dB under the others, or hardly moved: it does not leave a wrong direction by itself.
            if now[frame] > 1.8 * usual || lengths[frame] < 0.4 * usual_px {
                candidates.extend(self.others(own.len(), usual_px / self.focal[frame]));
            }
            let mut best = (now[frame], own.clone());
            for candidate in candidates {
                trial.set_path(frame, &candidate);
                let error = trial.error(&world, look)?;
                if error < best.0 {
                    best = (error, candidate);
                }
            }
            if last && lengths[frame] < 1.0 {
                // What does not pay is left out for good.
                let still = vec![0.0; own.len()];
                trial.set_path(frame, &still);
                if trial.error(&world, look)? <= 1.01 * best.0 {
                    best.1 = still;
                }
            }
            trial.set_path(frame, &best.1);
            if best.1 != own {
                paths[frame * width..(frame + 1) * width].copy_from_slice(&best.1);
                changed.push(frame);
            }
        }
        let device = self.capture.paths.device().inner();
        self.capture.paths = leaf(tensor(paths, self.capture.paths.dims(), &device), true);
        Ok(changed)
    }

    /// Straight paths in eight directions, half as long as `length` (rad), as long, and twice as long.
    fn others(&self, width: usize, length: f64) -> Vec<Vec<f32>> {
        let directions = (0..8).map(|k| std::f64::consts::TAU * f64::from(k) / 8.0);
        directions
            .flat_map(|angle| {
                [0.5, 1.0, 2.0].map(|times| {
                    let mut path = vec![0.0; width];
                    path[0] = (times * length * angle.cos()) as f32;
                    path[1] = (times * length * angle.sin()) as f32;
                    path
                })
            })
            .collect()
    }

    fn set_path(&mut self, frame: usize, path: &[f32]) {
        let paths = self.capture.paths.clone();
        let device = paths.device();
        let [frames, width] = paths.dims();
        let mut values = host(paths);
        values[frame * width..(frame + 1) * width].copy_from_slice(path);
        self.capture.paths = tensor(values, [frames, width], &device);
    }

    /// Mean squared difference between what the camera would have seen and the frame.
    fn error(&self, world: &World, look: &Look<'_>) -> Result<f64, TrainError> {
        let Some(view) = look.view else {
            return Ok(0.0);
        };
        let seen = self.show(world, look)?.seen;
        let difference = (seen.clone() - view.image(&seen)).square().mean();
        Ok(f64::from(host(difference)[0]))
    }
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// The same path the other way round.
fn reversed(path: &[f32]) -> Vec<f32> {
    let odd = |k: usize| (k / RIGID).is_multiple_of(2);
    let values = path.iter().enumerate();
    values.map(|(k, v)| if odd(k) { -v } else { *v }).collect()
}
