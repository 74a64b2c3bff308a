//! Scores: PSNR, mPSNR and SSIM of the 8-bit pictures that are written.

use crate::TrainError;
use crate::blur::{BlurFigures, FigureSums};
use crate::corrections::FrameCorrection;
use crate::guarded::guarded;
use crate::metrics::{masked_psnr, psnr, ssim};
use crate::placement::dilate;
use crate::run::Run;
use crate::true_kernels::{KernelScores, TrueKernels};
use io::{Image, Scene, Truth};
use serde::{Deserialize, Serialize};

/// Scores of a run, as `metrics.json` holds them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Test views against their sharp pictures; absent without test views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test: Option<Scores>,
    /// Sharp renders of the training views against their truth, where the scene has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_sharp: Option<Scores>,
    /// The kernels by which training views are blurred, against the true ones; absent where the scene does not know those.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kernels: Option<KernelScores>,
    /// Iterations done.
    pub iterations: usize,
    /// Number of Gaussians.
    pub gaussians: GaussianCounts,
    /// Number of motion bases; 0 where nothing moves.
    #[serde(default)]
    pub bases: usize,
    /// What the blur model says of itself; absent without one.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub blur: Option<BlurFigures>,
    /// What was corrected of the training frames; absent where nothing is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub corrections: Option<Vec<FrameCorrection>>,
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

impl Run {
    /// Scores of all test views (and, where the truth is there, of the sharp training views), now. With `colors`, the test
    /// pictures' colours are mapped to the training camera's first.
    ///
    /// # Errors
    /// The scene is not the one that was trained on, the renderer refuses its input, or files of the truth cannot be read; the
    /// device fails.
    pub fn evaluate(
        &self,
        scene: &Scene,
        colors: Option<&ColorMap>,
    ) -> Result<Evaluation, TrainError> {
        guarded(&self.device, || self.score_views(scene, colors))
    }

    fn score_views(
        &self,
        scene: &Scene,
        colors: Option<&ColorMap>,
    ) -> Result<Evaluation, TrainError> {
        self.check_scene(scene)?;
        let truth = scene.truth()?;
        let mut test = Vec::new();
        // The scene's own test views: it may have others than when the run began.
        let views = self.plan.views_of(scene);
        for (index, (view, viewpoint)) in scene.test.iter().zip(&views.test).enumerate() {
            let image = self.render_viewpoint(viewpoint)?;
            let wanted = colors.map_or_else(|| view.image.clone(), |map| map.apply(&view.image));
            test.push(score(&view.name, &image, &wanted, &regions(&truth, index)));
        }
        let (mut train_sharp, mut figures) = (Vec::new(), FigureSums::default());
        let mut kernels = TrueKernels::of(scene, truth.exposures.as_deref(), self.survey().movers);
        if truth.sharp.is_some() || kernels.is_some() || self.model().blur.is_on(self.iteration()) {
            for (index, viewpoint) in self.views().train.iter().enumerate() {
                let view = self.render_training_view(index)?;
                if let Some(blur) = &view.blur {
                    let frame = quantized(&scene.frames[index].view.image);
                    figures.add(blur, psnr(&quantized(&view.seen), &frame));
                }
                if let Some(sharp) = &truth.sharp {
                    let regions = Regions::default();
                    let scored = score(&viewpoint.name, &view.sharp, &sharp[index], &regions);
                    train_sharp.push(scored);
                }
                if let Some(kernels) = &mut kernels {
                    let model = self.model_kernels(index, view.blur.as_ref())?;
                    kernels.score(index, |pixel| model.at(pixel));
                }
            }
        }
        let model = self.model();
        Ok(Evaluation {
            test: mean_scores(test),
            train_sharp: mean_scores(train_sharp),
            kernels: kernels.and_then(TrueKernels::scores),
            iterations: self.iteration(),
            gaussians: GaussianCounts {
                fixed: model.num_gaussians() - model.num_dynamic(),
                dynamic: model.num_dynamic(),
            },
            bases: model.world.num_bases(),
            blur: figures.figures(),
            corrections: model.corrections.figures(&self.views().train),
        })
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
