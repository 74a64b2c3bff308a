//! DyCheck's layout, with a sample written as its documentation and its published `paper-windmill`
//! cameras describe it.

use std::fs;
use std::path::Path;

use glam::{DMat3, DVec3};
use io::{IoError, LoadOptions, Scene};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::make::{self, FRAMES, HEIGHT, WIDTH, colmap_binary, npy};

/// The camera of a frame, twice as large as the pictures of `rgb/2x`.
fn camera(camera: usize, time: usize) -> Value {
    // World to camera; the same turn as DyCheck's first cameras, half a turn about x.
    json!({
        "orientation": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
        "position": [0.1 * time as f64, 0.3 * camera as f64, 2.0],
        "focal_length": 2.0 * make::FOCAL,
        "principal_point": [17.0, 11.0],
        "image_size": [2 * WIDTH, 2 * HEIGHT],
        "skew": 0.0,
        "pixel_aspect_ratio": 1.0,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
    })
}

/// Three training frames of camera 0 and two test views of camera 1, in no order.
fn sample() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let split = |names: &[&str], times: &[usize], camera: usize| {
        let cameras = vec![camera; names.len()];
        json!({ "frame_names": names, "time_ids": times, "camera_ids": cameras }).to_string()
    };
    let training = ["0_00004", "0_00000", "0_00002"];
    let test = ["1_00003", "1_00000"];
    make::write(
        &root.join("splits/train.json"),
        split(&training, &[4, 0, 2], 0),
    );
    make::write(&root.join("splits/val.json"), split(&test, &[3, 0], 1));
    for name in training.iter().chain(&test) {
        let of = (name[..1].parse().unwrap(), name[2..].parse().unwrap());
        write_json(root, name, &camera(of.0, of.1));
        make::ramp(&root.join(format!("rgb/2x/{name}.png")), of.1);
        // Smaller pictures, which the largest ones win over.
        make::picture(&root.join(format!("rgb/4x/{name}.png")), (8, 6), |_, _| 9);
    }
    for name in test {
        let path = root.join(format!("covisible/2x/val/{name}.png"));
        make::picture(&path, (WIDTH, HEIGHT), |x, _| 255 * u8::from(x < 3));
    }
    for name in training {
        let mut depth = [1.5f32; WIDTH * HEIGHT];
        depth[7] = 0.0;
        let array = npy(&[HEIGHT, WIDTH, 1], &depth);
        make::write(&root.join(format!("depth/2x/{name}.npy")), array);
    }
    for (file, value) in [
        (
            "scene.json",
            json!({ "center": [0, 0, 0], "scale": 0.3, "near": 0.1, "far": 2.0 }),
        ),
        ("extra.json", json!({ "factor": 2, "fps": 30.0 })),
    ] {
        make::write(&root.join(file), value.to_string());
    }
    make::write(&root.join("points.npy"), npy(&[1, 3], &[0.0, 0.0, 1.0]));
    folder
}

fn write_json(root: &Path, name: &str, camera: &Value) {
    make::write(
        &root.join(format!("camera/{name}.json")),
        camera.to_string(),
    );
}

fn names(scene: &Scene) -> Vec<&str> {
    scene.frames.iter().map(|f| f.view.name.as_str()).collect()
}

#[test]
fn a_scene_of_dycheck_is_read_as_it_is_documented() {
    let folder = sample();
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(scene.layout, "DyCheck");
    assert_eq!(names(&scene), ["0_00000", "0_00002", "0_00004"]);
    let times: Vec<_> = scene.frames.iter().map(|f| f.view.time).collect();
    assert_eq!(
        times,
        [0.0, 1.0, 2.0],
        "a training frame's time is its index"
    );
    let test: Vec<_> = scene
        .test
        .iter()
        .map(|v| (v.name.as_str(), v.time))
        .collect();
    assert_eq!(test, [("1_00000", 0.0), ("1_00003", 1.5)]);

    let view = &scene.frames[1].view;
    assert_eq!(
        (view.image.width, view.image.height),
        (WIDTH, HEIGHT),
        "the largest pictures"
    );
    assert_eq!(view.image.pixels[2], 20.0 / 255.0, "of its own frame");
    let c = &view.camera;
    assert_eq!((c.width, c.height), (WIDTH, HEIGHT));
    assert_eq!(
        [c.fx, c.fy, c.cx, c.cy],
        [make::FOCAL, make::FOCAL, 8.5, 5.5]
    );
    // OpenCV axes: half a turn about x has y and z reversed, from the camera at (0.2, 0, 2).
    let at = view
        .cam_from_world
        .transform_point3(DVec3::new(1.2, 1.0, 1.5));
    assert!((at - DVec3::new(1.0, -1.0, 0.5)).length() < 1e-12, "{at}");

    let covisible = scene.truth().unwrap().covisible.unwrap();
    assert_eq!(covisible[1].values[..4], [1.0, 1.0, 1.0, 0.0]);

    let depth = scene.frames[0].depth.as_ref().unwrap();
    assert_eq!(
        (depth.values[0], depth.values[7]),
        (1.5, 0.0),
        "in units of the poses"
    );
    assert!(scene.points.is_empty() && scene.tracks.is_none() && scene.undistorted.is_empty());
    for part in [
        "depth/ is taken to be in units of the poses",
        "points.npy is not read",
    ] {
        let told = scene.notes.iter().any(|n| n.contains(part));
        assert!(told, "{part}: {:?}", scene.notes);
    }
}

#[test]
fn lenses_of_dycheck_are_undistorted() {
    let folder = sample();
    let mut bent = camera(0, 2);
    bent["radial_distortion"] = json!([0.08, 0.0, 0.0]);
    bent["tangential_distortion"] = json!([0.001, 0.0]);
    bent["pixel_aspect_ratio"] = 1.05.into();
    write_json(folder.path(), "0_00002", &bent);
    let scene = Scene::open(folder.path()).unwrap();
    let undone: Vec<_> = scene.undistorted.iter().map(Option::is_some).collect();
    assert_eq!(undone, [false, true, false, false, false]);
    let camera = &scene.frames[1].view.camera;
    assert!((camera.fy / camera.fx - 1.05).abs() < 1e-12);
    let options = LoadOptions {
        refuse_distortion: true,
        ..LoadOptions::default()
    };
    let error = Scene::open_with(folder.path(), &options).unwrap_err();
    assert!(matches!(error, IoError::Distortion { .. }), "{error}");
    assert!(
        error.to_string().ends_with("camera/0_00002.json"),
        "{error}"
    );
}

/// What Shape-of-Motion's authors publish for these scenes: refined cameras, aligned depth, masks, tracks.
#[test]
fn refined_cameras_masks_and_tracks_are_taken_where_they_are() {
    let folder = sample();
    let root = folder.path();
    let pre = root.join("flow3d_preprocessed");
    let training = ["0_00000", "0_00002", "0_00004"];
    let all = ["0_00000", "0_00002", "0_00004", "1_00000", "1_00003"];
    for name in training {
        make::picture(
            &pre.join(format!("track_anything/2x/{name}.png")),
            (WIDTH, HEIGHT),
            |x, _| 255 * u8::from(x < 5),
        );
        let array = npy(&[HEIGHT, WIDTH], &[0.25; WIDTH * HEIGHT]);
        make::write(
            &pre.join(format!("aligned_depth_anything_colmap/2x/{name}.npy")),
            array,
        );
        for target in training {
            let file = pre.join(format!("2d_tracks/2x/{name}_{target}.npy"));
            make::write(&file, npy(&[1, 4], &[3.0, 4.0, -5.0, -5.0]));
        }
    }
    let files: Vec<_> = all.iter().map(|name| format!("{name}.png")).collect();
    colmap_binary(&pre.join("colmap/sparse"), &files, make::PINHOLE);

    let scene = Scene::open(root).unwrap();
    assert_eq!(names(&scene), training);
    let (rotation, translation) = make::pose(1);
    let pose = scene.frames[1].view.cam_from_world;
    assert!(pose.matrix3.abs_diff_eq(DMat3::from_quat(rotation), 1e-12));
    assert!((pose.translation - translation).length() < 1e-12);
    assert_eq!(
        scene.frames[0].depth.as_ref().unwrap().values[0],
        4.0,
        "disparity"
    );
    assert_eq!(
        scene.frames[0].mask.as_ref().unwrap().values[..6],
        [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]
    );
    let tracks = scene.tracks.as_ref().unwrap();
    assert_eq!(tracks.queries.len(), FRAMES);
    let first = tracks.queries[0].samples[0];
    assert_eq!((first.x, first.y), (3.5, 4.5));
    assert_eq!(scene.points.len(), make::POINTS.len());
    assert!(
        scene.notes.iter().any(|n| n.contains("refined")),
        "{:?}",
        scene.notes
    );

    let files: Vec<_> = files.into_iter().filter(|f| f != "1_00003.png").collect();
    colmap_binary(&pre.join("colmap/sparse"), &files, make::PINHOLE);
    let error = Scene::open(root).unwrap_err().to_string();
    assert!(
        error.contains("1_00003") && error.contains("images.bin"),
        "{error}"
    );
}

#[test]
fn what_is_wrong_with_a_scene_of_dycheck_is_named() {
    type Damage = fn(&Path);
    let cases: [(Damage, &[&str]); 8] = [
        (
            |r| fs::remove_file(r.join("camera/0_00002.json")).unwrap(),
            &["camera/0_00002.json"],
        ),
        (
            |r| fs::remove_file(r.join("rgb/2x/0_00002.png")).unwrap(),
            &["rgb/2x/0_00002.png"],
        ),
        (
            |r| fs::remove_file(r.join("depth/2x/0_00002.npy")).unwrap(),
            &["depth", "0_00002"],
        ),
        (
            |r| {
                let mut bad = camera(0, 2);
                bad["orientation"] = json!([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
                write_json(r, "0_00002", &bad);
            },
            &["orientation is no rotation", "camera/0_00002.json"],
        ),
        (
            |r| {
                let mut bad = camera(0, 2);
                bad["skew"] = 0.5.into();
                write_json(r, "0_00002", &bad);
            },
            &["skew 0.5", "camera/0_00002.json"],
        ),
        (
            |r| {
                let text = json!({ "frame_names": ["0_00000"], "time_ids": [0, 1] }).to_string();
                make::write(&r.join("splits/train.json"), text);
            },
            &["1 frame_names and 2 time_ids", "splits/train.json"],
        ),
        (
            |r| {
                let text = json!({ "frame_names": ["0_00000", "0_00002"], "time_ids": [1, 1] });
                make::write(&r.join("splits/train.json"), text.to_string());
            },
            &["0_00000 and 0_00002", "same time"],
        ),
        (
            |r| {
                let text = json!({ "frame_names": [], "time_ids": [] }).to_string();
                make::write(&r.join("splits/train.json"), text);
            },
            &["training frames", "splits/train.json"],
        ),
    ];
    for (damage, told) in cases {
        let folder = sample();
        damage(folder.path());
        let error = Scene::open(folder.path()).unwrap_err().to_string();
        for part in told {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}
