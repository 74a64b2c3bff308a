//! A device's memory holds what training needs, and not more from iteration to iteration.

use limpid_tests::devices;
use limpid_tests::tiny::{scene, settings};
use trainer::settings::BlurKind;
use trainer::{Gpu, MemoryUse, Trainer};

#[test]
fn memory_does_not_grow_over_two_hundred_iterations() {
    for (name, _) in devices() {
        // Main memory has no report, and is the allocator's.
        let Some(gpu) = Gpu::found().into_iter().find(|gpu| gpu.runtime == name) else {
            continue;
        };
        let mut settings = settings();
        settings.blur.model = BlurKind::Camera;
        let mut trainer = Trainer::new(scene(), settings, &gpu.device).expect("a trainer");
        let mut seen = Vec::new();
        for it in 1..=200_usize {
            trainer.step().expect("a step");
            // By then all parts are on, and no Gaussian comes any more.
            if it > 100 && it.is_multiple_of(10) {
                gpu.device.sync().expect("the device answers");
                let memory = gpu.memory_use().expect("a device of CubeCL's");
                seen.push((it as f64, memory, trainer.model().num_gaussians()));
            }
        }
        let (_, first, gaussians) = seen[0];
        assert!(seen.iter().all(|(.., n)| *n == gaussians), "as many of all");
        let n = seen.len() as f64;
        let mean =
            |of: &dyn Fn(&(f64, MemoryUse, usize)) -> f64| seen.iter().map(of).sum::<f64>() / n;
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
                "{name}: {what} {level:.0} bytes, {slope:.1} more with each iteration, from {first:?} on"
            );
        }
    }
}
