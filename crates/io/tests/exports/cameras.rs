//! Cameras, by this crate's own loader.

use io::glam::{DAffine3, DQuat, DVec3};
use io::{
    ExportedView, Image, IoError, Scene, SparsePoint, write_colmap, write_png, write_points_ply,
    write_transforms,
};
use splat_core::Camera;
use std::path::Path;

const FRAMES: usize = 11;

/// Training views, and test views between them, with two sets of intrinsics.
fn views() -> Vec<ExportedView> {
    let pose = |t: f64| {
        let turn = DQuat::from_scaled_axis(DVec3::new(0.3, -1.2, 2.9) * (1.0 + 0.05 * t));
        DAffine3::from_rotation_translation(turn, DVec3::new(0.1 * t, 1.0 / 3.0, -7.7 + t))
    };
    let train = (0..FRAMES).map(|i| ExportedView {
        file: format!("images/{i:05}.png"),
        camera: Camera::pinhole([8, 6], [9.1, 9.3], [4.05, 2.97]),
        cam_from_world: pose(i as f64),
        time: i as f32,
        is_test: false,
    });
    let test = [0.0_f32, 2.5, 10.0].map(|time| ExportedView {
        file: format!("images_test/{time}.png"),
        camera: Camera::pinhole([6, 8], [10.0, 10.0], [3.0, 4.0]),
        cam_from_world: pose(f64::from(time) + 0.3),
        time,
        is_test: true,
    });
    train.chain(test).collect()
}

fn points() -> Vec<SparsePoint> {
    (0..5)
        .map(|i| SparsePoint {
            position: DVec3::new(f64::from(i), 0.5, -1.25),
            color: [f32::from(i as u8) / 5.0, 0.2, 1.0],
        })
        .collect()
}

fn write_pictures(folder: &Path, views: &[ExportedView]) {
    for view in views {
        let (width, height) = (view.camera.width, view.camera.height);
        let image = Image {
            width,
            height,
            pixels: vec![0.5; 3 * width * height],
        };
        write_png(&folder.join(&view.file), &image).unwrap();
    }
}

fn assert_same(found: &io::View, expected: &ExportedView) {
    let (a, b) = (&found.camera, &expected.camera);
    assert_eq!([a.width, a.height], [b.width, b.height]);
    assert_eq!([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy]);
    assert!(
        found
            .cam_from_world
            .abs_diff_eq(expected.cam_from_world, 1e-9),
        "{:?}",
        found.cam_from_world
    );
}

fn assert_points(found: &[SparsePoint]) {
    assert_eq!(found.len(), 5);
    for (a, b) in found.iter().zip(points()) {
        assert!(a.position.abs_diff_eq(b.position, 1e-6));
        let off = a.color.iter().zip(b.color).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 0.51 / 255.0);
    }
}

#[test]
fn transforms_are_the_data_set_that_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let views = views();
    write_pictures(folder.path(), &views);
    write_points_ply(&folder.path().join("points.ply"), &points()).unwrap();
    write_transforms(
        &folder.path().join("transforms.json"),
        &views,
        Some("points.ply"),
    )
    .unwrap();
    // Readers agree that no model is a pinhole, and on no name for it.
    let json = std::fs::read_to_string(folder.path().join("transforms.json")).unwrap();
    assert!(!json.contains("camera_model"), "{json}");
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(
        (scene.layout, scene.frames.len(), scene.test.len()),
        ("nerfstudio", FRAMES, 3)
    );
    for (frame, view) in scene.frames.iter().zip(&views) {
        assert_same(&frame.view, view);
        assert_eq!(frame.view.time, view.time);
    }
    // The loader takes them in the order of their names.
    for test in &scene.test {
        let view = views
            .iter()
            .find(|v| v.is_test && (v.time - test.time).abs() < 1e-5);
        assert_same(test, view.expect("a test view of this time"));
    }
    assert_points(&scene.points);
}

#[test]
fn a_colmap_model_is_the_one_that_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let views: Vec<ExportedView> = views().into_iter().filter(|view| !view.is_test).collect();
    write_pictures(folder.path(), &views);
    let model = folder.path().join("flow3d_preprocessed/colmap/sparse/0");
    let named = views.iter().map(|view| ExportedView {
        file: view.file.replace("images/", ""),
        ..view.clone()
    });
    write_colmap(&model, &named.collect::<Vec<_>>(), &points()).unwrap();
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(
        (scene.layout, scene.frames.len()),
        ("Shape-of-Motion", FRAMES)
    );
    for (frame, view) in scene.frames.iter().zip(&views) {
        assert_same(&frame.view, view);
    }
    assert_points(&scene.points);
    let cameras = std::fs::read_to_string(model.join("cameras.txt")).unwrap();
    assert_eq!(
        cameras.lines().count(),
        2,
        "views share a camera: {cameras}"
    );
}

#[test]
fn cameras_that_no_reader_would_take_are_refused_and_the_old_file_stays() {
    let folder = tempfile::tempdir().unwrap();
    let [json, model] = ["transforms.json", "sparse"].map(|name| folder.path().join(name));
    write_transforms(&json, &views(), None).unwrap();
    write_colmap(&model, &views(), &[]).unwrap();
    let contents = || [&json, &model.join("images.txt")].map(|path| std::fs::read(path).unwrap());
    let before = contents();
    type Edit = fn(&mut ExportedView);
    let edits: [Edit; 3] = [
        |view| view.cam_from_world.translation.y = f64::NAN,
        |view| view.camera.fx = f64::INFINITY,
        |view| view.time = f32::NAN,
    ];
    for edit in edits {
        let mut bad = views();
        edit(&mut bad[3]);
        for error in [
            write_transforms(&json, &bad, None),
            write_colmap(&model, &bad, &[]),
        ] {
            let error = error.unwrap_err();
            assert!(matches!(error, IoError::NotANumber { .. }), "{error}");
            assert!(error.to_string().contains("00003.png"), "{error}");
        }
    }
    for name in ["two words.png", "line\nend.png", ""] {
        let mut bad = views();
        bad[0].file = name.to_owned();
        let error = write_colmap(&model, &bad, &[]).unwrap_err();
        assert!(matches!(error, IoError::Invalid { .. }), "{error}");
    }
    let lost = SparsePoint {
        position: DVec3::NAN,
        color: [0.0; 3],
    };
    assert!(matches!(
        write_colmap(&model, &views(), &[lost]),
        Err(IoError::NotANumber { .. })
    ));
    let ply = folder.path().join("points.ply");
    assert!(matches!(
        write_points_ply(&ply, &[lost]),
        Err(IoError::NotANumber { .. })
    ));
    assert_eq!(contents(), before);
}

#[test]
fn a_scene_without_views_or_of_one_moment_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    write_transforms(&path, &[], None).unwrap();
    write_transforms(&path, &views()[..1], None).unwrap();
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.contains("\"time\": 0.0"), "{text}");
}
