//! A device's memory holds what training needs, and not more from iteration to iteration.

use limpid_tests::tiny::{scene, settings};
use limpid_tests::{devices, skipped};
use trainer::settings::BlurKind;
use trainer::{Gpu, MemoryUse, Trainer};

#[test]
fn memory_does_not_grow_from_iteration_to_iteration() {
    for (name, _) in devices() {
        // Main memory has no report, and is the allocator's.
        let Ok(gpu) = Gpu::best(name) else {
            continue;
        };
        for model in [BlurKind::Camera, BlurKind::Kernels] {
            check(&gpu, model);
        }
        if gpu.is_software {
            let part = "a device's memory over 2,000 iterations";
            skipped(part, "it would take a CPU that plays a GPU minutes");
        }
    }
}

/// Trains and asks the device on the way, once all parts are on and no Gaussian comes any more.
fn check(gpu: &Gpu, model: BlurKind) {
    let iterations = if gpu.is_software { 200 } else { 2000 };
    let mut settings = settings();
    settings.iterations = iterations;
    settings.blur.model = model;
    if gpu.is_software {
        // What an iteration makes and drops is as many tables with a network of fewer pixels.
        settings.blur.downscale = 4;
    }
    let mut trainer = Trainer::new(scene(), settings, &gpu.device).expect("a trainer");
    let mut seen = Vec::new();
    for it in 1..=iterations {
        trainer.step().expect("a step");
        if it > iterations / 2 && it.is_multiple_of(iterations / 20) {
            gpu.device.sync().expect("the device answers");
            let memory = gpu.memory_use().expect("a device of CubeCL's");
            seen.push((it as f64, memory, trainer.model().num_gaussians()));
        }
    }
    let (_, first, gaussians) = seen[0];
    assert!(seen.iter().all(|(.., n)| *n == gaussians), "as many of all");
    let n = seen.len() as f64;
    let mean = |of: &dyn Fn(&(f64, MemoryUse, usize)) -> f64| seen.iter().map(of).sum::<f64>() / n;
    for (what, of) in [
        ("in use", (|m| m.in_use) as fn(&MemoryUse) -> u64),
        ("reserved", |m| m.reserved),
    ] {
        let (middle, level) = (mean(&|(it, ..)| *it), mean(&|(_, m, _)| of(m) as f64));
        let above = |m: &MemoryUse| of(m) as f64 - level;
        let covariance = mean(&|(it, m, _)| (it - middle) * above(m));
        let slope = covariance / mean(&|(it, ..)| (it - middle).powi(2));
        // A table of one number a Gaussian that is kept each time would be so many bytes.
        let limit = 0.01 * 4.0 * gaussians as f64;
        assert!(
            slope < limit,
            "{}, {model:?}: {what} {level:.0} bytes, {slope:.1} more with each iteration, from {first:?} on",
            gpu.name
        );
    }
}
