//! The same training on every device: what the CPU sees, a GPU sees too.

use burn::tensor::Device;
use limpid_tests::devices;
use limpid_tests::tiny::{scene, settings};
use trainer::Trainer;
use trainer::settings::BlurKind;

/// Losses of the first steps, with a model of blur.
fn losses(device: &Device, model: BlurKind, steps: usize) -> Vec<f64> {
    let mut settings = settings();
    settings.blur.model = model;
    let mut trainer = Trainer::new(scene(), settings, device).expect("a trainer");
    let mut losses = Vec::new();
    for _ in 0..steps {
        losses.push(trainer.step().expect("a step").loss);
    }
    losses
}

#[test]
fn twenty_steps_have_the_same_losses_on_every_device() {
    for model in [BlurKind::Kernels, BlurKind::Camera] {
        let expected = losses(&Device::flex(), model, 20);
        for (name, device) in devices() {
            let found = losses(&device, model, 20);
            for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
                let error = (found - expected).abs() / expected.abs();
                // Adam steps by a gradient's sign at first, also where that is rounding: round Gaussians turn by chance.
                let limit = if step == 0 { 1e-3 } else { 3e-2 };
                assert!(
                    error < limit,
                    "{name}, {model:?}, step {}: {found} instead of {expected}",
                    step + 1
                );
            }
        }
    }
}
