//! Trains from code: `cargo run -p trainer --example train [SCENE]`, by default the demo, small.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]

use std::path::PathBuf;
use trainer::{Device, Settings, Trainer};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let demo = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");
    let given = std::env::args_os().nth(1);
    let folder = given.map_or_else(|| demo.into(), PathBuf::from);
    let options = io::LoadOptions {
        downscale: 4,
        ..io::LoadOptions::default()
    };
    let scene = io::Scene::open_with(&folder, &options)?;
    let settings = Settings {
        iterations: 200,
        ..Settings::default()
    };
    let mut trainer = Trainer::new(scene, settings, &Device::flex())?;
    while !trainer.is_done() {
        let report = trainer.step()?;
        if report.iteration % 50 == 0 {
            println!(
                "{}: loss {:.4}, {:.1} dB",
                report.iteration, report.loss, report.psnr
            );
        }
    }
    let scores = trainer.evaluate()?;
    if let Some(test) = &scores.test {
        println!("test views: {:.2} dB", test.mean.psnr);
    }
    println!("{} Gaussians", trainer.model().num_gaussians());
    Ok(())
}
