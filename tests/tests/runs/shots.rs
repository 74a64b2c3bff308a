//! Pictures with another exposure than the video's.

use burn::tensor::Device;
use io::Image;
use limpid_tests::tiny::{camera, pose, scene, settings};
use trainer::settings::{BlurKind, FrameSettings};
use trainer::{BlurFigures, Shot, TrainError, Trainer};

fn trained(model: BlurKind, steps: usize) -> Trainer {
    let mut settings = settings();
    settings.blur.model = model;
    settings.frames = FrameSettings::default();
    let mut trainer = Trainer::new(scene(), settings, &Device::flex()).expect("a trainer");
    for _ in 0..steps {
        trainer.step().expect("a step");
    }
    trainer
}

fn sharp(trainer: &Trainer, time: f32) -> Shot {
    Shot {
        time,
        shutter: 0.0,
        aperture: 0.0,
        focus: trainer.survey().scene_size,
        samples: 32,
    }
}

fn mean_difference(a: &Image, b: &Image) -> f32 {
    let pairs = a.pixels.iter().zip(&b.pixels);
    pairs.map(|(a, b)| (a - b).abs()).sum::<f32>() / a.pixels.len() as f32
}

#[test]
fn without_shutter_and_lens_it_is_the_sharp_render_from_between_the_frames() {
    let trainer = trained(BlurKind::Kernels, 5);
    let near = 0.01 * trainer.survey().scene_size;
    for time in [0.0, 1.5, 3.0] {
        let (before, after) = (f64::from(time).floor(), f64::from(time).ceil());
        // The tiny scene's camera does not turn.
        let mut between = pose(before);
        between.translation = 0.5 * (pose(before).translation + pose(after).translation);
        let expected = trainer
            .run()
            .render_view(&camera().with_near(near), &between, time)
            .expect("a picture");
        let taken = trainer.run().render_shot(&sharp(&trainer, time));
        let difference = mean_difference(&taken.expect("a picture"), &expected);
        assert!(difference < 1e-6, "at {time}: {difference}");
    }
}

#[test]
fn with_the_learned_exposure_it_is_what_the_model_says_the_camera_saw() {
    let trainer = trained(BlurKind::Camera, 70);
    let Some(BlurFigures::Camera(figures)) = trainer.evaluate().expect("scores").blur else {
        panic!("the camera's figures");
    };
    assert!(figures.aperture > 0.0 && figures.shutter > 0.0);
    for (index, frame) in figures.frames.iter().enumerate() {
        let shot = Shot {
            shutter: figures.shutter,
            aperture: figures.aperture,
            focus: frame.focus,
            samples: frame.samples,
            ..sharp(&trainer, index as f32)
        };
        let taken = trainer.run().render_shot(&shot).expect("a picture");
        let view = trainer.run().render_training_view(index);
        let view = view.expect("a picture");
        let difference = mean_difference(&taken, &view.seen);
        let blur = mean_difference(&view.sharp, &view.seen);
        assert!(
            blur > 1e-3 && difference < 0.02 * blur,
            "frame {index}: {difference} of {blur}"
        );
    }
}

#[test]
fn what_is_in_focus_stays_sharp_and_nothing_else() {
    let trainer = trained(BlurKind::Kernels, 60);
    let picture = |aperture: f64, focus: f64| {
        let shot = Shot {
            aperture,
            focus,
            ..sharp(&trainer, 2.0)
        };
        trainer.run().render_shot(&shot).expect("a picture")
    };
    let pinhole = picture(0.0, 1.0);
    // The wall fills all of the picture but the patch.
    let wall = limpid_tests::tiny::WALL;
    let [at_the_wall, before_it] =
        [wall, 0.6 * wall].map(|focus| mean_difference(&picture(0.3, focus), &pinhole));
    assert!(at_the_wall < 0.3 * before_it, "{at_the_wall} {before_it}");
}

#[test]
fn a_shot_out_of_range_is_refused_by_name() {
    let trainer = trained(BlurKind::Kernels, 1);
    let good = sharp(&trainer, 1.0);
    let bad = [
        (
            "time",
            Shot {
                time: f32::NAN,
                ..good
            },
        ),
        (
            "shutter",
            Shot {
                shutter: -1.0,
                ..good
            },
        ),
        (
            "aperture",
            Shot {
                aperture: f64::INFINITY,
                ..good
            },
        ),
        ("focus", Shot { focus: 0.0, ..good }),
        ("renders", Shot { samples: 0, ..good }),
        (
            "renders",
            Shot {
                samples: Shot::MAX_SAMPLES + 1,
                ..good
            },
        ),
    ];
    for (name, shot) in bad {
        let error = trainer.run().render_shot(&shot).expect_err("a bad shot");
        assert!(matches!(error, TrainError::Shot { .. }), "{error}");
        assert!(error.to_string().contains(name), "{name}: {error}");
    }
    for time in [-1e30, 1e30] {
        let shot = Shot {
            time,
            shutter: 2.0,
            ..good
        };
        trainer
            .run()
            .render_shot(&shot)
            .expect("the first or last moment");
    }
}
