//! What the survey saves and costs on scenes of the rasteriser's own: `cargo run --package limpid-tests --bin small-scenes`.
//!
//! Each scene is trained as the survey decides, and with everything that there are inputs for, as the laboratory's study `survey`
//! trains larger ones; a table goes to standard output.

use burn::tensor::Device;
use limpid_tests::bodies::{Bodies, scene, views_beside};
use limpid_tests::in_pool;
use std::error::Error;
use std::io::Write as _;
use std::time::Instant;
use trainer::settings::{BlurKind, When};
use trainer::{Settings, Trainer};

const ITERATIONS: usize = 600;
const SEEDS: [u64; 2] = [1, 2];
/// From the training frames to the views that are scored; movers are shifted by five pixels.
const ASIDE: f64 = 0.1;
/// Turn of the camera in a frame, rad.
const SHAKES: [f64; 2] = [0.12, 0.0];

/// A run's PSNR of the views beside, and seconds of one thread.
struct Trained {
    psnr: f64,
    seconds: f64,
    /// What is modelled.
    modelled: String,
}

fn trained(
    bodies: Bodies,
    shake: f64,
    seed: u64,
    everything: bool,
) -> Result<Trained, Box<dyn Error + Send + Sync>> {
    let device = Device::flex();
    let mut settings = Settings {
        seed,
        iterations: ITERATIONS,
        ..Settings::default()
    };
    if everything {
        settings.blur.model = BlurKind::Both;
        settings.unseen.when = When::Always;
        settings.frames.gains = When::Always;
        settings.motion.when = When::Always;
    }
    let mut scene = scene(bodies, shake, &device);
    scene.test = views_beside(bodies, shake, ASIDE, &device);
    let began = Instant::now();
    let mut trainer = Trainer::new(scene, settings, &device)?;
    while !trainer.is_done() {
        trainer.step()?;
    }
    let seconds = began.elapsed().as_secs_f64();
    let scores = trainer.evaluate()?.test.ok_or("there are test views")?;
    let survey = trainer.survey();
    let motion = trainer.run().motion_arrays()?;
    let modelled = format!(
        "{} bases, {}",
        motion.map_or(0, |motion| motion.num_bases),
        if survey.blurred { "blur" } else { "no blur" }
    );
    Ok(Trained {
        psnr: scores.mean.psnr,
        seconds,
        modelled,
    })
}

/// Mean and its standard error.
fn mean(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    (mean, (squares / (n - 1.0) / n).sqrt())
}

fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut out = std::io::stdout().lock();
    writeln!(
        out,
        "| bodies | shake, rad | modelled | as decided, dB | against everything, dB | seconds |\n|---|---|---|---|---|---|"
    )?;
    for shake in SHAKES {
        for bodies in [
            Bodies::Balls(1),
            Bodies::Balls(2),
            Bodies::Balls(3),
            Bodies::Rod,
        ] {
            let mut pairs = Vec::new();
            for seed in SEEDS {
                let run = |everything| in_pool(1, || trained(bodies, shake, seed, everything));
                pairs.push((run(false)?, run(true)?));
            }
            let of = |value: fn(&(Trained, Trained)) -> f64| -> (f64, f64) {
                mean(&pairs.iter().map(value).collect::<Vec<_>>())
            };
            let (psnr, gain) = (of(|pair| pair.0.psnr), of(|pair| pair.0.psnr - pair.1.psnr));
            let (saved, _) = of(|pair| pair.0.seconds / pair.1.seconds);
            writeln!(
                out,
                "| {bodies:?} | {shake} | {} | {:.2} ± {:.2} | {:+.2} ± {:.2} | ×{saved:.2} |",
                pairs[0].0.modelled, psnr.0, psnr.1, gain.0, gain.1
            )?;
        }
    }
    Ok(())
}
