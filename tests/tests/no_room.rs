//! A device that has no room for a scene says so, and what was saved before goes on on another.

use burn::tensor::Device;
use limpid_tests::tiny::{scene, settings};
use limpid_tests::{devices, skipped};
use splat_core::{Gaussians, SplatError};
use trainer::{Gpu, TrainError, Trainer};

/// More Gaussians than go into a buffer of 1 GiB with their spherical harmonics.
fn too_many(degree: usize) -> Gaussians {
    let n = 6_000_000;
    Gaussians {
        means: vec![[0.0, 0.0, 4.0]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        log_scales: vec![[-6.0; 3]; n],
        opacity_logits: vec![0.0; n],
        sh: vec![0.1; n * 3 * (degree + 1) * (degree + 1)],
        sh_degree: degree,
    }
}

#[test]
fn a_scene_that_does_not_fit_is_an_error_and_a_checkpoint_goes_on_on_the_cpu() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, device) in &devices() {
        // Main memory has no such limit.
        let Ok(gpu) = Gpu::best(name) else {
            continue;
        };
        let mut trainer = Trainer::new(scene(), settings(), device).expect("a trainer");
        trainer.step().expect("a step");
        trainer.save(folder.path()).expect("a checkpoint");
        drop(trainer);

        if gpu.largest_buffer > 1 << 30 {
            skipped(
                "a scene that does not fit",
                "the adapter has larger buffers",
            );
        } else {
            let mut trainer = Trainer::new(scene(), settings(), device).expect("a trainer");
            let degree = trainer.settings().gaussians.sh_degree;
            let started = trainer.start_from(&too_many(degree));
            match started.and_then(|()| trainer.step()) {
                Err(error @ TrainError::Device { .. }) => {
                    let message = error.to_string();
                    assert!(message.contains("1152000000"), "{message}");
                    assert!(message.contains("--resume --backend flex"), "{message}");
                    assert!(!message.contains('\n'), "{message}");
                }
                // Where a buffer is smaller still, a render's tables do not fit either, and that is known before they are made.
                Err(TrainError::Splat(SplatError::TooLarge { bytes, limit, .. })) => {
                    assert!(
                        limit == gpu.largest_buffer && bytes > limit,
                        "{bytes} of {limit}"
                    );
                }
                other => panic!("there is no room for it: {other:?}"),
            }
        }

        let resumed = Trainer::load(folder.path(), scene(), &Device::flex());
        let mut resumed = resumed.expect("a checkpoint knows no backend");
        let report = resumed.step().expect("a step");
        assert_eq!(report.iteration, 2);
    }
}
