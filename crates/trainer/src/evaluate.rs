//! Renders for people and scores: PSNR, mPSNR and SSIM of the 8-bit pictures that are written.

use crate::TrainError;
use crate::metrics::{masked_psnr, psnr, ssim};
use crate::model::{Model, host};
use crate::objective::blur_inputs;
use crate::placement::dilate;
use crate::trainer::Trainer;
use crate::views::{camera_of, pose_tensor};
use bpnet::{Extractor, composite};
use glam::DAffine3;
use io::{Image, Map, Truth};
use serde::{Deserialize, Serialize};
use splat_core::{Camera, Extra, Rendered, Viewpoint, render};

/// Scores of a run, as `metrics.json` holds them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Test views against their sharp pictures; absent without test views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test: Option<Scores>,
    /// Sharp renders of the training views against their truth, where the scene has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_sharp: Option<Scores>,
    /// Iterations done.
    pub iterations: usize,
    /// Number of Gaussians.
    pub gaussians: GaussianCounts,
    /// Length of the mean of m Σ k Δx over all pixels of all training frames, px; absent without a blur model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kernel_centroid_px: Option<f64>,
    /// Mean blur intensity m over all pixels of all training frames; absent without a blur model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_intensity: Option<f64>,
}

/// How many Gaussians there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GaussianCounts {
    /// Static ones.
    #[serde(rename = "static")]
    pub fixed: usize,
    /// Dynamic ones.
    pub dynamic: usize,
}

/// Means over views, and the views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Means over the views that have the figure.
    #[serde(flatten)]
    pub mean: Figures,
    /// Each view's figures.
    pub views: Vec<ViewScores>,
}

/// Figures of one view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewScores {
    /// File stem.
    pub name: String,
    /// Its figures.
    #[serde(flatten)]
    pub figures: Figures,
}

/// How close a render comes to the truth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// PSNR over the whole picture, dB.
    pub psnr: f64,
    /// SSIM; absent for pictures smaller than its window.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// PSNR over co-visible pixels, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mpsnr: Option<f64>,
    /// The same without movers and what lies within a pixel of them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mpsnr_static: Option<f64>,
    /// The same for movers alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mpsnr_dynamic: Option<f64>,
}

/// Sharp and blurred render of a training view, and its blur.
#[derive(Clone, Debug)]
pub struct BlurredView {
    /// The sharp render.
    pub sharp: Image,
    /// What the model says the camera saw; the sharp render where blur is not modelled.
    pub blurred: Image,
    /// Blur intensity m per pixel; `None` where blur is not modelled.
    pub intensity: Option<Map>,
    /// Kernels, [H, W, K²], K² weights per pixel; `None` where blur is not modelled.
    pub kernels: Option<Vec<f32>>,
    /// Mean of m Σ k Δx over the pixels (px; x, y); zero where blur is not modelled.
    pub centroid: [f64; 2],
}

/// A gain and an offset per channel that bring a test camera's colours to the training camera's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColorMap {
    /// Factors of R, G and B.
    pub gain: [f64; 3],
    /// Offsets of R, G and B, in 8-bit units.
    pub offset: [f64; 3],
}

impl ColorMap {
    fn apply(&self, image: &Image) -> Image {
        let mut mapped = image.clone();
        for pixel in mapped.pixels.chunks_exact_mut(3) {
            for (c, value) in pixel.iter_mut().enumerate() {
                let seen = self.gain[c] * f64::from(*value) + self.offset[c] / 255.0;
                *value = seen.clamp(0.0, 1.0) as f32;
            }
        }
        mapped
    }
}

impl Trainer {
    /// The scene as a camera sees it at a time (training frames, may be fractional), sharp.
    ///
    /// # Errors
    /// The renderer refuses its input.
    pub fn render_view(
        &self,
        camera: &Camera,
        cam_from_world: &DAffine3,
        time: f32,
    ) -> Result<Image, TrainError> {
        let camera = camera.clone().with_near(self.near());
        Ok(to_image(&self.render_detached(
            &self.model.detached(),
            &camera,
            cam_from_world,
            time,
        )?))
    }

    fn render_detached(
        &self,
        model: &Model,
        camera: &Camera,
        cam_from_world: &DAffine3,
        time: f32,
    ) -> Result<Rendered, TrainError> {
        let posed = model.pose(time);
        let viewpoint = Viewpoint {
            camera: camera.clone(),
            cam_from_world: pose_tensor(cam_from_world, &model.means),
            sh_degree: self.schedule.sh_degree_at(self.progress.iteration),
        };
        let extra = Extra {
            features: posed.dynamic,
            screen_grad: None,
        };
        Ok(render(posed.splats, &viewpoint, extra)?)
    }

    /// A training view, sharp and as the model says that the camera saw it.
    ///
    /// # Errors
    /// The renderer refuses its input.
    pub fn render_training_view(&self, frame: usize) -> Result<BlurredView, TrainError> {
        let view = &self.scene.frames[frame].view;
        let camera = camera_of(&self.scene, frame, self.near());
        let model = self.model.detached();
        let rendered = self.render_detached(&model, &camera, &view.cam_from_world, view.time)?;
        let sharp = to_image(&rendered);
        let started = self.schedule.is_blurred(self.progress.iteration);
        let Some(net) = model.blur.as_ref().filter(|_| started) else {
            return Ok(BlurredView {
                blurred: sharp.clone(),
                sharp,
                intensity: None,
                kernels: None,
                centroid: [0.0; 2],
            });
        };
        let field = net.forward(
            frame,
            &blur_inputs(&rendered, self.survey.scene_size),
            Extractor::Frozen,
        )?;
        let blurred = composite(rendered.color(), &field)?;
        let shifts = host(blurred.centroid());
        let mut mean = [0.0; 2];
        for shift in shifts.chunks_exact(2) {
            mean[0] += f64::from(shift[0]);
            mean[1] += f64::from(shift[1]);
        }
        let (width, height) = (camera.width, camera.height);
        Ok(BlurredView {
            sharp,
            blurred: Image {
                width,
                height,
                pixels: host(blurred.picture()),
            },
            intensity: Some(Map {
                width,
                height,
                values: host(field.intensity()),
            }),
            kernels: Some(host(field.kernel())),
            centroid: mean.map(|m| m / (width * height) as f64),
        })
    }

    /// Scores of all test views (and, where the truth is there, of the sharp training views), now.
    ///
    /// # Errors
    /// The renderer refuses its input, or files of the truth cannot be read.
    pub fn evaluate(&self) -> Result<Evaluation, TrainError> {
        self.evaluate_with(None)
    }

    /// The same, with the test pictures' colours mapped to the training camera's first.
    ///
    /// # Errors
    /// As [`Self::evaluate`].
    pub fn evaluate_with(&self, colors: Option<&ColorMap>) -> Result<Evaluation, TrainError> {
        let truth = self.scene.truth()?;
        let mut test = Vec::new();
        for (index, view) in self.scene.test.iter().enumerate() {
            let image = self.render_view(&view.camera, &view.cam_from_world, view.time)?;
            let wanted = colors.map_or_else(|| view.image.clone(), |map| map.apply(&view.image));
            test.push(score(&view.name, &image, &wanted, &regions(&truth, index)));
        }
        let mut train_sharp = Vec::new();
        let (mut shift, mut intensity) = ([0.0; 2], 0.0);
        let blurred =
            self.model.blur.is_some() && self.schedule.is_blurred(self.progress.iteration);
        let frames = self.scene.frames.len();
        if blurred || truth.sharp.is_some() {
            for index in 0..frames {
                let render = self.render_training_view(index)?;
                shift = [shift[0] + render.centroid[0], shift[1] + render.centroid[1]];
                if let Some(map) = &render.intensity {
                    intensity += map.values.iter().map(|&v| f64::from(v)).sum::<f64>()
                        / map.values.len() as f64;
                }
                if let Some(sharp) = &truth.sharp {
                    let name = &self.scene.frames[index].view.name;
                    train_sharp.push(score(
                        name,
                        &render.sharp,
                        &sharp[index],
                        &Regions::default(),
                    ));
                }
            }
        }
        Ok(Evaluation {
            test: mean_scores(test),
            train_sharp: mean_scores(train_sharp),
            iterations: self.progress.iteration,
            gaussians: GaussianCounts {
                fixed: self.model.num_gaussians() - self.model.num_dynamic,
                dynamic: self.model.num_dynamic,
            },
            kernel_centroid_px: blurred.then(|| shift[0].hypot(shift[1]) / frames as f64),
            mean_intensity: blurred.then(|| intensity / frames as f64),
        })
    }
}

fn to_image(rendered: &Rendered) -> Image {
    let color = rendered.color();
    let [height, width, _] = color.dims();
    Image {
        width,
        height,
        pixels: host(color),
    }
}

/// Pixels of a test view that are scored apart.
#[derive(Default)]
struct Regions {
    covisible: Option<Vec<bool>>,
    fixed: Option<Vec<bool>>,
    moving: Option<Vec<bool>>,
}

fn regions(truth: &Truth, index: usize) -> Regions {
    let Some(covisible) = truth.covisible.as_ref() else {
        return Regions::default();
    };
    // Pixels that are shrunk from several count only where all of those are seen.
    let covisible: Vec<bool> = covisible[index].values.iter().map(|&v| v >= 0.99).collect();
    let masks = truth.masks_test.as_ref().map(|masks| &masks[index]);
    let fixed = masks.map(|mask| {
        let near = dilate(mask, 1, 0.02);
        covisible
            .iter()
            .zip(near)
            .map(|(&seen, near)| seen && !near)
            .collect()
    });
    let moving = masks.map(|mask| {
        covisible
            .iter()
            .zip(&mask.values)
            .map(|(&seen, &m)| seen && m > 0.5)
            .collect()
    });
    Regions {
        covisible: Some(covisible),
        fixed,
        moving,
    }
}

fn score(name: &str, render: &Image, wanted: &Image, regions: &Regions) -> ViewScores {
    let (a, b) = (quantized(render), quantized(wanted));
    let masked = |mask: &Option<Vec<bool>>| mask.as_ref().and_then(|m| masked_psnr(&a, &b, m));
    let figures = Figures {
        psnr: psnr(&a, &b),
        ssim: ssim(&a, &b, render.width, render.height),
        mpsnr: masked(&regions.covisible),
        mpsnr_static: masked(&regions.fixed),
        mpsnr_dynamic: masked(&regions.moving),
    };
    ViewScores {
        name: name.to_owned(),
        figures,
    }
}

/// Rounded to 8 bit, as in the PNG.
fn quantized(image: &Image) -> Vec<f32> {
    image
        .pixels
        .iter()
        .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0)
        .collect()
}

fn mean_scores(views: Vec<ViewScores>) -> Option<Scores> {
    let mean = |of: fn(&Figures) -> Option<f64>| {
        let values: Vec<f64> = views.iter().filter_map(|view| of(&view.figures)).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let mean = Figures {
        psnr: mean(|f| Some(f.psnr))?,
        ssim: mean(|f| f.ssim),
        mpsnr: mean(|f| f.mpsnr),
        mpsnr_static: mean(|f| f.mpsnr_static),
        mpsnr_dynamic: mean(|f| f.mpsnr_dynamic),
    };
    Some(Scores { mean, views })
}
