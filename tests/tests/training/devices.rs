//! The same training on every device: what the CPU sees, a GPU sees too.

use burn::tensor::Device;
use limpid_tests::devices;
use limpid_tests::tiny::{checkpoint, scene};
use std::path::Path;
use trainer::settings::BlurKind;
use trainer::{StepReport, Trainer};

const STEPS: usize = 20;

/// The next steps of a checkpoint on a device.
fn steps(checkpoint: &Path, device: &Device) -> Vec<StepReport> {
    let mut trainer = Trainer::load(checkpoint, scene(), device).expect("a checkpoint");
    let step = |_| trainer.step().expect("a step");
    (0..STEPS).map(step).collect()
}

/// Each goes on with a checkpoint of the CPU: from the start, and from where blur is modelled.
#[test]
fn twenty_steps_have_the_same_losses_on_every_device() {
    for (model, begins_behind) in [
        (BlurKind::Off, 0),
        (BlurKind::Kernels, 52),
        (BlurKind::Camera, 52),
    ] {
        let folder = tempfile::tempdir().expect("a folder");
        let trainer = checkpoint(folder.path(), model, begins_behind);
        if model != BlurKind::Off {
            let view = trainer.run().render_training_view(0).expect("a picture");
            assert_ne!(view.seen.pixels, view.sharp.pixels, "{model:?} blurs");
        }
        let expected = steps(folder.path(), &Device::flex());
        for (name, device) in devices() {
            let found = steps(folder.path(), &device);
            for (found, expected) in found.iter().zip(&expected) {
                let error = (found.loss - expected.loss).abs() / expected.loss.abs();
                // Adam's first steps go by a gradient's sign, also where that is rounding.
                let limit = match found.iteration - begins_behind {
                    1 => 1e-5,
                    _ if begins_behind > 0 => 1e-2,
                    _ => 3e-2,
                };
                assert!(
                    error < limit,
                    "{name}, {model:?}: {found:?} instead of {expected:?}"
                );
            }
        }
    }
}
