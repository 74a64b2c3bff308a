//! The guard: a loss or gradient that is not finite stops the run with its state whole and says where it arose.

use io::Scene;
use limpid_tests::{devices, devices_for_long_trainings, tiny, values};
use trainer::settings::{BlurKind, When};
use trainer::{TrainError, Trainer};

/// A scene so small that positions, which count in units of its size, bring an overflow within reach.
fn microscopic(mut scene: Scene) -> Scene {
    for frame in &mut scene.frames {
        frame.view.cam_from_world.translation *= 1e-6;
        let depth = frame.depth.as_mut().expect("the scene has depth");
        depth.values.iter_mut().for_each(|z| *z *= 1e-6);
    }
    scene
}

/// Trains until a step fails; the error, and the trainer as it is then. No parameter may have changed in the failed step.
fn train_into_fault(mut trainer: Trainer) -> (TrainError, Trainer) {
    let state = |trainer: &Trainer| -> Vec<(String, Vec<f64>)> {
        let all = trainer.model().parameters().into_iter();
        all.map(|(parameter, tensor)| (parameter.name, values(tensor)))
            .collect()
    };
    loop {
        let (iteration, before) = (trainer.iteration(), state(&trainer));
        if let Err(error) = trainer.step() {
            assert_eq!(trainer.iteration(), iteration, "the failed step counted");
            assert!(
                before == state(&trainer),
                "the failed step changed a parameter"
            );
            return (error, trainer);
        }
    }
}

#[test]
fn a_fault_in_a_frame_names_iteration_view_term_and_parameter() {
    for (name, device) in devices() {
        for fault in [f32::NAN, f32::INFINITY, f32::MAX] {
            let scene = || {
                let mut scene = tiny::scene();
                scene.frames[3].view.image.pixels[100] = fault;
                scene
            };
            let mut settings = tiny::settings();
            settings.unseen.when = When::Never;
            let trainer = Trainer::new(scene(), settings, &device).expect("a trainer");
            let (error, trainer) = train_into_fault(trainer);
            let TrainError::NotFinite {
                iteration,
                view,
                term,
                parameter,
                ..
            } = &error
            else {
                panic!("{name}, {fault}: {error}");
            };
            assert_eq!(*iteration, trainer.iteration() + 1, "{name}, {fault}");
            assert_eq!(
                (view.as_str(), *term),
                ("00003", "image"),
                "{name}: {error}"
            );
            assert!(
                parameter
                    .as_ref()
                    .is_none_or(|p| p.starts_with("gaussians.")),
                "{name}: {error}"
            );

            assert!(!error.to_string().contains("none"), "{name}: {error}");

            // What is left is a good checkpoint.
            let folder = tempfile::tempdir().expect("a temporary folder");
            trainer.save(folder.path()).expect("a checkpoint");
            let loaded = Trainer::load(folder.path(), scene(), &device).expect("it loads");
            assert_eq!(loaded.iteration(), trainer.iteration());
        }
    }
}

#[test]
fn a_gradient_that_overflows_names_its_term_and_parameter() {
    for (name, device) in devices() {
        // A weight just inside f32 over a tiny size is outside.
        let scene = microscopic(tiny::scene());
        let mut settings = tiny::settings();
        settings.loss.means_acceleration = 1e37;
        let trainer = Trainer::new(scene, settings, &device).expect("a trainer");
        let (error, _) = train_into_fault(trainer);
        let TrainError::NotFinite {
            term, parameter, ..
        } = &error
        else {
            panic!("{name}: {error}");
        };
        assert_eq!(*term, "means_acceleration", "{name}: {error}");
        let parameter = parameter.as_deref().unwrap_or_default();
        assert!(
            parameter == "gaussians.means" || parameter.starts_with("motion."),
            "{name}: {error}"
        );
    }
}

/// Else the trial, which comes again where the run goes on, would find what it has changed itself.
#[test]
fn a_fault_right_behind_a_trial_takes_the_trial_back() {
    for (name, device) in devices_for_long_trainings() {
        // So many frames that there is one trial; kernels, and what weighs too much, begin with it.
        let begun = |weight| {
            let mut settings = tiny::settings();
            settings.unseen.when = When::Never;
            settings.blur.model = BlurKind::Both;
            settings.loss.downsample = weight;
            settings.loss.downsample_after = 0;
            let scene = microscopic(tiny::scene_of(12));
            Trainer::new(scene, settings, &device).expect("a trainer")
        };
        let aperture = |trainer: &Trainer| tiny::parameter(trainer, "camera.aperture");
        let mut fine = begun(0.0);
        let start = aperture(&fine);
        let (error, faulty) = train_into_fault(begun(1e37));
        assert!(error.to_string().contains("downsample"), "{name}: {error}");
        while fine.iteration() < faulty.iteration() {
            fine.step().expect("a step");
        }
        let decided = fine.step().expect("a step").decided;
        assert!(decided.is_some(), "{name}: no trial came before the fault");
        assert_eq!(aperture(&fine), [0.0], "{name}: {decided:?}");
        assert_eq!(aperture(&faulty), start, "{name}");
    }
}
