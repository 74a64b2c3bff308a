//! What the survey says of scenes of which everything is known: bodies that move, bend or stand still, in sharp and in blurred
//! frames.

use limpid_tests::bodies::{Bodies, scene};
use limpid_tests::{devices_for_long_trainings, values};
use trainer::settings::{BlurKind, When};
use trainer::{BlurModel, Settings, Trainer};

/// A trainer of the scene as the survey has it, with as few bases as foretell the tracks.
fn surveyed(bodies: Bodies, shake: f64, device: &burn::tensor::Device) -> Trainer {
    let mut settings = Settings::default();
    settings.motion.fewest_bases = true;
    settings.motion.first_fit_steps = 40;
    Trainer::new(scene(bodies, shake, device), settings, device).expect("a trainer")
}

fn num_bases(trainer: &Trainer) -> usize {
    let motion = trainer.run().motion_arrays().expect("rows");
    motion.map_or(0, |motion| motion.num_bases)
}

#[test]
fn movers_bases_and_blur_are_what_the_scene_has() {
    for (name, device) in devices_for_long_trainings() {
        for shake in [0.0, 0.12] {
            for (bodies, bases) in [
                (Bodies::Balls(1), 1..=2),
                (Bodies::Balls(2), 2..=4),
                (Bodies::Balls(3), 3..=6),
                (Bodies::Rod, 3..=10),
            ] {
                let trainer = surveyed(bodies, shake, &device);
                let survey = trainer.survey();
                let told = || format!("{name}: {bodies:?}, {shake}: {:?}", survey.notes);
                assert!(survey.movers, "{}", told());
                assert_eq!(survey.blurred, shake > 0.0, "{}", told());
                assert!(!survey.gains_differ, "{}", told());
                assert!(
                    bases.contains(&num_bases(&trainer)),
                    "{}: {}",
                    num_bases(&trainer),
                    told()
                );
            }
        }
    }
}

#[test]
fn what_masks_show_and_tracks_follow_stands_still() {
    for (name, device) in devices_for_long_trainings() {
        for shake in [0.0, 0.12] {
            let trainer = surveyed(Bodies::Still, shake, &device);
            let survey = trainer.survey();
            assert!(!survey.movers, "{name}, {shake}: {:?}", survey.notes);
            assert_eq!(survey.blurred, shake > 0.0, "{name}: {:?}", survey.notes);
            assert_eq!(
                (num_bases(&trainer), trainer.model().num_dynamic()),
                (0, 0),
                "{name}"
            );
        }
    }
}

#[test]
fn a_part_of_the_camera_that_is_asked_for_is_there_for_sharp_frames_too() {
    for (name, device) in devices_for_long_trainings() {
        let scene = scene(Bodies::Still, 0.0, &device);
        for (path, lens) in [
            (When::Auto, When::Auto),
            (When::Always, When::Auto),
            (When::Auto, When::Always),
        ] {
            let mut settings = Settings::default();
            settings.camera.path = path;
            settings.camera.lens = lens;
            let trainer = Trainer::new(scene.clone(), settings, &device).expect("a trainer");
            let is_there = matches!(trainer.model().blur, BlurModel::Camera(_));
            let asked = [path, lens].contains(&When::Always);
            assert_eq!(is_there, asked, "{name}: paths {path:?}, lens {lens:?}");
        }
    }
}

/// What is left out costs nothing: a run that decides for itself has every number of one that was told.
#[test]
fn what_is_decided_is_what_could_have_been_asked_for() {
    for (name, device) in devices_for_long_trainings() {
        for (shake, asked) in [(0.0, BlurKind::Off), (0.12, BlurKind::Camera)] {
            let scene = scene(Bodies::Balls(2), shake, &device);
            let trained = |model| {
                let mut settings = Settings {
                    iterations: 200,
                    ..Settings::default()
                };
                settings.blur.model = model;
                settings.motion.first_fit_steps = 40;
                let mut trainer =
                    Trainer::new(scene.clone(), settings, &device).expect("a trainer");
                for _ in 0..80 {
                    trainer.step().expect("a step");
                }
                let parameters = trainer.model().parameters().into_iter();
                let parameters = parameters.map(|(p, tensor)| (p.name, values(tensor)));
                parameters.collect::<Vec<_>>()
            };
            assert!(
                trained(BlurKind::Auto) == trained(asked),
                "{name}, shaken by {shake}: not as with {asked:?}"
            );
        }
    }
}
