//! `trainer::check`: inputs in another convention are found out, and those that are right raise no alarm.

use glam::{DAffine3, DMat3, DVec3};
use io::{Map, Scene, TrackSample};
use limpid_tests::folder::write_npy;
use limpid_tests::tiny;
use std::path::{Path, PathBuf};
use trainer::check::{Verdict, check};
use trainer::settings::{BlurKind, When};
use trainer::{Device, SceneProblem, Settings, TrainError, Trainer, survey};

/// The demo, and all scenes of the folder that `LIMPID_SCENES` names.
fn scenes() -> Vec<(String, Scene)> {
    let mut folders = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("../demo")];
    match std::env::var_os("LIMPID_SCENES") {
        Some(others) => {
            let entries = std::fs::read_dir(others).expect("LIMPID_SCENES is a folder");
            let paths = entries.map(|entry| entry.expect("an entry").path());
            folders.extend(paths.filter(|path| path.is_dir()));
        }
        None => {
            eprintln!("LIMPID_SCENES names no folder with more scenes: only the demo is looked at");
        }
    }
    let open = |path: PathBuf| {
        (
            path.display().to_string(),
            Scene::open(&path).expect("a scene"),
        )
    };
    folders.into_iter().map(open).collect()
}

/// OpenCV's camera axes from OpenGL's, and back.
fn flip() -> DAffine3 {
    DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)))
}

fn pose_by(scene: &mut Scene, layout: &'static str, change: impl Fn(DAffine3) -> DAffine3) {
    scene.layout = layout;
    for frame in &mut scene.frames {
        frame.view.cam_from_world = change(frame.view.cam_from_world);
    }
}

fn depth_by(scene: &mut Scene, change: impl Fn(f32) -> f32) {
    let maps = scene.frames.iter_mut().filter_map(|f| f.depth.as_mut());
    for z in maps
        .flat_map(|m: &mut Map| &mut m.values)
        .filter(|z| **z > 0.0)
    {
        *z = change(*z);
    }
}

fn tracks_by(scene: &mut Scene, change: impl Fn(&mut TrackSample)) {
    let queries = scene.tracks.iter_mut().flat_map(|t| &mut t.queries);
    queries.flat_map(|q| &mut q.samples).for_each(change);
}

const SHAPE_OF_MOTION: &str = "Shape-of-Motion";
const NERFSTUDIO: &str = "nerfstudio";
const MEGASAM: &str = "MegaSaM";

/// Something that files may hold in the place of what is meant, as reading them makes of it.
struct Mistake {
    name: &'static str,
    /// What a finding says of it.
    said: &'static str,
    make: fn(&mut Scene),
}

/// `pose` is what reading makes of the true pose: the files' matrices are read by their layout's custom, and hold another's.
const MISTAKES: [Mistake; 15] = [
    Mistake {
        name: "depth where disparity is meant",
        said: "inverse depth",
        make: |scene| depth_by(scene, |z| 1.0 / z),
    },
    Mistake {
        name: "disparity where depth is meant, without points",
        said: "inverse depth",
        make: |scene| {
            scene.layout = NERFSTUDIO;
            scene.points.clear();
            depth_by(scene, |z| 0.3 / z);
        },
    },
    Mistake {
        name: "depth in another unit, without points",
        said: "depth times",
        make: |scene| {
            scene.layout = NERFSTUDIO;
            scene.points.clear();
            depth_by(scene, |z| 0.1 * z);
        },
    },
    Mistake {
        name: "OpenCV axes in transforms.json",
        said: "camera-to-world matrices with OpenCV axes",
        make: |scene| pose_by(scene, NERFSTUDIO, |pose| flip() * pose),
    },
    Mistake {
        name: "world-to-camera in transforms.json",
        said: "world-to-camera matrices with OpenGL axes",
        make: |scene| pose_by(scene, NERFSTUDIO, |pose| flip() * pose.inverse() * flip()),
    },
    Mistake {
        name: "world-to-camera with OpenCV axes in transforms.json",
        said: "world-to-camera matrices with OpenCV axes",
        make: |scene| pose_by(scene, NERFSTUDIO, |pose| flip() * pose.inverse()),
    },
    Mistake {
        name: "OpenGL axes in COLMAP's model",
        said: "world-to-camera poses with OpenGL axes",
        make: |scene| pose_by(scene, SHAPE_OF_MOTION, |pose| flip() * pose),
    },
    Mistake {
        name: "camera-to-world in COLMAP's model",
        said: "camera-to-world poses",
        make: |scene| pose_by(scene, SHAPE_OF_MOTION, |pose| pose.inverse()),
    },
    Mistake {
        name: "camera-to-world with OpenGL axes in COLMAP's model",
        said: "camera-to-world poses with OpenGL axes",
        make: |scene| pose_by(scene, SHAPE_OF_MOTION, |pose| pose.inverse() * flip()),
    },
    Mistake {
        name: "OpenGL axes in MegaSaM's archive",
        said: "camera-to-world poses with OpenGL axes",
        make: |scene| pose_by(scene, MEGASAM, |pose| flip() * pose),
    },
    Mistake {
        name: "world-to-camera in MegaSaM's archive",
        said: "world-to-camera poses",
        make: |scene| pose_by(scene, MEGASAM, |pose| pose.inverse()),
    },
    Mistake {
        name: "world-to-camera with OpenGL axes in MegaSaM's archive",
        said: "world-to-camera poses with OpenGL axes",
        make: |scene| pose_by(scene, MEGASAM, |pose| pose.inverse() * flip()),
    },
    Mistake {
        name: "masks turned round",
        said: "turned round",
        make: |scene| {
            let masks = scene.frames.iter_mut().filter_map(|f| f.mask.as_mut());
            masks
                .flat_map(|m| &mut m.values)
                .for_each(|v| *v = 1.0 - *v);
        },
    },
    Mistake {
        name: "tracks normalised to [0, 1]",
        said: "shares of the picture",
        make: |scene| {
            let size = [
                scene.frames[0].view.image.width,
                scene.frames[0].view.image.height,
            ];
            tracks_by(scene, |s| {
                s.x = (s.x - 0.5) / size[0] as f32 + 0.5;
                s.y = (s.y - 0.5) / size[1] as f32 + 0.5;
            });
        },
    },
    Mistake {
        name: "tracks of a video of twice the size",
        said: "another size",
        make: |scene| {
            tracks_by(scene, |s| {
                s.x *= 2.0;
                s.y *= 2.0;
            });
        },
    },
];

#[test]
fn scenes_that_are_right_raise_no_alarm() {
    for (name, scene) in scenes() {
        for finding in check(&scene, When::Auto) {
            assert!(finding.verdict <= Verdict::Untold, "{name}: {finding:?}");
        }
    }
}

#[test]
fn depth_in_places_plain_points_and_large_masks_are_not_wrong() {
    let (_, demo) = scenes().swap_remove(0);
    let size = [
        demo.frames[0].view.image.width,
        demo.frames[0].view.image.height,
    ];

    // As of a laser that scans.
    let mut sparse = demo.clone();
    let known = |i: usize| (i % size[0]).is_multiple_of(4) && (i / size[0]).is_multiple_of(4);
    for map in sparse.frames.iter_mut().filter_map(|f| f.depth.as_mut()) {
        let values = map.values.iter_mut().enumerate();
        values
            .filter(|(i, _)| !known(*i))
            .for_each(|(_, z)| *z = 0.0);
    }
    let mut plain = demo.clone();
    plain
        .points
        .iter_mut()
        .for_each(|point| point.color = [0.5; 3]);
    // Tracks are lifted by depth all around them: what moves needs more of it.
    for (scene, asked) in [(&sparse, When::Never), (&plain, When::Auto)] {
        for finding in check(scene, asked) {
            assert!(finding.verdict <= Verdict::Untold, "{finding:?}");
        }
    }

    // All but a frame of what stands still around them.
    let mut large = demo.clone();
    for map in large.frames.iter_mut().filter_map(|f| f.mask.as_mut()) {
        for (i, value) in map.values.iter_mut().enumerate() {
            let [x, y] = [i % size[0], i / size[0]];
            let inside = |at: usize, size: usize| (size / 10..size - size / 10).contains(&at);
            if inside(x, size[0]) && inside(y, size[1]) {
                *value = 1.0;
            }
        }
    }
    let masks = |scene: &Scene, asked| {
        let findings = check(scene, asked);
        findings.into_iter().find(|f| f.what == "masks")
    };
    let found = masks(&large, When::Auto).expect("a finding");
    assert_eq!(found.verdict, Verdict::Doubtful, "{found:?}");
    assert!(masks(&large, When::Never).is_none(), "nothing moves anyhow");
}

/// `motion.when = "never"` has a scene as it would be without masks and tracks, whatever the masks show.
#[test]
fn masks_that_are_left_out_say_nothing() {
    let (_, demo) = scenes().swap_remove(0);
    let surveyed = |mut scene: Scene| {
        let survey = survey(&mut scene, When::Never).expect("a survey");
        (scene.frames, survey.scene_size, survey.depth_range)
    };
    let mut without = demo.clone();
    without.frames.iter_mut().for_each(|f| f.mask = None);
    let findings = check(&without, When::Never);
    let without = surveyed(without);
    let changes: [fn(f32) -> f32; 3] = [|moves| moves, |moves| 1.0 - moves, |_| 1.0];
    for (k, change) in changes.into_iter().enumerate() {
        let mut scene = demo.clone();
        let masks = scene.frames.iter_mut().filter_map(|f| f.mask.as_mut());
        masks
            .flat_map(|m| &mut m.values)
            .for_each(|v| *v = change(*v));
        assert_eq!(check(&scene, When::Never), findings, "change {k}");
        assert!(surveyed(scene) == without, "change {k}");
    }
}

#[test]
fn depth_is_right_where_only_the_poses_are_wrong() {
    let (_, mut scene) = scenes().swap_remove(0);
    // As MegaSaM has it: depth and poses in one unit, and no points to tell that by.
    scene.points.clear();
    pose_by(&mut scene, MEGASAM, |pose| pose.inverse());
    let findings = check(&scene, When::Auto);
    let mut all = findings.iter();
    let found = all.find(|f| f.text.contains("with poses as world-to-camera poses"));
    let found = found.unwrap_or_else(|| panic!("{findings:?}"));
    assert!(!found.text.contains("depth times"), "{found:?}");
}

#[test]
fn no_mistake_is_passed_over() {
    for (scene_name, scene) in scenes() {
        let (mut made, mut passed_over) = (0, Vec::new());
        for mistake in &MISTAKES {
            let mut wrong = scene.clone();
            (mistake.make)(&mut wrong);
            if wrong == scene {
                continue;
            }
            made += 1;
            let findings = check(&wrong, When::Auto);
            let said = |f: &trainer::check::Finding| {
                f.verdict >= Verdict::Doubtful && f.text.contains(mistake.said)
            };
            if !findings.iter().any(said) {
                passed_over.push(format!("{scene_name}, {}: {findings:#?}", mistake.name));
            }
        }
        assert!(passed_over.is_empty(), "{}", passed_over.join("\n"));
        assert!(made >= 8, "{scene_name}: {made} mistakes could be made");
    }
}

#[test]
fn a_single_frame_that_is_elsewhere_is_named() {
    let (_, demo) = scenes().swap_remove(0);
    let name = demo.frames[3].view.name.clone();
    let found = |change: &dyn Fn(&mut io::Frame)| {
        let mut scene = demo.clone();
        change(&mut scene.frames[3]);
        let findings = check(&scene, When::Auto);
        let single = findings.into_iter().find(|f| f.what == "single frames");
        single.expect("a finding")
    };
    let right = found(&|_| ());
    assert_eq!(right.verdict, Verdict::Pass, "{right:?}");
    // Nor where the camera rests for a while, and poses are off by a third of a pixel.
    let mut resting = demo.clone();
    for k in 4..9 {
        let name = resting.frames[k].view.name.clone();
        let mut frame = resting.frames[3].clone();
        let angle = (k % 2) as f64 * 0.3 / frame.view.camera.fx;
        frame.view.cam_from_world = DAffine3::from_rotation_y(angle) * frame.view.cam_from_world;
        let pixels = &mut frame.view.image.pixels;
        pixels.iter_mut().for_each(|v| *v *= 1.0 - 0.001 * k as f32);
        frame.view.name = name;
        resting.frames[k] = frame;
    }
    let findings = check(&resting, When::Auto);
    let single = findings.iter().find(|f| f.what == "single frames");
    assert!(
        single.is_some_and(|f| f.verdict == Verdict::Pass),
        "{findings:?}"
    );
    let pose = |change: fn(DAffine3) -> DAffine3| {
        found(&move |frame| frame.view.cam_from_world = change(frame.view.cam_from_world))
    };
    for (what, wrong) in [
        (
            "far away",
            pose(|pose| DAffine3::from_translation(DVec3::X * 100.0) * pose),
        ),
        ("turned", pose(|pose| DAffine3::from_rotation_y(0.3) * pose)),
        ("upside down", pose(|pose| flip() * pose)),
        (
            "not turned",
            pose(|pose| DAffine3::from_translation(pose.translation)),
        ),
    ] {
        assert_eq!(wrong.verdict, Verdict::Doubtful, "{what}: {wrong:?}");
        let said = wrong.text.starts_with(&format!("{name}: at its pose"));
        assert!(said, "{what}: {wrong:?}");
    }
    let depth = found(&|frame| {
        let values = &mut frame.depth.as_mut().expect("depth").values;
        values.iter_mut().for_each(|z| *z = 1.0 / *z);
    });
    assert_eq!(depth.verdict, Verdict::Doubtful, "{depth:?}");
    assert!(
        depth.text.starts_with(&format!("{name}: by its depth")),
        "{depth:?}"
    );
}

#[test]
fn frames_without_depth_are_not_blamed_for_it() {
    let (_, mut scene) = scenes().swap_remove(0);
    for frame in &mut scene.frames[5..12] {
        frame.depth.as_mut().expect("depth").values.fill(0.0);
    }
    let findings = check(&scene, When::Auto);
    let single = findings.iter().find(|f| f.what == "single frames");
    assert!(
        single.is_some_and(|f| f.verdict == Verdict::Pass),
        "{findings:?}"
    );
}

#[test]
fn movers_that_cannot_be_lifted_are_an_error_that_says_what_is_missing() {
    let (_, demo) = scenes().swap_remove(0);
    for nothing in [0.0, -1.0] {
        let mut scene = demo.clone();
        depth_by(&mut scene, |_| nothing);
        let error = survey(&mut scene, When::Auto).expect_err("no depth");
        let is_told = matches!(error, TrainError::Scene(SceneProblem::MoversWithoutDepth));
        assert!(is_told, "{error}");
    }
}

#[test]
fn tracks_that_cannot_be_lifted_are_an_error_with_their_numbers() {
    let (_, mut scene) = scenes().swap_remove(0);
    tracks_by(&mut scene, |s| s.x += 1e4);
    let settings = Settings {
        iterations: 200,
        ..Settings::default()
    };
    let error = Trainer::new(scene, settings, &Device::flex()).expect_err("no track");
    let TrainError::Scene(SceneProblem::TracksNotLifted { found }) = error else {
        panic!("{error}");
    };
    assert!(found.visible > 0 && found.inside == 0, "{found}");
}

/// Training scores the scene that it surveyed, `limpid eval` the one that it reads, which still has masks that were left out.
#[test]
fn a_run_has_the_same_kernel_scores_on_the_scene_as_it_was_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut scene = tiny::scene();
    let truth = &mut scene.truth_folders;
    truth.depth = folder.path().join("depth");
    truth.exposure = folder.path().join("exposure");
    let still = [
        1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0_f32,
    ];
    for frame in &mut scene.frames {
        let file = format!("{}.npy", frame.view.name);
        let depth = frame.depth.as_ref().expect("depth");
        let sides = [depth.height, depth.width];
        write_npy(&truth.depth.join(&file), &sides, &depth.values).expect("written");
        write_npy(&truth.exposure.join(&file), &[1, 3, 4], &still).expect("written");
        // The left half.
        let mask = frame.mask.as_mut().expect("a mask");
        let moves = |i: usize| f32::from(u8::from(i % mask.width < mask.width / 2));
        mask.values = (0..mask.values.len()).map(moves).collect();
    }
    let mut settings = Settings::default();
    settings.motion.when = When::Never;
    settings.blur.model = BlurKind::Off;
    let trainer = Trainer::new(scene.clone(), settings, &Device::flex()).expect("a trainer");
    let own = trainer.evaluate().expect("scores").kernels;
    let as_read = trainer.run().evaluate(&scene, None).expect("scores");
    assert!(own.is_some_and(|kernels| kernels.count > 0), "{own:?}");
    assert_eq!(own, as_read.kernels);
}
