//! The estimate of a run's memory against what runs take. A file of its own: the peak is the process's.

#![cfg(target_os = "linux")]

use burn::tensor::Device;
use io::{LoadOptions, Scene};
use std::path::Path;
use trainer::settings::BlurKind;
use trainer::{Settings, Trainer};

/// The most memory that was resident, bytes.
fn peak() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux says it");
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let text = line.expect("a line").trim().trim_end_matches("kB").trim();
    1024 * text.parse::<u64>().expect("a number")
}

#[test]
fn what_a_run_takes_is_estimated_within_a_factor_of_two() {
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../demo");
    // The smaller first: what is given back stays with the process.
    for (downscale, blur, samples) in [
        (2, BlurKind::Camera, 8),
        (2, BlurKind::Kernels, 8),
        (1, BlurKind::Camera, 8),
        (1, BlurKind::Kernels, 8),
        // As where a path and a lens blur frames, and more.
        (1, BlurKind::Both, 32),
    ] {
        let options = LoadOptions {
            downscale,
            ..LoadOptions::default()
        };
        let scene = Scene::open_with(&demo, &options).expect("the demo");
        let mut settings = Settings {
            iterations: 200,
            ..Settings::default()
        };
        settings.motion.first_fit_steps = 40;
        settings.blur.model = blur;
        settings.camera.samples = samples;
        settings.camera.spacing_px = 0.1;
        settings.camera.lens_spacing_px = 0.1;
        let mut trainer = Trainer::new(scene, settings, &Device::flex()).expect("a trainer");
        // Blur begins after 50 iterations.
        for _ in 0..52 {
            trainer.step().expect("a step");
        }
        let need = trainer.memory_need(trainer.model().num_gaussians());
        let (need, took) = (need.total() as f64, peak() as f64);
        assert!(
            (0.5..2.0).contains(&(need / took)),
            "{blur:?} at 1/{downscale}, {samples} renders: {need} said, {took} taken"
        );
    }
}
