//! How close the kernels by which a model blurs come to the true ones, where a scene knows them.

use crate::TrainError;
use crate::blur::{KernelView, ViewBlur};
use crate::metrics::decibel;
use crate::pixel_kernel::PixelKernel;
use crate::placement::dilate;
use crate::run::Run;
use crate::views::{CameraView, pixel_center};
use glam::DAffine3;
use io::{Frame, Map, Scene, TrueExposure};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use splat_core::Camera;
use unseen_views::depth_edges;

/// Every so many pixels along x and y have their kernel scored.
const STRIDE: usize = 8;
/// Relative jump of depth between neighbours beyond which a kernel reaches over the edge of something.
const EDGE: f64 = 0.05;
/// Movers' masks are taken to be so many px wider.
const MOVERS_EDGE: usize = 2;
/// Kernels are compared on a square that reaches so many px further than the true ones.
const MARGIN: usize = 2;
/// What is added to every weight of both kernels before the divergence is taken, so that none is 0.
const LEAST_WEIGHT: f64 = 1e-5;
/// Renders that stand for what the model's camera collects.
const SAMPLES: usize = 128;

/// Kernels of training views against the true ones, over pixels that stand still in the run and away from depth edges, on squares of
/// one size that hold all the true ones. In a run without movers all of them stand still, whatever masks the scene has.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KernelScores {
    /// As they are.
    #[serde(flatten)]
    pub as_found: KernelScore,
    /// Each around its own middle: a shift that all kernels of a frame share is one of the scene, and says nothing of the blur.
    pub centred: KernelScore,
    /// Kernels that were compared.
    pub count: usize,
    /// Side of the squares, px.
    pub side: usize,
}

/// How close kernels that sum to 1 come to each other; means over the training views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KernelScore {
    /// PSNR over all weights of a view's kernels, for a peak of 1 (the kernel of a sharp picture), dB.
    pub psnr: f64,
    /// Kullback-Leibler divergence of the model's kernels from the true ones, nats. 1e-5 is added to every weight of both.
    pub kl: f64,
}

/// The true kernels of a scene, and what was scored against them.
pub(crate) struct TrueKernels<'a> {
    frames: Vec<TrueFrame<'a>>,
    radius: usize,
    scored: Vec<[KernelScore; 2]>,
}

/// A frame, and which of its pixels are scored.
struct TrueFrame<'a> {
    camera: &'a Camera,
    exposure: &'a TrueExposure,
    pixels: Vec<usize>,
}

impl TrueFrame<'_> {
    fn kernel(&self, pixel: usize) -> PixelKernel {
        let at = pixel_center(self.camera, pixel);
        let depth = f64::from(self.exposure.depth.values[pixel]);
        PixelKernel::exposed(self.camera, &self.exposure.cameras, at, depth)
    }
}

impl<'a> TrueKernels<'a> {
    /// `None` where exposures are not known, or no pixel can be scored. Masks count where the run has movers: a survey that finds
    /// none takes them away, and whoever scores a run later has the scene as it was read.
    pub(crate) fn of(
        scene: &'a Scene,
        exposures: Option<&'a [TrueExposure]>,
        has_movers: bool,
    ) -> Option<Self> {
        let frames: Vec<_> = scene
            .frames
            .iter()
            .zip(exposures?)
            .map(|(frame, exposure)| TrueFrame {
                camera: &frame.view.camera,
                exposure,
                pixels: scored_pixels(frame, exposure, has_movers),
            })
            .collect();
        let kernels = frames
            .iter()
            .flat_map(|frame| frame.pixels.iter().map(|pixel| frame.kernel(*pixel)));
        let radius = kernels
            .map(|kernel| kernel.radius().max(kernel.centred().radius()))
            .max()?;
        Some(Self {
            frames,
            radius: radius + MARGIN,
            scored: Vec::new(),
        })
    }

    /// Scores a frame, of which `model` knows the kernel of every pixel.
    pub(crate) fn score(&mut self, frame: usize, model: impl Fn(usize) -> PixelKernel + Sync) {
        let (frame, radius) = (&self.frames[frame], self.radius);
        let compared: Vec<[Compared; 2]> = frame
            .pixels
            .par_iter()
            .map(|&pixel| {
                let (truth, found) = (frame.kernel(pixel), model(pixel));
                let compare = |truth: &PixelKernel, found: &PixelKernel| {
                    Compared::of(&truth.on_grid(radius), &found.on_grid(radius))
                };
                let as_found = compare(&truth, &found);
                [as_found, compare(&truth.centred(), &found.centred())]
            })
            .collect();
        if !compared.is_empty() {
            let score = |k: usize| Compared::score(compared.iter().map(|both| both[k]));
            self.scored.push([score(0), score(1)]);
        }
    }

    /// Means over the frames that were scored.
    pub(crate) fn scores(self) -> Option<KernelScores> {
        let count = self.scored.len() as f64;
        let mean = |k: usize| {
            let of = |value: fn(&KernelScore) -> f64| {
                self.scored.iter().map(|s| value(&s[k])).sum::<f64>() / count
            };
            KernelScore {
                psnr: of(|s| s.psnr),
                kl: of(|s| s.kl),
            }
        };
        (!self.scored.is_empty()).then(|| KernelScores {
            as_found: mean(0),
            centred: mean(1),
            count: self.frames.iter().map(|frame| frame.pixels.len()).sum(),
            side: 2 * self.radius + 1,
        })
    }
}

/// How far two kernels are apart.
#[derive(Clone, Copy)]
struct Compared {
    /// Mean of the squared differences.
    error: f64,
    divergence: f64,
}

impl Compared {
    fn of(truth: &[f64], found: &[f64]) -> Self {
        let count = truth.len() as f64;
        let (mut error, mut divergence) = (0.0, 0.0);
        for (truth, found) in truth.iter().zip(found) {
            error += (truth - found).powi(2) / count;
            let [p, q] = [truth, found].map(|w| (w + LEAST_WEIGHT) / (1.0 + count * LEAST_WEIGHT));
            divergence += p * (p / q).ln();
        }
        Self { error, divergence }
    }

    /// Of all kernels of a frame.
    fn score(all: impl ExactSizeIterator<Item = Self>) -> KernelScore {
        let count = all.len();
        let (error, divergence) = all.fold((0.0, 0.0), |(error, divergence), one| {
            (error + one.error, divergence + one.divergence)
        });
        KernelScore {
            psnr: decibel(error, count),
            kl: divergence / count as f64,
        }
    }
}

/// Pixels of a frame whose true kernel is known: inside the picture and with depth, where nothing moves and no depth edge lies as far
/// as the kernel reaches.
fn scored_pixels(frame: &Frame, exposure: &TrueExposure, has_movers: bool) -> Vec<usize> {
    let (camera, depth) = (&frame.view.camera, &exposure.depth);
    let (width, height) = (camera.width, camera.height);
    let edge = depth_edges(&depth.values, width, EDGE);
    let moving = frame.mask.as_ref().filter(|_| has_movers);
    let moving = moving.map(|mask| dilate(mask, MOVERS_EDGE, 0.02));
    let is_known = |pixel: usize| {
        let is_still = moving.as_ref().is_none_or(|moving| !moving[pixel]);
        is_still && !edge[pixel] && depth.values[pixel] > 0.0
    };
    let rows = (STRIDE / 2..height).step_by(STRIDE);
    let all = rows.flat_map(|y| (STRIDE / 2..width).step_by(STRIDE).map(move |x| (x, y)));
    let scored = all.filter(|&(x, y)| {
        let (pixel, z) = (y * width + x, f64::from(depth.values[y * width + x]));
        if z <= 0.0 {
            return false;
        }
        let kernel =
            PixelKernel::exposed(camera, &exposure.cameras, pixel_center(camera, pixel), z);
        let radius = kernel.radius();
        let inside = |at: usize, size: usize| at >= radius && radius < size - at;
        inside(x, width)
            && inside(y, height)
            && (y - radius..=y + radius)
                .all(|v| (x - radius..=x + radius).all(|u| is_known(v * width + u)))
    });
    scored.map(|(x, y)| y * width + x).collect()
}

/// The kernels by which a model blurs a training view.
pub(crate) struct ModelKernels<'a> {
    camera: &'a Camera,
    /// BP-Net's.
    window: Option<&'a KernelView>,
    /// What the model's camera collects, and the depth that the model has.
    collected: Option<(Vec<DAffine3>, Map)>,
}

impl ModelKernels<'_> {
    /// The kernel of a pixel.
    pub(crate) fn at(&self, pixel: usize) -> PixelKernel {
        let window = self.window.map_or_else(PixelKernel::none, |view| {
            let length = view.kernels.len() / self.camera.num_pixels();
            let weights = &view.kernels[pixel * length..(pixel + 1) * length];
            let intensity = f64::from(view.intensity.values[pixel]);
            PixelKernel::of_weights(self.camera, weights, intensity, pixel)
        });
        match &self.collected {
            None => window,
            Some((cameras, depth)) => window.after(self.camera, cameras, depth, pixel),
        }
    }
}

impl Run {
    /// The kernels of a training view that was blurred so.
    pub(crate) fn model_kernels<'a>(
        &'a self,
        frame: usize,
        blur: Option<&'a ViewBlur>,
    ) -> Result<ModelKernels<'a>, TrainError> {
        let view = &self.views().train[frame];
        let window = match blur {
            Some(ViewBlur::Kernels(kernels) | ViewBlur::Both(_, kernels)) => Some(kernels),
            Some(ViewBlur::Camera(_)) | None => None,
        };
        let cameras = blur.and_then(|_| self.model().blur.cameras(frame, SAMPLES));
        let collected = match cameras {
            None => None,
            Some(cameras) => {
                let seen = self.render_layers(&CameraView {
                    cam_from_world: self.training_pose(frame),
                    ..view.clone()
                })?;
                let mut depth = seen.depth;
                // Where nothing is seen, nothing tells how far what is not there would be.
                let size = self.survey().scene_size as f32;
                for z in depth.values.iter_mut().filter(|z| **z <= 0.0) {
                    *z = size;
                }
                Some((cameras, depth))
            }
        };
        Ok(ModelKernels {
            camera: &view.camera,
            window,
            collected,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::LARGEST_PSNR;
    use glam::DVec3;
    use io::{Image, View};

    /// A wall at depth 2 in 40 x 32 px, seen by cameras that stand so many px' worth to the right.
    fn frame(shifts: &[f64]) -> (Frame, TrueExposure) {
        let camera = Camera::pinhole([40, 32], [50.0; 2], [20.0, 16.0]);
        let cameras = shifts
            .iter()
            .map(|px| DAffine3::from_translation(DVec3::new(-px * 2.0 / 50.0, 0.0, 0.0)));
        let exposure = TrueExposure {
            cameras: cameras.collect(),
            depth: Map {
                width: 40,
                height: 32,
                values: vec![2.0; 40 * 32],
            },
        };
        let view = View {
            name: "0".to_owned(),
            camera,
            cam_from_world: DAffine3::IDENTITY,
            time: 0.0,
            image: Image {
                width: 40,
                height: 32,
                pixels: vec![0.5; 3 * 40 * 32],
            },
        };
        let frame = Frame {
            view,
            depth: None,
            mask: None,
        };
        (frame, exposure)
    }

    /// The scores of a model that says that the kernel of each pixel is `found`.
    fn scored(shifts: &[f64], found: &[f64]) -> KernelScores {
        let (frame, exposure) = frame(shifts);
        let (scene, exposures) = (Scene::of_frames(vec![frame]), [exposure]);
        let mut kernels = TrueKernels::of(&scene, Some(&exposures), true).expect("kernels");
        let camera = &scene.frames[0].view.camera;
        let cameras = self::frame(found).1.cameras;
        kernels.score(0, |pixel| {
            PixelKernel::exposed(camera, &cameras, pixel_center(camera, pixel), 2.0)
        });
        kernels.scores().expect("scores")
    }

    #[test]
    fn true_kernels_score_as_well_as_can_be() {
        let scores = scored(&[-2.0, 0.5, 1.0], &[-2.0, 0.5, 1.0]);
        let best = KernelScore {
            psnr: LARGEST_PSNR,
            kl: 0.0,
        };
        assert_eq!((scores.as_found, scores.centred), (best, best));
        // 5 by 4 pixels; two px to the left and right of each are inside.
        assert_eq!((scores.count, scores.side), (20, 2 * (2 + MARGIN) + 1));
    }

    #[test]
    fn a_kernel_that_is_shifted_by_a_pixel_scores_as_computed_by_hand() {
        let scores = scored(&[1.0], &[0.0]);
        // One weight of 1 in each of 49, in two places.
        assert_eq!(scores.side, 7);
        let psnr = -10.0 * (2.0_f64 / 49.0).log10();
        assert!((scores.as_found.psnr - psnr).abs() < 1e-9, "{scores:?}");
        let kl = (1.0_f64 + 1e-5).ln() - 1e-5_f64.ln();
        let kl = kl / (1.0 + 49.0 * 1e-5);
        assert!((scores.as_found.kl - kl).abs() < 1e-9, "{scores:?} {kl}");
        // But for the shift it is the true one.
        assert!(scores.centred.psnr > 119.0 && scores.centred.kl.abs() < 1e-9);
    }

    #[test]
    fn movers_edges_and_what_has_no_depth_are_left_out() {
        let all = {
            let (frame, exposure) = frame(&[-1.0, 1.0]);
            scored_pixels(&frame, &exposure, true)
        };
        assert_eq!(all.len(), 20);
        let without = |change: &dyn Fn(&mut Frame, &mut TrueExposure)| -> Vec<usize> {
            let (mut frame, mut exposure) = frame(&[-1.0, 1.0]);
            change(&mut frame, &mut exposure);
            let left = scored_pixels(&frame, &exposure, true);
            all.iter().filter(|p| !left.contains(p)).copied().collect()
        };
        let at = |x: usize, y: usize| y * 40 + x;
        let marked = |x, y| {
            let mut mask = Map {
                width: 40,
                height: 32,
                values: vec![0.0; 40 * 32],
            };
            mask.values[at(x, y)] = 1.0;
            Some(mask)
        };
        // Three px from the pixel at (12, 12): the mask's edge is taken to be two px further out, and the kernel reaches one.
        assert_eq!(without(&|f, _| f.mask = marked(15, 12)), [at(12, 12)]);
        assert!(without(&|f, _| f.mask = marked(16, 12)).is_empty());
        let (mut masked, exposure) = frame(&[-1.0, 1.0]);
        masked.mask = marked(15, 12);
        assert_eq!(scored_pixels(&masked, &exposure, false), all, "no movers");
        assert_eq!(
            without(&|_, e| e.depth.values[at(13, 12)] = 0.0),
            [at(12, 12)]
        );
        let step = without(&|_, e| {
            for y in 0..32 {
                for x in 13..40 {
                    e.depth.values[at(x, y)] = 5.0;
                }
            }
        });
        assert_eq!(step, [at(12, 4), at(12, 12), at(12, 20), at(12, 28)]);
    }
}
