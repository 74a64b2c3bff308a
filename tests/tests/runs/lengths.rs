//! A run whose length was chosen by trying is the run of that length, bit for bit; and pixels that are held back to choose one.

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
fn a_run_that_was_kept_goes_on_with_the_same_bits() {
    for blur in [BlurKind::Camera, BlurKind::Both] {
        let mut kept = trainer(settings(blur, 250));
        let start = kept.start();
        steps(&mut kept, 90);
        let run = kept.keep();
        kept.begin_again(&start, 300).expect("begun again");
        steps(&mut kept, 70);
        kept.go_back(run);
        assert_eq!((kept.iteration(), kept.settings().iterations), (90, 250));

        let mut plain = trainer(settings(blur, 250));
        steps(&mut plain, 90);
        assert!(
            steps(&mut kept, 60) == steps(&mut plain, 60),
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
            let trained = match blur {
                // The iteration of BP-Net's first step, behind the hold.
                BlurKind::Kernels => moments.get(1),
                _ => moments.first(),
            };
            assert_eq!(course.blur_trained_from, trained.copied());
            assert!(course.trials.iter().all(|t| moments.contains(t)));
            assert_eq!(
                course.trials.is_empty(),
                !matches!(blur, BlurKind::Camera),
                "the camera alone has trials"
            );
        }
    }
}

/// A trainer on frames whose pixels are negatives of themselves where `held` says so.
fn with_negatives(settings: &Settings, held: impl Fn(usize, usize) -> bool) -> Trainer {
    let mut scene = tiny::scene();
    for (index, frame) in scene.frames.iter_mut().enumerate() {
        let pixels = frame.view.image.pixels.chunks_exact_mut(3).enumerate();
        for (_, pixel) in pixels.filter(|(at, _)| held(index, *at)) {
            pixel.iter_mut().for_each(|value| *value = 1.0 - *value);
        }
    }
    Trainer::new(scene, settings.clone(), &Device::flex()).expect("a trainer")
}

#[test]
fn pixels_that_are_held_back_teach_nothing() {
    for blur in [BlurKind::Off, BlurKind::Kernels, BlurKind::Camera] {
        let mut settings = settings(blur, 2000);
        settings.frames.held_back = 0.1;
        let trained = trainer(settings.clone());
        let learned = |frame, at: usize| trained.learned_pixels(frame).expect("some")[at];
        let other = with_negatives(&settings, |frame, at| !learned(frame, at));
        let opposite = with_negatives(&settings, learned);
        let terms = |trainer: &Trainer, frame| -> Vec<(&str, Vec<f64>)> {
            let model = trained.model();
            let terms = trainer.loss_terms(model, model, 1900, frame);
            let terms = terms.expect("terms").into_iter();
            terms.map(|(name, term)| (name, values(term))).collect()
        };
        for frame in 0..tiny::FRAMES {
            let held = (0..tiny::WIDTH * tiny::HEIGHT).filter(|at| !learned(frame, *at));
            let share = held.count() as f64 / (tiny::WIDTH * tiny::HEIGHT) as f64;
            assert!((share - 0.1).abs() < 0.01, "{share} is held back");
            let here = terms(&trained, frame);
            assert!(here == terms(&other, frame), "{blur:?}: other terms");
            assert!(
                here != terms(&opposite, frame),
                "{blur:?}: frames do not matter"
            );
        }
    }
}

#[test]
fn how_well_held_back_pixels_are_explained_grows_with_training() {
    let mut settings = settings(BlurKind::Off, 300);
    assert_eq!(
        trainer(settings.clone()).held_back_psnr().expect("none"),
        None
    );
    settings.frames.held_back = 0.1;
    let mut trainer = trainer(settings);
    let psnr = |trainer: &Trainer| trainer.held_back_psnr().expect("a score").expect("some");
    let before = psnr(&trainer);
    steps(&mut trainer, 150);
    let after = psnr(&trainer);
    assert!(after > before + 1.0, "{before} dB and {after} dB");
}
