//! Training end to end on the tiny scene.

use burn::tensor::Device;
use glam::DVec2;
use io::Scene;
use limpid_tests::tiny::{HEIGHT, WALL, WIDTH, camera, checkpoint, pose, scene, settings};
use limpid_tests::{devices, in_pool, with_causes};
use splat_core::{Extra, Splats, Viewpoint, render};
use trainer::settings::{BlurKind, FrameSettings, When};
use trainer::{BlurModel, Trainer, survey};

/// A trainer on a device, behind so many iterations in main memory, which are quicker there than on a GPU that a CPU plays.
fn behind(iterations: usize, device: &Device) -> Trainer {
    let folder = tempfile::tempdir().expect("a folder");
    checkpoint(folder.path(), settings().blur.model, iterations);
    Trainer::load(folder.path(), scene(), device).expect("loaded")
}

/// The bits of all parameters after 56 iterations, and the losses of the last, in which blur begins to be modelled.
fn train(device: &Device) -> (Vec<f64>, Vec<(String, Vec<u32>)>) {
    let mut trainer = behind(48, device);
    let losses = (48..56)
        .map(|_| trainer.step().expect("a step").loss)
        .collect();
    (losses, bits(&trainer))
}

fn bits(trainer: &Trainer) -> Vec<(String, Vec<u32>)> {
    let parameters = trainer.model().parameters().into_iter();
    parameters
        .map(|(parameter, t)| {
            let name = parameter.name;
            let values = t.try_into_vec_as::<f32>().expect("readable");
            (name, values.into_iter().map(f32::to_bits).collect())
        })
        .collect()
}

fn assert_same(a: &[(String, Vec<u32>)], b: &[(String, Vec<u32>)], what: &str) {
    assert_eq!(a.len(), b.len(), "{what}: number of parameters");
    for ((name, left), (_, right)) in a.iter().zip(b) {
        let differing = left.iter().zip(right).filter(|(x, y)| x != y).count();
        assert!(
            left.len() == right.len() && differing == 0,
            "{what}: {differing} of {} values of {name} differ",
            left.len()
        );
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_with_one_and_two_threads() {
    for (name, device) in devices() {
        let (one_losses, one) = in_pool(1, || train(&device));
        let (two_losses, two) = in_pool(2, || train(&device));
        assert_eq!(one_losses, two_losses, "{name}");
        assert_same(&one, &two, name);
    }
}

#[test]
fn saving_and_loading_in_the_middle_changes_no_bit() {
    for (name, device) in devices() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut trainer = behind(49, &device);
        for _ in 49..52 {
            trainer.step().expect("a step");
        }
        trainer.save(folder.path()).expect("saved");
        let mut resumed = Trainer::load(folder.path(), scene(), &device).expect("loaded");
        // One of five views is an unseen one.
        for _ in 0..6 {
            let (a, b) = (
                trainer.step().expect("a step"),
                resumed.step().expect("a step"),
            );
            assert_eq!(a, b, "{name}");
        }
        assert_same(&bits(&trainer), &bits(&resumed), name);
    }
}

#[test]
fn a_broken_checkpoint_is_an_error_that_names_the_file() {
    let device = Device::flex();
    let folder = tempfile::tempdir().expect("a folder");
    let trainer = Trainer::new(scene(), settings(), &device).expect("a trainer");
    trainer.save(folder.path()).expect("saved");
    let file = folder.path().join("state.safetensors");
    let whole = std::fs::read(&file).expect("bytes");
    for length in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&file, &whole[..length]).expect("written");
        let error = Trainer::load(folder.path(), scene(), &device)
            .expect_err("truncated")
            .to_string();
        assert!(error.contains("state.safetensors"), "{error}");
    }
    std::fs::write(&file, &whole).expect("written");
    let mut shorter = scene();
    shorter.frames.pop();
    let error = Trainer::load(folder.path(), shorter, &device).expect_err("another scene");
    let error = with_causes(&error);
    assert!(
        error.contains("6 frames") && error.contains("has 5"),
        "{error}"
    );
}

fn still_scene() -> Scene {
    let mut still = scene();
    still.tracks = None;
    for frame in &mut still.frames {
        frame.mask = None;
    }
    still
}

/// The scene with masks and tracks of a poster on the wall.
fn scene_with_a_poster() -> Scene {
    let mut scene = scene();
    let seen = |at: DVec2, t: usize| {
        let from_world = pose(t as f64);
        camera().project(from_world.transform_point3(at.extend(WALL)))
    };
    for (t, frame) in scene.frames.iter_mut().enumerate() {
        let corners = [DVec2::new(-0.9, -0.7), DVec2::new(1.1, 0.7)].map(|at| seen(at, t));
        let inside = |i: usize| {
            let at = DVec2::new((i % WIDTH) as f64 + 0.5, (i / WIDTH) as f64 + 0.5);
            at.cmpgt(corners[0]).all() && at.cmplt(corners[1]).all()
        };
        let mask = frame.mask.as_mut().expect("a mask");
        mask.values = (0..WIDTH * HEIGHT)
            .map(|i| f32::from(u8::from(inside(i))))
            .collect();
        let depth = frame.depth.as_mut().expect("depth");
        depth.values.fill(WALL as f32);
    }
    let tracks = scene.tracks.as_mut().expect("tracks");
    for query in &mut tracks.queries {
        for (row, samples) in query
            .samples
            .chunks_exact_mut(tracks.num_frames)
            .enumerate()
        {
            let place = DVec2::new((row % 6) as f64, (row / 6) as f64);
            let at = DVec2::new(-0.8, -0.6) + place * DVec2::new(0.36, 0.24);
            for (t, sample) in samples.iter_mut().enumerate() {
                let pixel = seen(at, t);
                (sample.x, sample.y) = (pixel.x as f32, pixel.y as f32);
            }
        }
    }
    scene
}

#[test]
fn masks_of_what_stands_still_are_left_out_unless_movers_are_asked_for() {
    let device = Device::flex();
    let started = |scene: Scene, when: When| {
        let mut settings = settings();
        settings.motion.when = when;
        Trainer::new(scene, settings, &device).expect("a trainer")
    };
    let mut left_out = started(scene_with_a_poster(), When::Auto);
    let survey = left_out.survey().clone();
    assert!(!survey.movers, "{:?}", survey.notes);
    let found = survey.track_motion.expect("tracks enough");
    assert!(found.stands_still() && found.leaving == 0.0, "{found:?}");
    let is_told = survey.notes.iter().any(|n| n.contains("stands still"));
    assert!(is_told, "{:?}", survey.notes);

    // The same as a scene that never had masks and tracks, and as one that is said to be static.
    let mut without = scene_with_a_poster();
    without.tracks = None;
    without.frames.iter_mut().for_each(|f| f.mask = None);
    for (scene, when) in [(without, When::Auto), (scene_with_a_poster(), When::Never)] {
        assert_same(&bits(&left_out), &bits(&started(scene, when)), "left out");
    }
    let folder = tempfile::tempdir().expect("a folder");
    left_out.save(folder.path()).expect("saved");
    let mut resumed = Trainer::load(folder.path(), scene_with_a_poster(), &device).expect("loaded");
    for trainer in [&mut left_out, &mut resumed] {
        trainer.step().expect("a step");
    }
    assert_same(&bits(&left_out), &bits(&resumed), "resumed");

    let asked = started(scene_with_a_poster(), When::Always);
    assert!(asked.survey().movers, "{:?}", asked.survey().notes);
    // What moves is not left out.
    let mover = started(scene(), When::Auto);
    assert!(mover.survey().movers, "{:?}", mover.survey().notes);
}

#[test]
fn tracks_without_masks_are_looked_at_too() {
    let notes = |mut scene: Scene| {
        scene.frames.iter_mut().for_each(|f| f.mask = None);
        let survey = survey(&mut scene, When::Auto).expect("a survey");
        assert!(!survey.movers);
        survey.notes.join("\n")
    };
    let moving = notes(scene());
    assert!(moving.contains("warning: there are no masks"), "{moving}");
    let still = notes(scene_with_a_poster());
    assert!(!still.contains("warning"), "{still}");
}

/// The checkpoint's header is text: every number in it must come back as it was.
#[test]
fn any_scene_size_survives_the_checkpoint() {
    let folder = tempfile::tempdir().expect("a folder");
    for depth in [1.837_003_8_f32, 9.707_077, 0.311_234_5, 87.654_32] {
        let flat = || {
            let mut scene = still_scene();
            for map in scene.frames.iter_mut().filter_map(|f| f.depth.as_mut()) {
                map.values.fill(depth);
            }
            scene
        };
        let device = Device::flex();
        let trainer = Trainer::new(flat(), settings(), &device).expect("a trainer");
        assert_eq!(trainer.survey().scene_size, f64::from(depth));
        trainer.save(folder.path()).expect("saved");
        Trainer::load(folder.path(), flat(), &device).expect("loaded");
    }
}

#[test]
fn a_mover_that_fills_the_view_leaves_nothing_static_and_trains() {
    let mut filled = scene();
    for mask in filled.frames.iter_mut().filter_map(|f| f.mask.as_mut()) {
        mask.values.fill(1.0);
    }
    let mut trainer = Trainer::new(filled, settings(), &Device::flex()).expect("a trainer");
    assert_eq!(
        trainer.model().num_dynamic(),
        trainer.model().num_gaussians(),
        "nothing is static"
    );
    for _ in 0..30 {
        trainer.step().expect("a step");
    }
}

/// Density control, which comes first, may not take all the room there is.
#[test]
fn dynamic_densification_finds_room_under_the_limit() {
    let mut settings = settings();
    settings.blur.model = BlurKind::Off;
    settings.gaussians.initial_static_per_pixel = 6.0;
    settings.gaussians.gradient_threshold = 1e-12;
    settings.motion.densify_at = 16_000;
    let mut trainer = Trainer::new(scene(), settings, &Device::flex()).expect("a trainer");
    for _ in 0..79 {
        trainer.step().expect("a step");
    }
    let (all, dynamic) = (
        trainer.model().num_gaussians(),
        trainer.model().num_dynamic(),
    );
    trainer.step().expect("a step");
    assert_eq!(trainer.schedule().densify_dynamic_at, Some(80));
    let added = trainer.model().num_dynamic() - dynamic;
    assert!(
        added > 0 && trainer.model().num_gaussians() == 20_000,
        "{all} Gaussians, then {added} more"
    );
}

/// Density control acts by what it has gathered, which begins anew where movers are added.
#[test]
fn movers_that_come_with_density_control_take_nothing_from_it() {
    let mut settings = settings();
    settings.blur.model = BlurKind::Off;
    settings.gaussians.gradient_threshold = 1e-12;
    settings.motion.densify_at = 10_000;
    let mut trainer = Trainer::new(scene(), settings, &Device::flex()).expect("a trainer");
    let moment = 50;
    assert_eq!(trainer.schedule().densify_dynamic_at, Some(moment));
    assert!(trainer.schedule().controls_density(moment));
    for _ in 1..moment {
        trainer.step().expect("a step");
    }
    let counts = |trainer: &Trainer| {
        let model = trainer.model();
        let dynamic = model.num_dynamic();
        [dynamic, model.num_gaussians() - dynamic]
    };
    let before = counts(&trainer);
    trainer.step().expect("a step");
    let after = counts(&trainer);
    assert!(
        after[0] > before[0] && after[1] > before[1],
        "{before:?}, then {after:?}"
    );
}

/// Warping blurs a frame once more, which kernels explain and nothing else does.
#[test]
fn unseen_views_stand_beside_kernels_alone_where_nothing_is_said() {
    for (model, has) in [
        (BlurKind::Off, false),
        (BlurKind::Kernels, true),
        (BlurKind::Camera, false),
        (BlurKind::Both, false),
    ] {
        for (when, has) in [
            (When::Auto, has),
            (When::Always, true),
            (When::Never, false),
        ] {
            let mut settings = settings();
            settings.blur.model = model;
            settings.unseen.when = when;
            let trainer = Trainer::new(scene(), settings, &Device::flex()).expect("a trainer");
            let shown = trainer.schedule().unseen_from.is_some();
            assert_eq!(shown, has, "{model:?}, {when:?}");
        }
    }
}

#[test]
fn a_static_scene_without_blur_models_neither() {
    let still = still_scene();
    let mut settings = settings();
    settings.blur.model = BlurKind::Off;
    settings.frames = FrameSettings::default();
    let mut trainer = Trainer::new(still, settings, &Device::flex()).expect("a trainer");
    assert!(trainer.model().world.motion.is_none());
    assert!(matches!(trainer.model().blur, BlurModel::Off));
    assert_eq!(trainer.model().num_dynamic(), 0);
    for _ in 0..30 {
        trainer.step().expect("a step");
    }
    let names: Vec<String> = trainer
        .model()
        .parameters()
        .into_iter()
        .map(|(parameter, _)| parameter.name)
        .collect();
    assert!(
        names.iter().all(|name| name.starts_with("gaussians.")),
        "{names:?}"
    );
    let evaluation = trainer.evaluate().expect("scores");
    assert_eq!(evaluation.blur, None);
    assert!(evaluation.test.expect("test views").mean.psnr > 15.0);
}

/// What a viewer draws from the PLY of a time is what the trainer renders at that time.
#[test]
fn posed_gaussians_look_like_the_moving_scene() {
    let device = Device::flex();
    let mut trainer = Trainer::new(scene(), settings(), &device).expect("a trainer");
    for _ in 0..30 {
        trainer.step().expect("a step");
    }
    let near = 0.01 * trainer.survey().scene_size;
    for time in [0.0, 2.5, 5.0] {
        let posed = trainer.run().gaussians(Some(time)).expect("rows");
        let splats = Splats::new(&posed, &device).expect("Gaussians");
        let camera = camera().with_near(near);
        let degree = trainer.schedule().sh_degree_at(30);
        let view = Viewpoint::new(&camera, &pose(2.0), degree, &splats);
        let drawn = render(splats, &view, Extra::default())
            .expect("a picture")
            .color();
        let drawn = drawn.try_into_vec_as::<f32>().expect("readable");
        let rendered = trainer
            .run()
            .render_view(&camera, &pose(2.0), time)
            .expect("a picture")
            .pixels;
        let worst = drawn
            .iter()
            .zip(&rendered)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        // An alpha at the threshold may fall on the other side by rounding: one part in 255.
        assert!(worst < 5e-3, "at {time}: {worst}");
        let mean = drawn
            .iter()
            .zip(&rendered)
            .map(|(a, b)| (a - b).abs())
            .sum::<f32>()
            / drawn.len() as f32;
        assert!(mean < 1e-5, "at {time}: {mean}");
    }
}
