//! What was given wrong of the frames is found: poses that are off, and gains of an automatic exposure.

use burn::tensor::DType;
use capture::{Capture, shift_in_image, shift_of};
use glam::{DAffine3, DQuat, DVec3};
use io::Scene;
use limpid_tests::tiny::{self, FRAMES, camera, pose};
use trainer::settings::{BlurKind, When};
use trainer::{Device, Settings, Trainer};

/// The tiny scene in sharp frames.
fn sharp() -> Scene {
    let mut scene = tiny::scene();
    for (frame, test) in scene.frames.iter_mut().zip(&scene.test) {
        frame.view.image = test.image.clone();
    }
    scene
}

fn settings(iterations: usize) -> Settings {
    let mut settings = tiny::settings();
    settings.iterations = iterations;
    settings.blur.model = BlurKind::Off;
    settings.unseen.when = When::Never;
    settings.frames.gains = When::Auto;
    settings.frames.offsets = false;
    settings
}

fn trained(scene: Scene, settings: Settings) -> Trainer {
    let mut trainer = Trainer::new(scene, settings, &Device::flex()).expect("a trainer");
    while !trainer.is_done() {
        trainer.step().expect("a step");
    }
    trainer
}

/// Logarithms whose sum is zero.
const GAINS: [f64; FRAMES] = [0.12, -0.08, 0.05, -0.1, 0.07, -0.06];

#[test]
fn the_survey_sees_gains_and_training_finds_them() {
    let mut scene = sharp();
    for (frame, gain) in scene.frames.iter_mut().zip(GAINS) {
        for value in &mut frame.view.image.pixels {
            *value *= gain.exp() as f32;
        }
    }
    let trainer = trained(scene, settings(300));
    let survey = trainer.survey();
    assert!(survey.gains_differ, "{:?}", survey.brightness_change);
    let found = trainer.evaluate().expect("scores").corrections;
    let found: Vec<f64> = found.expect("gains").iter().map(|f| f.gain.ln()).collect();
    for (found, gain) in found.iter().zip(GAINS) {
        assert!((found - gain).abs() < 0.02, "{found} where {gain} was put");
    }
    let mean = found.iter().sum::<f64>() / FRAMES as f64;
    assert!(mean.abs() < 1e-5, "their mean is the scene's: {mean}");
}

#[test]
fn frames_of_one_exposure_have_no_gains() {
    let trainer = Trainer::new(sharp(), settings(200), &Device::flex()).expect("a trainer");
    let survey = trainer.survey();
    assert!(!survey.gains_differ, "{:?}", survey.brightness_change);
    let corrections = trainer.evaluate().expect("scores").corrections;
    assert!(corrections.is_none(), "{corrections:?}");
}

#[test]
fn the_survey_sees_an_exposure_that_changes_once() {
    for from in 1..FRAMES {
        let mut scene = sharp();
        for frame in &mut scene.frames[from..] {
            for value in &mut frame.view.image.pixels {
                *value *= 0.8;
            }
        }
        let trainer = Trainer::new(scene, settings(200), &Device::flex()).expect("a trainer");
        let survey = trainer.survey();
        let changes = (survey.brightness_change, survey.most_brightness_change);
        assert!(survey.gains_differ, "from frame {from} on: {changes:?}");
    }
}

#[test]
fn three_frames_do_not_tell_brightness() {
    let mut scene = sharp();
    scene.frames.truncate(3);
    scene.test.truncate(3);
    scene.tracks = None;
    for frame in &mut scene.frames[1..] {
        for value in &mut frame.view.image.pixels {
            *value *= 0.8;
        }
    }
    let trainer = Trainer::new(scene, settings(200), &Device::flex()).expect("a trainer");
    let survey = trainer.survey();
    assert_eq!(survey.brightness_change, None);
    assert!(!survey.gains_differ);
}

/// How far a pose lies off the true one of a frame, px at the wall.
fn off_px(found: &DAffine3, frame: usize) -> [f64; 2] {
    let point = pose(frame as f64)
        .inverse()
        .transform_point3(DVec3::Z * tiny::WALL);
    let seen = camera().project(found.transform_point3(point));
    [seen.x - camera().cx, seen.y - camera().cy]
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The values of all frames without their mean, one after the other.
fn centered(values: &[[f64; 2]]) -> Vec<f64> {
    let n = values.len() as f64;
    let mean = [0, 1].map(|axis| values.iter().map(|v| v[axis]).sum::<f64>() / n);
    let centered = values.iter().flat_map(|v| [v[0] - mean[0], v[1] - mean[1]]);
    centered.collect()
}

/// How far the frames' cameras stand aside, in their own axes.
fn aside() -> Vec<[f64; 2]> {
    let places = (0..FRAMES).map(|k| pose(k as f64).transform_point3(DVec3::ZERO));
    places.map(|place| [place.x, place.y]).collect()
}

/// Shifts of frames that stand so far aside without what the scene can take up: what all have in common, and what grows with how
/// far a frame's camera stands aside.
fn own(shifts: &[[f64; 2]], aside: &[[f64; 2]]) -> Vec<f64> {
    let (shifts, aside) = (centered(shifts), centered(aside));
    let trend = dot(&shifts, &aside) / dot(&aside, &aside);
    let each = shifts.iter().zip(&aside);
    each.map(|(shift, aside)| shift - trend * aside).collect()
}

/// Root mean square over the frames of what is their own.
fn spread(offs: &[[f64; 2]]) -> f64 {
    let own = own(offs, &aside());
    (dot(&own, &own) / FRAMES as f64).sqrt()
}

#[test]
fn what_the_scene_can_take_up_is_left_to_it() {
    let mut settings = tiny::settings();
    settings.blur.model = BlurKind::Camera;
    let mut trainer = Trainer::new(tiny::scene(), settings, &Device::flex()).expect("a trainer");
    // The camera has been learned for a while, and no trial has left a part of it out.
    while trainer.iteration() < 75 {
        trainer.step().expect("a step");
    }
    let table = |name: &str| {
        let parameters = trainer.model().parameters();
        let found = parameters.into_iter().find(|(p, _)| p.name == name);
        found.expect(name).1.detach()
    };
    let mut capture = Capture::still(FRAMES, 2, (&Device::flex().autodiff(), DType::F32));
    capture.paths = table("camera.paths");
    let offsets = limpid_tests::values(shift_in_image(table("frames.offsets")));
    let offsets: Vec<[f64; 2]> = offsets.chunks_exact(2).map(|s| [s[0], s[1]]).collect();
    assert!(spread(&offsets) > 1e-5, "offsets have learned: {offsets:?}");
    assert_all_own("offsets", &offsets, &aside());

    // The paths have what the poses foretell of it, of all but the first and the last frame.
    let taken = capture.all_taken();
    let means: Vec<[f64; 2]> = taken.iter().map(|f| shift_of(f.mean_motion())).collect();
    assert!(spread(&means) > 1e-5, "paths have learned: {means:?}");
    let (means, aside) = (&means[1..FRAMES - 1], &aside()[1..FRAMES - 1]);
    let foretold = foretold(trainer.survey().scene_size);
    let told = own(&foretold, aside);
    let factor = (dot(&told, &own(means, aside)) / dot(&told, &told)).max(0.0);
    let each = means.iter().zip(&foretold);
    let missed: Vec<_> = each
        .map(|(mean, told)| [0, 1].map(|axis| mean[axis] - factor * told[axis]))
        .collect();
    assert_all_own("paths", &missed, aside);
}

/// The frames' shifts have nothing that the scene can take up.
fn assert_all_own(what: &str, shifts: &[[f64; 2]], aside: &[[f64; 2]]) {
    let all = shifts.concat();
    let limit = 1e-6 * dot(&all, &all).sqrt();
    let sums = [0, 1].map(|axis| shifts.iter().map(|shift| shift[axis]).sum::<f64>());
    assert!(
        sums.into_iter().all(|sum| sum.abs() < limit),
        "{what}: {sums:?} of {limit}"
    );
    let trend = dot(&all, &centered(aside));
    assert!(trend.abs() < limit, "{what}: {trend} of {limit}");
}

/// By how far the poses before and after a frame say that its camera is accelerated, in the image at the depth `size`: of all frames
/// but the first and the last.
fn foretold(size: f64) -> Vec<[f64; 2]> {
    let second = |k: usize| {
        let step = |other: f64| {
            let moved = pose(other) * pose(k as f64).inverse();
            let turn = DQuat::from_mat3(&moved.matrix3).to_scaled_axis();
            let shift = moved.translation / size;
            [turn.y + shift.x, shift.y - turn.x]
        };
        let (back, ahead) = (step(k as f64 - 1.0), step(k as f64 + 1.0));
        [back[0] + ahead[0], back[1] + ahead[1]]
    };
    (1..FRAMES - 1).map(second).collect()
}

#[test]
fn poses_that_were_given_wrong_come_back() {
    let mut scene = sharp();
    for (k, frame) in scene.frames.iter_mut().enumerate() {
        let angle = 2.4 * k as f64;
        let turn = DVec3::new(angle.cos(), angle.sin(), 0.0) / camera().fx;
        let turn = DAffine3::from_quat(DQuat::from_scaled_axis(turn));
        frame.view.cam_from_world = turn * frame.view.cam_from_world;
    }
    let mut settings = settings(400);
    settings.frames.offsets = true;
    let given: Vec<_> = (0..FRAMES)
        .map(|k| off_px(&scene.frames[k].view.cam_from_world, k))
        .collect();
    let trainer = trained(scene, settings);
    let found: Vec<_> = (0..FRAMES)
        .map(|k| off_px(&trainer.run().view_at(k as f32).cam_from_world, k))
        .collect();
    let (before, after) = (spread(&given), spread(&found));
    assert!(before > 0.9, "{before} px off");
    assert!(after < 0.4 * before, "{after} px of {before} are left");
    let figures = trainer.evaluate().expect("scores").corrections;
    assert!(figures.expect("offsets").iter().all(|f| f.gain == 1.0));
}
