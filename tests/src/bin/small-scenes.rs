//! What the survey costs on scenes of the rasteriser's own: `cargo run --package limpid-tests --bin small-scenes`.
//!
//! Each scene is trained as the survey decides, and with everything that there are inputs for, as the laboratory's study `survey`
//! trains larger ones; a table goes to standard output.

use burn::tensor::Device;
use limpid_tests::bodies::{Bodies, scene, views_beside};
use std::error::Error;
use std::io::Write as _;
use trainer::settings::{BlurKind, When};
use trainer::{Settings, Trainer};

const ITERATIONS: usize = 600;
const SEEDS: [u64; 2] = [1, 2];
/// From the training frames to the views that are scored; movers are shifted by five pixels.
const ASIDE: f64 = 0.1;
/// Turn of the camera in a frame, rad.
const SHAKES: [f64; 2] = [0.12, 0.0];

/// A run's PSNR of the views beside.
struct Trained {
    psnr: f64,
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
    let mut trainer = Trainer::new(scene, settings, &device)?;
    while !trainer.is_done() {
        trainer.step()?;
    }
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
        modelled,
    })
}

fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut out = std::io::stdout().lock();
    writeln!(
        out,
        "| bodies | shake, rad | seed | modelled | as decided, dB | everything, dB |\n|---|---|---|---|---|---|"
    )?;
    for shake in SHAKES {
        for bodies in [
            Bodies::Balls(1),
            Bodies::Balls(2),
            Bodies::Balls(3),
            Bodies::Rod,
        ] {
            for seed in SEEDS {
                let [decided, everything] = [
                    trained(bodies, shake, seed, false)?,
                    trained(bodies, shake, seed, true)?,
                ];
                writeln!(
                    out,
                    "| {bodies:?} | {shake} | {seed} | {} | {:.2} | {:.2} |",
                    decided.modelled, decided.psnr, everything.psnr
                )?;
            }
        }
    }
    Ok(())
}
