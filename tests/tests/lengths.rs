//! A run whose length was chosen by trying is the run of that length, bit for bit.

use burn::tensor::Device;
use limpid_tests::{tiny, values};
use trainer::settings::BlurKind;
use trainer::{Settings, Trainer};

fn settings(blur: BlurKind, iterations: usize) -> Settings {
    let mut settings = tiny::settings();
    settings.blur.model = blur;
    settings.iterations = iterations;
    settings
}

fn trainer(settings: Settings) -> Trainer {
    Trainer::new(tiny::scene(), settings, &Device::flex()).expect("a trainer")
}

/// Losses of so many steps, and all parameters behind them.
fn steps(trainer: &mut Trainer, count: usize) -> (Vec<f64>, Vec<Vec<f64>>) {
    let losses = (0..count).map(|_| trainer.step().expect("a step").loss);
    let losses = losses.collect();
    let parameters = trainer.model().parameters().into_iter();
    (losses, parameters.map(|(_, t)| values(t)).collect())
}

#[test]
fn what_was_tried_leaves_no_trace() {
    for blur in [BlurKind::Off, BlurKind::Camera, BlurKind::Both] {
        let mut tried = trainer(settings(blur, 2000));
        let start = tried.start();
        for length in [200, 1000] {
            tried.begin_again(&start, length).expect("begun again");
            steps(&mut tried, 70);
        }
        let refused = tried.begin_again(&start, 100).expect_err("too short");
        assert!(refused.to_string().contains("iterations"), "{refused}");
        assert_eq!(tried.iteration(), 70, "what is refused changes nothing");
        tried.begin_again(&start, 250).expect("begun again");
        assert_eq!(tried.iteration(), 0);

        let mut plain = trainer(settings(blur, 250));
        assert_eq!(tried.schedule(), plain.schedule());
        assert_eq!(tried.settings(), plain.settings());
        assert!(
            steps(&mut tried, 100) == steps(&mut plain, 100),
            "{blur:?}: other bits"
        );
    }
}

#[test]
fn the_course_of_another_length_is_that_of_such_a_run() {
    for blur in [BlurKind::Off, BlurKind::Kernels, BlurKind::Camera] {
        let other = trainer(settings(blur, 200));
        for length in [200, 1000, 3000] {
            let course = other.course(length).expect("a course");
            let run = trainer(settings(blur, length));
            let moments = &run.schedule().blur_moments;
            assert_eq!(course.blurred_from, moments.first().copied());
            assert!(course.trials.iter().all(|t| moments.contains(t)));
            assert_eq!(
                course.trials.is_empty(),
                !matches!(blur, BlurKind::Camera),
                "the camera alone has trials"
            );
        }
    }
}
