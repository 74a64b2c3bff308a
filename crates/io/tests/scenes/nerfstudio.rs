//! nerfstudio's transforms.json.

use std::fs;
use std::path::Path;

use glam::{DVec2, DVec3};
use io::{IoError, LoadOptions, Scene};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::make::{self, HEIGHT, WIDTH, npy};

/// Frames f0.png to f3.png at OpenGL positions (i, 0, 0), looking along -z.
fn frames(count: usize) -> Vec<Value> {
    let frame = |i: usize| {
        json!({
            "file_path": format!("images/f{i}.png"),
            "transform_matrix": [[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        })
    };
    (0..count).map(frame).collect()
}

/// A folder with four pictures and this transforms.json over the intrinsics.
fn folder(change: impl FnOnce(&mut Value)) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for i in 0..4 {
        make::ramp(&folder.path().join(format!("images/f{i}.png")), i);
    }
    rewrite(folder.path(), change);
    folder
}

fn rewrite(root: &Path, change: impl FnOnce(&mut Value)) {
    let mut transforms = json!({
        "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "w": WIDTH, "h": HEIGHT,
        "frames": frames(4),
    });
    change(&mut transforms);
    make::write(&root.join("transforms.json"), transforms.to_string());
}

fn open(change: impl FnOnce(&mut Value)) -> Result<Scene, IoError> {
    Scene::open(folder(change).path())
}

fn names(scene: &Scene) -> (Vec<&str>, Vec<&str>) {
    let training = scene.frames.iter().map(|f| f.view.name.as_str()).collect();
    (
        training,
        scene.test.iter().map(|v| v.name.as_str()).collect(),
    )
}

#[test]
fn axes_are_converted() {
    // A camera at (1, 2, 3) turned by 90° about y: it looks along OpenGL's -z, which is the world's -x.
    let scene = open(|t| {
        t["frames"][0]["transform_matrix"] =
            json!([[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]);
    })
    .unwrap();
    assert_eq!(scene.layout, "nerfstudio");
    let see = |point: DVec3| {
        let view = &scene.frames[0].view;
        let in_cam = view.cam_from_world.transform_point3(point);
        (view.camera.project(in_cam), in_cam.z)
    };
    let near = |a: (DVec2, f64), x: f64, y: f64, z: f64| {
        assert!(
            (a.0 - DVec2::new(x, y)).length() < 1e-9 && (a.1 - z).abs() < 1e-9,
            "{a:?}"
        );
    };
    near(see(DVec3::new(-4.0, 2.0, 3.0)), 8.0, 6.0, 5.0);
    // Up in the world is up in the picture; the camera's right is the world's -z.
    near(see(DVec3::new(-4.0, 3.0, 3.0)), 8.0, 6.0 - 4.0, 5.0);
    near(see(DVec3::new(-4.0, 2.0, 2.0)), 8.0 + 4.0, 6.0, 5.0);
    let rotation = scene.frames[0].view.cam_from_world.matrix3;
    assert!((rotation.determinant() - 1.0).abs() < 1e-12);
}

#[test]
fn split_by_frame_or_by_lists() {
    let (all, none) = (vec!["f0", "f1", "f2", "f3"], Vec::<&str>::new());
    assert_eq!(
        names(&open(|_| ()).unwrap()),
        (all, none),
        "no split: all is for training"
    );
    let by_frame = open(|t| t["frames"][1]["split"] = "test".into()).unwrap();
    assert_eq!(names(&by_frame), (vec!["f0", "f2", "f3"], vec!["f1"]));
    let lists = |train: &[&str], test: Option<&[&str]>| {
        open(|t| {
            t["train_filenames"] = json!(train);
            if let Some(test) = test {
                t["test_filenames"] = json!(test);
            }
        })
    };
    let scene = lists(
        &["images/f2.png", "images/f0.png"],
        Some(&["images/f3.png"]),
    )
    .unwrap();
    assert_eq!(names(&scene), (vec!["f0", "f2"], vec!["f3"]));
    assert!(
        scene
            .notes
            .iter()
            .any(|n| n.contains("1 frames are neither")),
        "{:?}",
        scene.notes
    );
    let scene = lists(&["images/f2.png"], None).unwrap();
    assert_eq!(names(&scene), (vec!["f2"], vec!["f0", "f1", "f3"]));

    let named = |result: Result<Scene, IoError>, name: &str| {
        let text = result.unwrap_err().to_string();
        assert!(
            text.contains(name) && text.contains("transforms.json"),
            "{text}"
        );
    };
    named(lists(&["images/f9.png"], None), "f9");
    named(lists(&["images/f1.png"], Some(&["images/f1.png"])), "f1");
    named(lists(&[], Some(&["images/f1.png"])), "training");
    named(open(|t| t["frames"][3]["split"] = "tset".into()), "f3");
    let contradiction = open(|t| {
        t["frames"][0]["split"] = "test".into();
        t["train_filenames"] = json!(["images/f0.png"]);
        t["test_filenames"] = json!(["images/f1.png"]);
    });
    named(contradiction, "f0");
}

#[test]
fn times_are_in_training_frames() {
    let scene = open(|t| {
        for (i, time) in [0.9, 0.1, 0.5, 0.3].into_iter().enumerate() {
            t["frames"][i]["time"] = time.into();
        }
        t["frames"][3]["split"] = "test".into();
    })
    .unwrap();
    assert_eq!(names(&scene).0, ["f1", "f2", "f0"], "in the order of time");
    let times: Vec<_> = scene.frames.iter().map(|f| f.view.time).collect();
    assert_eq!(times, [0.0, 1.0, 2.0]);
    assert!(
        (scene.test[0].time - 0.5).abs() < 1e-6,
        "half-way from 0.1 to 0.5"
    );

    // Without time: between its neighbours in the order of names.
    let scene = open(|t| t["frames"][2]["split"] = "test".into()).unwrap();
    assert_eq!((scene.test[0].time, scene.frames[2].view.time), (1.5, 2.0));
    assert!(
        open(|t| t["frames"][2]["time"] = 0.5.into()).is_err(),
        "only one has a time"
    );
    let twice = |t: &mut Value| {
        for (i, time) in [0.1, 0.2, 0.2, 0.3].into_iter().enumerate() {
            t["frames"][i]["time"] = time.into();
        }
    };
    let text = open(twice).unwrap_err().to_string();
    assert!(text.contains("f1") && text.contains("f2"), "{text}");
    let same = open(|t| (0..4).for_each(|i| t["frames"][i]["time"] = 0.0.into())).unwrap();
    assert_eq!(names(&same).0, ["f0", "f1", "f2", "f3"]);
}

#[test]
fn frames_are_in_the_order_of_their_numbers() {
    let folder = folder(|_| ());
    fs::rename(
        folder.path().join("images/f1.png"),
        folder.path().join("images/f10.png"),
    )
    .unwrap();
    rewrite(folder.path(), |t| {
        t["frames"][1]["file_path"] = "images/f10.png".into();
    });
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(names(&scene).0, ["f0", "f2", "f3", "f10"]);
}

#[test]
fn intrinsics_of_a_frame_win() {
    let scene = open(|t| {
        t["frames"][1]["fl_x"] = 30.0.into();
        t["frames"][1]["cx"] = 7.0.into();
    })
    .unwrap();
    let camera = |i: usize| &scene.frames[i].view.camera;
    assert_eq!((camera(0).fx, camera(0).cx), (20.0, 8.0));
    assert_eq!(
        (camera(1).fx, camera(1).fy, camera(1).cx),
        (30.0, 20.0, 7.0)
    );

    let few = open(|t| {
        let t = t.as_object_mut().unwrap();
        for key in ["fl_x", "fl_y", "cx", "cy", "w", "h"] {
            t.remove(key);
        }
        t.insert("camera_angle_x".into(), (2.0 * 0.4f64.atan()).into());
    })
    .unwrap();
    let camera = &few.frames[0].view.camera;
    assert!((camera.fx - 20.0).abs() < 1e-9 && camera.fx == camera.fy);
    assert_eq!((camera.cx, camera.cy), (8.0, 6.0));
    assert!(
        open(|t| t["fl_x"] = Value::Null).is_err(),
        "no focal length"
    );
}

#[test]
fn numbers_that_are_none_are_named() {
    let folder = folder(|_| ());
    let path = folder.path().join("transforms.json");
    let good = fs::read_to_string(&path).unwrap();
    for (from, to, told) in [
        (
            "\"fl_x\":20.0",
            "\"fl_x\":NaN",
            ["`fl_x`", "NaN is no number in JSON"],
        ),
        (
            "\"fl_x\":20.0",
            "\"fl_x\":\"20\"",
            ["`fl_x` of images/f0.png", "not a number"],
        ),
        (
            "[[1,0,0,3]",
            "[[1,0,0,-Infinity]",
            ["`frames[3].transform_matrix[0][3]`", "-Infinity is no"],
        ),
        (
            "[[1,0,0,3]",
            "[[1,0,0,null]",
            ["`frames[3].transform_matrix[0][3]`", "invalid type: null"],
        ),
    ] {
        assert!(good.contains(from), "{good}");
        fs::write(&path, good.replacen(from, to, 1)).unwrap();
        let text = Scene::open(folder.path()).unwrap_err().to_string();
        for part in told.into_iter().chain(["transforms.json"]) {
            assert!(text.contains(part), "{to}: {text}");
        }
    }
    fs::write(&path, good.replacen("\"fl_x\":20.0", "\"fl_x\":0", 1)).unwrap();
    let text = Scene::open(folder.path()).unwrap_err().to_string();
    assert!(
        text.contains("images/f0.png: focal length 0 is not over zero"),
        "{text}"
    );
}

#[test]
fn pictures_without_a_camera_size_have_that_of_the_turned_ones() {
    let folder = folder(|t| {
        t.as_object_mut()
            .unwrap()
            .retain(|key, _| key != "w" && key != "h");
        t.as_object_mut()
            .unwrap()
            .retain(|key, _| key != "cx" && key != "cy");
    });
    for i in 0..4 {
        make::exif_picture(
            &folder.path().join(format!("images/f{i}.png")),
            (HEIGHT, WIDTH),
            6,
        );
    }
    let scene = Scene::open(folder.path()).unwrap();
    let view = &scene.frames[0].view;
    assert_eq!((view.camera.width, view.camera.height), (WIDTH, HEIGHT));
    assert_eq!((view.image.width, view.image.height), (WIDTH, HEIGHT));
    assert_eq!(view.camera.cx, WIDTH as f64 / 2.0);
}

#[test]
fn distortion_of_each_coefficient_is_undone_and_said() {
    let said = |scene: &Scene| {
        let mut notes = scene.notes.iter();
        notes.find(|n| n.contains("lens distortion")).cloned()
    };
    for key in ["k1", "k2", "k3", "k4", "p1", "p2"] {
        let scene = open(|t| t[key] = 0.0.into()).unwrap();
        assert_eq!(said(&scene), None, "{key}");
        assert!(scene.undistorted.is_empty());
        let scene = open(|t| t[key] = 0.05.into()).unwrap();
        assert!(said(&scene).is_some(), "{key}: {:?}", scene.notes);
    }
    let scene = open(|t| t["k1"] = 0.08.into()).unwrap();
    assert!(said(&scene).unwrap().contains("up to 0.20 px"));
    let scene = open(|t| t["frames"][2]["k1"] = 0.08.into()).unwrap();
    assert!(
        said(&scene).unwrap().starts_with("1 of 4 pictures"),
        "{:?}",
        scene.notes
    );
    let scene = open(|t| t["camera_model"] = "OPENCV_FISHEYE".into()).unwrap();
    assert!(said(&scene).unwrap().contains("(OPENCV_FISHEYE)"));
    let error = open(|t| t["camera_model"] = "EQUIRECTANGULAR".into()).unwrap_err();
    assert!(error.to_string().contains("EQUIRECTANGULAR"), "{error}");
}

fn depth_png(path: &Path, size: (usize, usize), value: impl Fn(usize) -> u16) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let (w, h) = (size.0 as u32, size.1 as u32);
    image::ImageBuffer::from_fn(w, h, |x, _| image::Luma([value(x as usize)]))
        .save(path)
        .unwrap();
}

#[test]
fn depth_in_millimetres() {
    let with_depth = |ending: &str| {
        let folder = folder(|t| {
            for i in 0..4 {
                t["frames"][i]["depth_file_path"] = format!("depth/f{i}.{ending}").into();
            }
        });
        for i in 0..4 {
            let path = folder.path().join(format!("depth/f{i}.{ending}"));
            if ending == "npy" {
                make::write(&path, npy(&[HEIGHT, WIDTH], &[1500.0; WIDTH * HEIGHT]));
            } else {
                depth_png(&path, (WIDTH, HEIGHT), |x| 250 * x as u16);
            }
        }
        folder
    };
    let scene = Scene::open(with_depth("png").path()).unwrap();
    let depth = scene.frames[2].depth.as_ref().unwrap();
    assert_eq!(depth.values[..4], [0.0, 0.25, 0.5, 0.75], "0 is missing");
    let scene = Scene::open(with_depth("npy").path()).unwrap();
    assert_eq!(
        scene.frames[0].depth.as_ref().unwrap().values,
        [1.5; WIDTH * HEIGHT]
    );

    // A sensor's own size is brought to the picture's, with a note; another shape is an error.
    let folder = with_depth("png");
    let file = folder.path().join("depth/f1.png");
    depth_png(&file, (WIDTH / 2, HEIGHT / 2), |x| 1000 * x as u16);
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(
        scene.frames[1].depth.as_ref().unwrap().values[..5],
        [0.0, 0.0, 1.0, 1.0, 2.0]
    );
    assert!(
        scene.notes.iter().any(|n| n.contains("depth was resized")),
        "{:?}",
        scene.notes
    );
    depth_png(&file, (WIDTH / 2, HEIGHT), |_| 1);
    assert!(matches!(
        Scene::open(folder.path()),
        Err(IoError::Size { .. })
    ));
    make::picture(&file, (WIDTH, HEIGHT), |_, _| 100);
    let text = Scene::open(folder.path()).unwrap_err().to_string();
    assert!(text.contains("16-bit") && text.contains("f1.png"), "{text}");

    let one = open(|t| t["frames"][2]["depth_file_path"] = "depth/f2.png".into());
    let text = one.unwrap_err().to_string();
    assert!(
        text.contains("the depth of f0, f1, f3") && text.contains("transforms.json"),
        "{text}"
    );
    let metres = with_depth("npy");
    let text = fs::read_to_string(metres.path().join("transforms.json")).unwrap();
    let text = text.replacen('{', "{\"depth_unit_scale_factor\": 1.0,", 1);
    fs::write(metres.path().join("transforms.json"), text).unwrap();
    let scene = Scene::open(metres.path()).unwrap();
    assert_eq!(scene.frames[0].depth.as_ref().unwrap().values[0], 1500.0);
}

#[test]
fn black_in_a_mask_is_what_moves() {
    let folder = folder(|t| {
        for i in 0..4 {
            t["frames"][i]["mask_path"] = format!("masks/f{i}.png").into();
        }
    });
    let root = folder.path();
    for i in 0..4 {
        let path = root.join(format!("masks/f{i}.png"));
        make::picture(&path, (WIDTH, HEIGHT), |x, _| 255 * u8::from(x > 2));
    }
    let error = Scene::open(root).unwrap_err();
    assert!(
        matches!(error, IoError::MasksWithoutTracks { .. }),
        "{error}"
    );
    let options = LoadOptions {
        static_scene: true,
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(root, &options).unwrap();
    assert!(scene.frames[0].mask.is_none());
    // A static scene reads no masks, so that some may be missing.
    let all = fs::read_to_string(root.join("transforms.json")).unwrap();
    let some = all.replacen("mask_path", "no_mask_path", 1);
    fs::write(root.join("transforms.json"), some).unwrap();
    let scene = Scene::open_with(root, &options).unwrap();
    assert!(scene.frames.iter().all(|f| f.mask.is_none()));
    let text = Scene::open(root).unwrap_err().to_string();
    assert!(text.contains("the mask of f0"), "{text}");
    fs::write(root.join("transforms.json"), all).unwrap();

    for q in 0..4 {
        for t in 0..4 {
            let path = root.join(format!("flow3d_preprocessed/2d_tracks/f{q}_f{t}.npy"));
            make::write(&path, npy(&[1, 4], &[q as f32, t as f32, -5.0, -5.0]));
        }
    }
    let scene = Scene::open(root).unwrap();
    assert_eq!(
        scene.frames[3].mask.as_ref().unwrap().values[1..5],
        [1.0, 1.0, 0.0, 0.0]
    );
    let tracks = scene.tracks.unwrap();
    assert_eq!(tracks.num_tracks(), 4);
    assert_eq!(
        (
            tracks.queries[2].samples[3].x,
            tracks.queries[2].samples[3].y
        ),
        (2.5, 3.5)
    );
}

#[test]
fn points_of_a_ply() {
    let folder = folder(|t| t["ply_file_path"] = "sparse.ply".into());
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
               property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
               end_header\n1 2 3 255 0 51\n4 5 6 0 0 0\n";
    make::write(&folder.path().join("sparse.ply"), ply);
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(scene.points[0].position, DVec3::new(1.0, 2.0, 3.0));
    assert_eq!(scene.points[0].color, [1.0, 0.0, 0.2]);
    assert_eq!(scene.points.len(), 2);
}

#[test]
fn frames_from_another_folder() {
    let folder = folder(|t| t["frames"][1]["split"] = "test".into());
    for i in 0..4 {
        make::ramp(&folder.path().join(format!("sharp/f{i}.png")), i + 10);
    }
    let options = LoadOptions {
        images: Some("sharp".into()),
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(folder.path(), &options).unwrap();
    assert_eq!(scene.frames[1].view.image.pixels[2], 120.0 / 255.0);
    assert_eq!(scene.test[0].image.pixels[2], 10.0 / 255.0);
}

#[test]
fn broken_poses_are_named() {
    for matrix in [
        json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        json!([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]),
        json!([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.5, 1]]),
        json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]),
        json!([]),
    ] {
        let text = open(|t| t["frames"][2]["transform_matrix"] = matrix.clone())
            .unwrap_err()
            .to_string();
        assert!(
            text.contains("f2") && text.contains("transforms.json"),
            "{matrix}: {text}"
        );
    }
    let text = open(|t| t["frames"][2]["file_path"] = "images/f8.png".into()).unwrap_err();
    assert!(text.to_string().contains("f8.png"), "{text}");
    assert!(open(|t| t["frames"] = json!([])).is_err());
    assert!(open(|t| t["w"] = (-3).into()).is_err());
    assert!(open(|t| t["frames"][1]["file_path"] = "images/f0.png".into()).is_err());
}
