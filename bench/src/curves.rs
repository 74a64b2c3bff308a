//! The same training on every backend: losses from iteration to iteration in one plot, and scores.

use std::collections::BTreeMap;
use std::path::Path;

use plotters::prelude::*;
use serde::{Deserialize, Serialize};
use trainer::settings::BlurKind;
use trainer::{Device, Settings, Trainer};

use crate::workload::on_device;

/// Iterations after which scores are taken.
const SCORED: [usize; 3] = [100, 200, 300];
/// Losses are drawn as means over so many iterations: neighbours show different views.
const WINDOW: usize = 12;

/// Losses and scores of one run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Curve {
    /// Where it ran.
    pub backend: String,
    /// Its blur model.
    pub model: String,
    /// Its seed.
    pub seed: u64,
    /// Loss of every iteration.
    pub losses: Vec<f64>,
    /// Iterations done, and the mean PSNR over the test views then, dB.
    pub psnr: Vec<(usize, f64)>,
}

/// Trains the demo at 32x18 for so many iterations of a run of 300, with both blur models.
///
/// # Errors
/// The demo cannot be read, or training fails.
pub fn curves(
    backend: &str,
    device: &Device,
    iterations: usize,
    seed: u64,
) -> Result<Vec<Curve>, Box<dyn std::error::Error>> {
    let mut curves = Vec::new();
    for (model, name) in [(BlurKind::Kernels, "kernels"), (BlurKind::Camera, "camera")] {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../demo");
        let options = io::LoadOptions {
            downscale: 5,
            ..io::LoadOptions::default()
        };
        let scene = || io::Scene::open_with(folder.as_ref(), &options);
        let mut settings = Settings {
            iterations: 300,
            seed,
            ..Settings::default()
        };
        settings.blur.model = model;
        // The same start for all, so that what differs is what iterations do.
        let start = Trainer::new(scene()?, settings, &Device::flex())?;
        let mut trainer = on_device(&start, scene()?, device)?;
        let mut curve = Curve {
            backend: backend.to_owned(),
            model: name.to_owned(),
            seed,
            losses: Vec::new(),
            psnr: Vec::new(),
        };
        while trainer.iteration() < iterations.min(300) {
            curve.losses.push(trainer.step()?.loss);
            let done = trainer.iteration();
            if SCORED.contains(&done) {
                let scores = trainer.evaluate()?;
                let psnr = scores.test.map(|scores| scores.mean.psnr);
                curve.psnr.extend(psnr.map(|psnr| (done, psnr)));
            }
        }
        curves.push(curve);
    }
    Ok(curves)
}

/// How far the scores of a backend are from those of Flex with the same seed: mean over the seeds and its standard error, dB.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// The other backend.
    pub backend: String,
    /// The blur model of both.
    pub model: String,
    /// After so many iterations.
    pub iterations: usize,
    /// Seeds that both were run with.
    pub seeds: usize,
    /// PSNR above Flex's, dB.
    pub mean: f64,
    /// Of the mean; none for one seed.
    pub standard_error: Option<f64>,
}

/// What every backend differs by from Flex, over the seeds that both have.
#[must_use]
pub fn differences(curves: &[Curve]) -> Vec<Difference> {
    let mut gains: BTreeMap<(&str, &str, usize), Vec<f64>> = BTreeMap::new();
    for curve in curves.iter().filter(|curve| curve.backend != "flex") {
        let is_pair = |other: &&Curve| {
            let same = (&other.model, other.seed) == (&curve.model, curve.seed);
            same && other.backend == "flex"
        };
        let flex = curves.iter().find(is_pair).map_or(&[][..], |c| &c.psnr);
        for (iterations, psnr) in &curve.psnr {
            if let Some((_, of_flex)) = flex.iter().find(|(done, _)| done == iterations) {
                let key = (curve.model.as_str(), curve.backend.as_str(), *iterations);
                gains.entry(key).or_default().push(psnr - of_flex);
            }
        }
    }
    let summary = |((model, backend, iterations), gains): ((&str, &str, usize), Vec<f64>)| {
        let n = gains.len() as f64;
        let mean = gains.iter().sum::<f64>() / n;
        let squares: f64 = gains.iter().map(|gain| (gain - mean).powi(2)).sum();
        Difference {
            backend: backend.to_owned(),
            model: model.to_owned(),
            iterations,
            seeds: gains.len(),
            mean,
            standard_error: (n > 1.0).then(|| (squares / (n - 1.0) / n).sqrt()),
        }
    };
    gains.into_iter().map(summary).collect()
}

/// One panel for each blur model, and in it a line for each backend: the run of the smallest seed.
///
/// # Errors
/// The file cannot be written.
pub fn plot(curves: &[Curve], path: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let area = SVGBackend::new(path, (900, 320)).into_drawing_area();
    area.fill(&WHITE)?;
    let (left, right) = area.split_horizontally(450);
    for (panel, model) in [(left, "kernels"), (right, "camera")] {
        let first = curves.iter().map(|c| c.seed).min();
        let of_model = curves.iter().filter(|c| c.model == model);
        let of_model: Vec<_> = of_model.filter(|c| Some(c.seed) == first).collect();
        let length = of_model.iter().map(|c| c.losses.len()).max().unwrap_or(1);
        let highest = of_model.iter().flat_map(|c| means(&c.losses));
        let highest = highest.map(|(_, loss)| loss).fold(0.0, f64::max);
        let mut chart = ChartBuilder::on(&panel)
            .caption(format!("loss with the {model}"), ("sans-serif", 16))
            .margin(8)
            .x_label_area_size(36)
            .y_label_area_size(52)
            .build_cartesian_2d(0.0..length as f64, 0.0..1.05 * highest)?;
        chart.configure_mesh().x_desc("iteration").draw()?;
        for (k, curve) in of_model.into_iter().enumerate() {
            // Thick below thin: lines that agree lie on each other.
            let style = Palette99::pick(k).stroke_width(6 - 2 * (k as u32).min(2));
            chart
                .draw_series(LineSeries::new(means(&curve.losses), style))?
                .label(curve.backend.clone())
                .legend(move |(x, y)| {
                    PathElement::new([(x, y), (x + 16, y)], Palette99::pick(k).stroke_width(3))
                });
        }
        chart.configure_series_labels().border_style(BLACK).draw()?;
    }
    area.present()?;
    Ok(())
}

fn means(losses: &[f64]) -> impl Iterator<Item = (f64, f64)> {
    let windows = losses.windows(WINDOW.min(losses.len().max(1))).enumerate();
    windows.map(|(i, window)| {
        let middle = (i + window.len() / 2) as f64;
        (middle, window.iter().sum::<f64>() / window.len() as f64)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backends_are_held_against_flex_seed_by_seed() {
        let curve = |backend: &str, seed, psnr| Curve {
            backend: backend.to_owned(),
            model: "camera".to_owned(),
            seed,
            losses: Vec::new(),
            psnr: vec![(100, psnr)],
        };
        let curves = [
            curve("flex", 1, 20.0),
            curve("flex", 2, 22.0),
            curve("ndarray", 2, 22.5),
            curve("ndarray", 1, 19.5),
            // No pair.
            curve("ndarray", 3, 40.0),
            curve("wgpu", 2, 21.0),
        ];
        let [ndarray, wgpu] = &differences(&curves)[..] else {
            panic!("two backends: {:?}", differences(&curves));
        };
        assert_eq!((ndarray.backend.as_str(), ndarray.seeds), ("ndarray", 2));
        assert!(ndarray.mean.abs() < 1e-12, "{ndarray:?}");
        let error = ndarray.standard_error.expect("two seeds");
        assert!((error - 0.5).abs() < 1e-12, "{ndarray:?}");
        assert_eq!((wgpu.mean, wgpu.standard_error), (-1.0, None));
    }
}
