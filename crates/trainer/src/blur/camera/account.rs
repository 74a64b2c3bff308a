//! The account of a frame: from the model's tensors to figures and spots.

use super::{CameraBlur, CameraFrame, Spot, TakenView};
use crate::tensors::host;
use burn::tensor::Tensor;
use capture::samples;

/// A focus of a smaller disparity, which is as good as infinite, is given as this.
const LEAST_DISPARITY: f64 = 1e-3;
/// Where spots are shown, in widths of the picture to the right of the optical axis.
const SPOTS_AT: [f64; 3] = [-0.4, 0.0, 0.4];
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

    /// The same with its spots, for pictures of such a width.
    pub(super) fn with_spots(&self, frame: usize, view: TakenView, width: usize) -> TakenView {
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
        // The point whose sharp place is so far to the right, as a pose sees it, from there.
        let seen = |pose: &[f32], depth: f64, right_px: f64| {
            let point = [right_px / focal * depth, 0.0, depth, 1.0];
            let row = |i: usize| pose[4 * i..4 * i + 4].iter().zip(point);
            let at = |i: usize| row(i).map(|(p, x)| f64::from(*p) * x).sum::<f64>();
            [focal * at(0) / at(2) - right_px, focal * at(1) / at(2)]
        };
        let spot = |depth: f64, right_px: f64| {
            let places = poses.chunks_exact(12);
            Spot {
                depth,
                right_px,
                places: places.map(|pose| seen(pose, depth, right_px)).collect(),
            }
        };
        let [near, far] = self.depth_range;
        let across = SPOTS_AT.map(|at| at * width as f64);
        let spots = [near, size, far]
            .into_iter()
            .flat_map(|depth| across.map(|right_px| spot(depth, right_px)));
        TakenView {
            spots: spots.collect(),
            ..view
        }
    }
}
