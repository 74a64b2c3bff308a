//! A run beside the loop that trains it: started from given Gaussians, gone on with, opened by who has its folder alone.

use burn::tensor::Device;
use limpid_tests::tiny::{camera, pose, scene, settings};
use limpid_tests::with_causes;
use splat_core::Gaussians;
use std::error::Error;
use tempfile::TempDir;
use trainer::{Run, TrainError, Trainer};

fn trainer() -> Trainer {
    Trainer::new(scene(), settings(), &Device::flex()).expect("a trainer")
}

fn steps(trainer: &mut Trainer, count: usize) {
    for _ in 0..count {
        trainer.step().expect("a step");
    }
}

fn saved(trainer: &Trainer) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    trainer.save(folder.path()).expect("saved");
    folder
}

#[test]
fn a_run_that_started_from_gaussians_goes_on_as_it_would_have() {
    let gaussians = trainer().run().gaussians(Some(2.0)).expect("rows");
    let mut whole = trainer();
    assert!(whole.schedule().densify_dynamic_at.is_some(), "movers");
    whole.start_from(&gaussians).expect("a start");
    assert_eq!(
        whole.schedule().densify_dynamic_at,
        None,
        "nothing moves, so that there is no dynamic densification to wait for"
    );
    steps(&mut whole, 5);
    let folder = saved(&whole);
    let mut resumed = Trainer::load(folder.path(), scene(), &Device::flex()).expect("loaded");
    assert_eq!(whole.schedule(), resumed.schedule());
    for _ in 0..10 {
        let expected = whole.step().expect("a step");
        assert_eq!(expected, resumed.step().expect("a step"));
    }
}

#[test]
fn gaussians_that_do_not_fit_each_other_are_refused_and_change_nothing() {
    let mut trainer = trainer();
    let good = trainer.run().gaussians(None).expect("rows");
    type Damage = fn(&mut Gaussians);
    let ragged: [(&str, Damage); 5] = [
        ("means", |g| g.means.truncate(1)),
        ("quats", |g| g.quats.truncate(1)),
        ("log_scales", |g| g.log_scales.truncate(1)),
        ("opacity_logits", |g| g.opacity_logits.truncate(1)),
        ("sh", |g| g.sh.truncate(1)),
    ];
    for (name, damage) in ragged {
        let mut gaussians = good.clone();
        damage(&mut gaussians);
        let error = trainer.start_from(&gaussians).expect_err(name);
        assert!(matches!(error, TrainError::Splat(_)), "{name}: {error}");
        assert_eq!(trainer.model().num_gaussians(), good.len(), "{name}");
        assert!(trainer.model().num_dynamic() > 0, "{name}");
    }
    steps(&mut trainer, 1);
}

#[test]
fn a_run_opens_without_the_scene_it_was_trained_on() {
    let mut trainer = trainer();
    steps(&mut trainer, 55);
    let folder = saved(&trainer);
    let run = Run::open(folder.path(), &Device::flex()).expect("opened");
    assert_eq!(run.iteration(), 55);
    assert_eq!(run.views().train.len(), scene().frames.len());
    assert_eq!(run.views().test.len(), scene().test.len());
    for time in [0.0, 2.5] {
        let [here, there] = [trainer.run(), &run].map(|run| {
            let picture = run.render_view(&camera(), &pose(1.5), time);
            picture.expect("a picture").pixels
        });
        assert!(here == there, "the render at {time} differs");
        let [here, there] =
            [trainer.run(), &run].map(|run| run.gaussians(Some(time)).expect("rows"));
        assert!(here == there, "the Gaussians at {time} differ");
    }
    let [here, there] = [trainer.run(), &run].map(|run| {
        let view = run.render_training_view(3).expect("pictures");
        assert!(view.blur.is_some(), "blur is modelled by now");
        view.seen.pixels
    });
    assert!(here == there, "what the camera saw differs");
    // With the scene at hand it is scored as the trainer scores itself.
    let scores = run.evaluate(&scene(), None).expect("scores");
    assert_eq!(scores, trainer.evaluate().expect("scores"));
}

/// Test views teach nothing: a run goes on, and is scored, with others than it began with.
#[test]
fn test_views_may_come_and_go() {
    let mut without = scene();
    without.test.clear();
    let mut trainer = Trainer::new(without, settings(), &Device::flex()).expect("a trainer");
    steps(&mut trainer, 1);
    assert!(trainer.evaluate().expect("scores").test.is_none());
    let folder = saved(&trainer);
    let mut fewer = scene();
    fewer.test.drain(..2);
    for mut scene in [scene(), fewer] {
        let last = scene.test.last_mut().expect("a view");
        last.name = "another".into();
        let names: Vec<String> = scene.test.iter().map(|view| view.name.clone()).collect();
        let run = Run::open(folder.path(), &Device::flex()).expect("opened");
        let scored = run.evaluate(&scene, None).expect("scores").test;
        let resumed = Trainer::resume(run, scene).expect("resumed");
        assert_eq!(scored, resumed.evaluate().expect("scores").test);
        let views = scored.expect("test views").views;
        let found: Vec<&String> = views.iter().map(|view| &view.name).collect();
        assert!(found.iter().zip(&names).all(|(a, b)| *a == b) && found.len() == names.len());
        let known = &resumed.run().views().test;
        assert!(known.iter().map(|view| &view.name).eq(&names));
    }
}

#[test]
fn a_scene_whose_depth_lost_values_is_another_one() {
    let trainer = trainer();
    let folder = saved(&trainer);
    let mut scene = scene();
    for depth in scene.frames.iter_mut().filter_map(|f| f.depth.as_mut()) {
        // The median is the same, but there is too little to be warped.
        let rows = depth.values.chunks_mut(depth.width);
        rows.enumerate()
            .filter(|(y, _)| y % 4 > 0)
            .for_each(|(_, row)| row.fill(0.0));
    }
    let run = Run::open(folder.path(), &Device::flex()).expect("opened");
    match Trainer::resume(run, scene) {
        Err(TrainError::OtherScene(problem)) => {
            let problem = problem.to_string();
            assert!(problem.contains("the depth of frame 00000"), "{problem}");
        }
        other => panic!("{:?}", other.err()),
    }
}

#[test]
fn an_error_and_its_causes_say_each_thing_once() {
    let started = trainer();
    let mut blind = camera();
    blind.fx = f64::NAN;
    let render = started.run().render_view(&blind, &pose(0.0), 0.0);
    let render: Box<dyn Error> = render.expect_err("no focal length").into();
    let folder = saved(&started);
    let mut shorter = scene();
    shorter.frames.pop();
    let load = Trainer::load(folder.path(), shorter, &Device::flex());
    let load: Box<dyn Error> = load.expect_err("another scene").into();
    std::fs::write(folder.path().join(trainer::CHECKPOINT_FILE), "{}").expect("written");
    let save: Box<dyn Error> = started
        .save(&folder.path().join(trainer::CHECKPOINT_FILE))
        .expect_err("a file is no folder")
        .into();
    let open: Box<dyn Error> = Run::open(folder.path(), &Device::flex())
        .expect_err("not a checkpoint")
        .into();
    for error in [render, load, save, open] {
        let causes = std::iter::successors(Some(&*error as &dyn Error), |&e| e.source());
        let messages: Vec<String> = causes.map(ToString::to_string).collect();
        assert!(messages.len() > 1, "{error} has no cause");
        for pair in messages.windows(2) {
            let [whole, cause] = pair else { unreachable!() };
            assert!(!whole.contains(cause.as_str()), "{}", with_causes(&*error));
        }
    }
}
