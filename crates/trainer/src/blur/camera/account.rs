//! The account of a frame: from the model's tensors to figures and spots.

use super::{CameraBlur, CameraFrame, Spot, TakenView};
use crate::tensors::host;
use burn::tensor::Tensor;
use capture::samples;

/// A focus of a smaller disparity, which is as good as infinite, is given as this.
const LEAST_DISPARITY: f64 = 1e-3;
/// Places of a spot that are drawn.
const SPOT_SAMPLES: usize = 2000;

impl CameraBlur {
    /// What the camera does in a frame, and how it is rendered at iteration `it`.
    pub(super) fn view(&self, frame: usize, it: usize) -> TakenView {
        let focal = self.focal[frame];
        let known = self.known.as_ref().map(|taken| taken[frame].clone());
        let taken = known.unwrap_or_else(|| self.capture.taken(frame));
        let blur_px = taken.path_px(focal);
        let disc_px = self
            .depth_range
            .map(|z| taken.disc_px(focal, self.scene_size / z))
            .into_iter()
            .fold(0.0, f64::max);
        TakenView {
            frame: CameraFrame {
                blur_px,
                focus: self.scene_size / taken.focus.max(LEAST_DISPARITY),
                disc_px,
                samples: self.samples(blur_px, disc_px, it),
                psnr: None,
            },
            shutter: taken.shutter,
            aperture: self.scene_size * taken.aperture.abs(),
            spots: Vec::new(),
        }
    }

    /// The same with its spots, for pictures.
    pub(super) fn with_spots(&self, frame: usize, view: TakenView) -> TakenView {
        let like = &self.capture.paths;
        let options = (&like.device(), like.dtype());
        let identity = [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ];
        let given = Tensor::<2>::from_data(identity, options);
        let taken = samples(SPOT_SAMPLES, 0.0);
        let size = self.scene_size;
        let poses = host(self.capture.poses(frame, &given, &taken, size).detach());
        let focal = self.focal[frame];
        let seen = |pose: &[f32], depth: f64| {
            let at = |i: usize| f64::from(pose[4 * i + 2]) * depth + f64::from(pose[4 * i + 3]);
            [0, 1].map(|axis| focal * at(axis) / at(2))
        };
        let spot = |depth: f64| {
            let places = poses.chunks_exact(12).map(|pose| seen(pose, depth));
            Spot {
                depth,
                places: places.collect(),
            }
        };
        let [near, far] = self.depth_range;
        let spots = [near, size, far].map(spot).to_vec();
        TakenView { spots, ..view }
    }
}
