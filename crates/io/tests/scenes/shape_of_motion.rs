//! The layout of Shape-of-Motion's users.

use std::fs;
use std::path::PathBuf;

use glam::DVec3;
use io::{IoError, LoadOptions, Scene};

use crate::make::{
    self, FOCAL, FRAMES, HEIGHT, PINHOLE, POINTS, Som, WIDTH, colmap_binary, colmap_text, names,
    npy,
};

fn downscaled(downscale: usize) -> LoadOptions {
    LoadOptions {
        downscale,
        ..LoadOptions::default()
    }
}

#[test]
fn everything_is_read() {
    let som = Som::new();
    let scene = Scene::open(som.root()).unwrap();
    assert_eq!(scene.layout, "Shape-of-Motion");
    assert_eq!((scene.frames.len(), scene.test.len()), (FRAMES, FRAMES));
    for (i, frame) in scene.frames.iter().enumerate() {
        let view = &frame.view;
        assert_eq!(
            (view.name.as_str(), view.time),
            (format!("{i:05}").as_str(), i as f32)
        );
        assert_eq!((view.camera.width, view.camera.height), (WIDTH, HEIGHT));
        assert_eq!(
            (view.camera.fx, view.camera.cx, view.camera.cy),
            (FOCAL, 8.0, 6.0)
        );
        // Pixel (x, y) = (3, 2) of the ramp.
        let at = (2 * WIDTH + 3) * 3;
        let want = [24.0 / 255.0, 16.0 / 255.0, 10.0 * i as f32 / 255.0];
        assert_eq!(view.image.pixels[at..at + 3], want);
        let depth = frame.depth.as_ref().unwrap();
        assert!((depth.values[7] - 1.0 / 0.17).abs() < 1e-5);
        let mask = frame.mask.as_ref().unwrap();
        assert_eq!(mask.values[3..7], [1.0, 1.0, 0.0, 0.0]);
    }
    for (i, view) in scene.test.iter().enumerate() {
        assert_eq!(view.time, i as f32, "a test view has its left frame's time");
        assert_eq!(view.image.pixels[2], 10.0 * (i + 10) as f32 / 255.0);
        // The right camera is 0.3 to the side of the left one, in the world.
        let center = |v: &io::View| splat_core::camera_center(&v.cam_from_world);
        let apart = center(view) - center(&scene.frames[i].view);
        assert!(
            (apart - DVec3::new(0.3, 0.0, 0.0)).length() < 1e-12,
            "{apart}"
        );
    }
    assert_eq!(scene.points.len(), POINTS.len());
    assert_eq!(scene.points[1].position, DVec3::from_array(POINTS[1]));
    assert_eq!(scene.points[0].color, [1.0, 0.0, 0.2]);

    let tracks = scene.tracks.unwrap();
    assert_eq!(
        (tracks.num_frames, tracks.num_tracks()),
        (FRAMES, 1 + 2 + 3)
    );
    let query = &tracks.queries[2];
    assert_eq!((query.frame, query.samples.len()), (2, 3 * FRAMES));
    let sample = query.samples[FRAMES + 2]; // point 1 in frame 2
    assert_eq!((sample.x, sample.y), (3.5, 2.5), "half a pixel was added");
    assert_eq!((sample.occlusion, sample.expected_distance), (-5.0, -4.0));
}

#[test]
fn text_model_and_sub_folder_give_the_same_scene() {
    let som = Som::new();
    let binary = Scene::open(som.root()).unwrap();
    som.remove("flow3d_preprocessed/colmap");
    colmap_text(
        &som.path("flow3d_preprocessed/colmap/sparse/0"),
        &names(2 * FRAMES),
    );
    let text = Scene::open(som.root()).unwrap();
    assert_eq!(text.points, binary.points);
    let poses = |s: &Scene| -> Vec<_> {
        let views = s.frames.iter().map(|f| &f.view).chain(&s.test);
        views.map(|v| v.cam_from_world).collect()
    };
    for (a, b) in poses(&text).iter().zip(poses(&binary)) {
        assert!(a.abs_diff_eq(b, 1e-12), "{a:?} is not {b:?}");
    }
}

#[test]
fn packed_tracks_are_the_same_tracks() {
    let som = Som::new();
    let files = Scene::open(som.root()).unwrap();
    som.pack_tracks();
    let packed = Scene::open(som.root()).unwrap();
    assert!(packed.tracks.is_some());
    assert_eq!(files.tracks, packed.tracks);
}

#[test]
fn plain_names_have_no_test_views() {
    let som = Som::new();
    colmap_binary(
        &som.path("flow3d_preprocessed/colmap/sparse"),
        &names(FRAMES),
        PINHOLE,
    );
    let scene = Scene::open(som.root()).unwrap();
    assert_eq!((scene.frames.len(), scene.test.len()), (FRAMES, 0));
    let (quat, _) = make::pose(1);
    let rotation = glam::DMat3::from_quat(quat);
    assert!(
        scene.frames[1]
            .view
            .cam_from_world
            .matrix3
            .abs_diff_eq(rotation, 1e-12)
    );
    assert!(
        scene
            .notes
            .iter()
            .any(|n| n.contains("images_test/ is ignored")),
        "{:?}",
        scene.notes
    );
}

#[test]
fn everything_is_halved() {
    let som = Som::new();
    let whole = Scene::open(som.root()).unwrap();
    let half = Scene::open_with(som.root(), &downscaled(2)).unwrap();
    assert_eq!(half.downscale, 2);
    let (a, b) = (&whole.frames[1], &half.frames[1]);
    assert_eq!(
        (b.view.image.width, b.view.camera.height),
        (WIDTH / 2, HEIGHT / 2)
    );
    let point = DVec3::new(0.2, 0.1, 3.0);
    assert_eq!(
        a.view.camera.project(point),
        b.view.camera.project(point) * 2.0
    );
    // The ramp is 8 x: over columns 6 and 7 it is 52.
    assert!((b.view.image.pixels[3 * 3] - 52.0 / 255.0).abs() < 1e-6);
    // Disparity 0.1 + 0.01 i over pixels 0, 1, 16, 17.
    let z = b.depth.as_ref().unwrap().values[0];
    assert!((z - 1.0 / (0.1 + 0.01 * 8.5)).abs() < 1e-5, "{z}");
    // Columns 4 (in) and 5 (out) share a pixel.
    assert_eq!(b.mask.as_ref().unwrap().values[1..4], [1.0, 0.5, 0.0]);
    let (a, b) = (whole.tracks.unwrap(), half.tracks.unwrap());
    for (p, q) in a.queries[1].samples.iter().zip(&b.queries[1].samples) {
        assert_eq!((p.x / 2.0, p.y / 2.0, p.occlusion), (q.x, q.y, q.occlusion));
    }

    let odd = Scene::open_with(som.root(), &downscaled(5)).unwrap();
    assert_eq!((odd.test[0].image.width, odd.test[0].image.height), (3, 2));
    assert!(
        odd.notes.iter().any(|n| n.contains("cropped to 15x10")),
        "{:?}",
        odd.notes
    );
    for bad in [0, 13] {
        let error = Scene::open_with(som.root(), &downscaled(bad)).unwrap_err();
        assert!(matches!(error, IoError::Invalid { .. }), "{error}");
    }
}

#[test]
fn truth_is_read_at_the_same_size() {
    let som = Som::new();
    let scene = Scene::open_with(som.root(), &downscaled(2)).unwrap();
    let truth = scene.truth().unwrap();
    let sharp = truth.sharp.unwrap();
    assert_eq!((sharp.len(), sharp[0].width), (FRAMES, WIDTH / 2));
    assert_eq!(sharp[1].pixels[2], 210.0 / 255.0);
    assert_eq!(
        truth.covisible.unwrap()[0].values,
        [1.0; WIDTH * HEIGHT / 4]
    );
    assert_eq!(truth.masks_test.unwrap()[2].values[1..3], [1.0, 0.0]);

    som.remove("truth/covisible");
    som.remove("truth/images_sharp/00001.png");
    let error = scene.truth().unwrap_err().to_string();
    assert!(
        error.contains("00001") && error.contains("images_sharp"),
        "{error}"
    );
    som.remove("truth/images_sharp");
    let truth = scene.truth().unwrap();
    assert!(truth.sharp.is_none() && truth.covisible.is_none() && truth.masks_test.is_some());
    make::picture(
        &som.path("truth/masks_test/00000.png"),
        (WIDTH + 2, HEIGHT),
        |_, _| 0,
    );
    assert!(matches!(scene.truth(), Err(IoError::Size { .. })));
}

#[test]
fn test_views_have_sizes_of_their_own() {
    let som = Som::new();
    let double = |file: &str, value: fn(usize, usize) -> u8| {
        make::picture(&som.path(file), (2 * WIDTH, 2 * HEIGHT), value);
    };
    double("images_test/00001.png", |x, _| x as u8);
    double("truth/covisible/00001.png", |_, _| 255);
    double("truth/masks_test/00001.png", |x, _| 255 * u8::from(x < 8));
    for downscale in [1, 2, 5] {
        let scene = Scene::open_with(som.root(), &downscaled(downscale)).unwrap();
        let (large, small) = (&scene.test[1], &scene.test[0]);
        for (view, width, height) in [(large, 2 * WIDTH, 2 * HEIGHT), (small, WIDTH, HEIGHT)] {
            let size = (width / downscale, height / downscale);
            assert_eq!((view.image.width, view.image.height), size);
            assert_eq!((view.camera.width, view.camera.height), size);
        }
        // The model's camera is that of the smaller picture: the same rays, twice as many pixels.
        let point = DVec3::new(0.2, 0.1, 3.0);
        let (a, b) = (large.camera.project(point), small.camera.project(point));
        assert!((a - b * 2.0).length() < 1e-12, "{a} is not twice {b}");
        let truth = scene.truth().unwrap();
        let (seen, moving) = (truth.covisible.unwrap(), truth.masks_test.unwrap());
        assert_eq!(seen[1].values.len(), large.camera.num_pixels());
        assert_eq!(moving[1].width, large.camera.width);
        assert_eq!(moving[0].width, small.camera.width);
        let told = |part: &str| scene.notes.iter().any(|n| n.contains(part));
        assert!(told("intrinsics were scaled to the pictures' size 32x24"));
        assert_eq!(told("16x12 is no multiple of 5"), downscale == 5);
        assert_eq!(told("32x24 is no multiple of 5"), downscale == 5);
    }
    // The truth of a test view has that view's size, not the training frames'.
    let scene = Scene::open(som.root()).unwrap();
    let file = "truth/covisible/00001.png";
    make::picture(&som.path(file), (WIDTH, HEIGHT), |_, _| 255);
    let text = scene.truth().unwrap_err().to_string();
    assert!(text.contains("16x12, expected 32x24"), "{text}");
    // Its picture has its camera's proportions, whatever its size.
    let file = "images_test/00001.png";
    make::picture(&som.path(file), (2 * WIDTH, HEIGHT), |_, _| 255);
    let text = Scene::open(som.root()).unwrap_err().to_string();
    assert!(
        text.contains("aspect ratio") && text.contains(file),
        "{text}"
    );
}

#[test]
fn frames_from_another_folder() {
    let som = Som::new();
    let options = LoadOptions {
        images: Some(PathBuf::from("truth/images_sharp")),
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(som.root(), &options).unwrap();
    assert_eq!(scene.frames[2].view.image.pixels[2], 220.0 / 255.0);
    assert_eq!(
        scene.test[0].image.pixels[2],
        100.0 / 255.0,
        "test views stay"
    );
    som.remove("truth/images_sharp/00002.png");
    let error = Scene::open_with(som.root(), &options)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("00002") && error.contains("images_sharp"),
        "{error}"
    );
}

#[test]
fn optional_parts_may_be_missing() {
    let som = Som::new();
    som.remove("flow3d_preprocessed/aligned_depth_anything_colmap");
    som.remove("flow3d_preprocessed/colmap/sparse/points3D.bin");
    som.remove("images_test");
    let scene = Scene::open(som.root()).unwrap();
    assert!(scene.frames.iter().all(|f| f.depth.is_none()));
    assert!(scene.points.is_empty() && scene.test.is_empty());

    som.remove("flow3d_preprocessed/2d_tracks");
    let error = Scene::open(som.root()).unwrap_err();
    assert!(
        matches!(error, IoError::MasksWithoutTracks { .. }),
        "{error}"
    );
    let text = error.to_string();
    assert!(
        text.contains("masks") && text.contains("2d_tracks") && text.contains("--static"),
        "{text}"
    );
    // An empty folder of tracks is no tracks.
    fs::create_dir(som.path("flow3d_preprocessed/2d_tracks")).unwrap();
    assert!(matches!(
        Scene::open(som.root()),
        Err(IoError::MasksWithoutTracks { .. })
    ));

    let options = LoadOptions {
        static_scene: true,
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(som.root(), &options).unwrap();
    assert!(scene.tracks.is_none() && scene.frames.iter().all(|f| f.mask.is_none()));
    assert!(
        scene.notes.iter().any(|n| n.contains("are not read")),
        "{:?}",
        scene.notes
    );
    som.remove("masks");
    assert!(Scene::open(som.root()).unwrap().tracks.is_none());
}

#[test]
fn static_scene_drops_masks_and_tracks() {
    let som = Som::new();
    // Neither is read, so neither need be whole.
    som.remove("masks/00001.png");
    som.remove("flow3d_preprocessed/2d_tracks/00001_00002.npy");
    assert!(Scene::open(som.root()).is_err());
    let options = LoadOptions {
        static_scene: true,
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(som.root(), &options).unwrap();
    assert!(scene.tracks.is_none() && scene.frames.iter().all(|f| f.mask.is_none()));
}

#[test]
fn pictures_are_turned_by_exif_as_their_cameras_want_it() {
    // The cameras are for 16x12. Pictures that are so as stored stay, upright ones are turned; masks and truth go along.
    for (stored, turned) in [((WIDTH, HEIGHT), false), ((HEIGHT, WIDTH), true)] {
        let som = Som::new();
        for i in 0..FRAMES {
            for folder in ["images", "masks", "truth/images_sharp"] {
                make::exif_picture(&som.path(&format!("{folder}/{i:05}.png")), stored, 6);
            }
        }
        let scene = Scene::open(som.root()).unwrap();
        let grey = |at: usize| at as f32 / 255.0;
        let corner = grey(if turned { HEIGHT * (WIDTH - 1) } else { 0 });
        for (frame, sharp) in scene
            .frames
            .iter()
            .zip(scene.truth().unwrap().sharp.unwrap())
        {
            let image = &frame.view.image;
            assert_eq!((image.width, image.height), (WIDTH, HEIGHT));
            assert_eq!(image.pixels[0], corner);
            assert_eq!(image, &sharp);
            let mask = frame.mask.as_ref().unwrap();
            assert_eq!(mask.values[0], corner);
        }
        let told = |n: &&String| n.contains("EXIF");
        let notes: Vec<_> = scene.notes.iter().filter(told).collect();
        assert_eq!(notes.len(), 1, "{notes:?}");
        assert_eq!(notes[0].contains("are turned"), turned, "{notes:?}");
    }
}

#[test]
fn depth_without_a_value_is_missing() {
    let som = Som::new();
    let mut disparity = vec![0.5f32; WIDTH * HEIGHT];
    disparity[0] = 0.0;
    disparity[1] = -1.0;
    disparity[2] = f32::INFINITY;
    disparity[3] = 1e-44;
    let at = som.path("flow3d_preprocessed/aligned_depth_anything_colmap/00001.npy");
    make::write(&at, npy(&[HEIGHT, WIDTH], &disparity));
    let scene = Scene::open(som.root()).unwrap();
    let depth = scene.frames[1].depth.as_ref().unwrap();
    assert_eq!(depth.values[..5], [0.0, 0.0, 0.0, 0.0, 2.0]);
}

#[test]
fn intrinsics_follow_the_pictures_size() {
    let som = Som::new();
    // The model was made at twice the size.
    let cameras = som.path("flow3d_preprocessed/colmap/sparse");
    let mut data = fs::read(cameras.join("cameras.bin")).unwrap();
    data[16..24].copy_from_slice(&(2 * WIDTH as u64).to_le_bytes());
    data[24..32].copy_from_slice(&(2 * HEIGHT as u64).to_le_bytes());
    fs::write(cameras.join("cameras.bin"), &data).unwrap();
    let scene = Scene::open(som.root()).unwrap();
    assert_eq!(scene.frames[0].view.camera.fx, FOCAL / 2.0);
    assert_eq!(scene.test[0].camera.cx, 4.0);
    assert!(
        scene.notes.iter().any(|n| n.contains("intrinsics")),
        "{:?}",
        scene.notes
    );
    // Another aspect ratio cannot be the same picture.
    data[24..32].copy_from_slice(&(3 * HEIGHT as u64).to_le_bytes());
    fs::write(cameras.join("cameras.bin"), &data).unwrap();
    assert!(matches!(Scene::open(som.root()), Err(IoError::Size { .. })));
}

#[test]
fn distortion_is_measured_for_each_camera_model() {
    let som = Som::new();
    let sparse = som.path("flow3d_preprocessed/colmap/sparse");
    let open = |camera: (i32, &[f64])| {
        colmap_binary(&sparse, &names(2 * FRAMES), camera);
        let options = LoadOptions {
            refuse_distortion: true,
            ..LoadOptions::default()
        };
        Scene::open_with(som.root(), &options)
    };
    for zero in [
        (0, &[FOCAL, 8.0, 6.0][..]),
        (2, &[FOCAL, 8.0, 6.0, 0.0]),
        (3, &[FOCAL, 8.0, 6.0, 0.0, 0.0]),
        (4, &[FOCAL, FOCAL, 8.0, 6.0, 0.0, 0.0, 0.0, 0.0]),
        (
            6,
            &[
                FOCAL, FOCAL, 8.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            ],
        ),
    ] {
        open(zero).unwrap();
    }
    // The corner is at (0.4, 0.3), r = 0.5: k1 = 0.08 moves it by f k1 r³ = 0.2 px.
    for radial in [
        (2, &[FOCAL, 8.0, 6.0, 0.08][..]),
        (3, &[FOCAL, 8.0, 6.0, 0.08, 0.0]),
        (4, &[FOCAL, FOCAL, 8.0, 6.0, 0.08, 0.0, 0.0, 0.0]),
        (
            6,
            &[
                FOCAL, FOCAL, 8.0, 6.0, 0.08, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            ],
        ),
    ] {
        match open(radial) {
            Err(IoError::Distortion { pixels, .. }) => assert!((pixels - 0.2).abs() < 1e-9),
            other => panic!("{other:?}"),
        }
    }
    // A camera that no image has may be what it likes.
    colmap_binary(&sparse, &names(2 * FRAMES), PINHOLE);
    let cameras = sparse.join("cameras.bin");
    let mut bytes = fs::read(&cameras).unwrap();
    let mut unused = bytes[8..].to_vec();
    unused[..4].copy_from_slice(&77u32.to_le_bytes());
    unused[4..8].copy_from_slice(&2u32.to_le_bytes());
    bytes[..8].copy_from_slice(&2u64.to_le_bytes());
    fs::write(&cameras, [bytes, unused].concat()).unwrap();
    Scene::open(som.root()).unwrap();
    // A fisheye is none, whatever its coefficients: r = 0.5 goes to atan 0.5.
    match open((5, &[FOCAL, FOCAL, 8.0, 6.0, 0.0, 0.0, 0.0, 0.0])) {
        Err(IoError::Distortion { pixels, model, .. }) => {
            assert!((pixels - FOCAL * (0.5 - 0.5f64.atan())).abs() < 1e-9);
            assert_eq!(model, "OPENCV_FISHEYE");
        }
        other => panic!("{other:?}"),
    }
    assert!(matches!(
        open((10, &[1.0; 12])),
        Err(IoError::Malformed { .. })
    ));
}

#[test]
fn unknown_folders_say_what_was_looked_for() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("images")).unwrap();
    let error = Scene::open(folder.path()).unwrap_err();
    assert!(matches!(error, IoError::Unrecognised { .. }), "{error}");
    let text = error.to_string();
    for part in [
        "transforms.json (nerfstudio)",
        "images/ with flow3d_preprocessed/ (Shape-of-Motion)",
        "found only images/",
    ] {
        assert!(text.contains(part), "{text}");
    }
    fs::remove_dir(folder.path().join("images")).unwrap();
    let text = Scene::open(folder.path()).unwrap_err().to_string();
    assert!(text.contains("found nothing"), "{text}");
    let nowhere = folder.path().join("nowhere");
    assert!(
        Scene::open(&nowhere)
            .unwrap_err()
            .to_string()
            .contains("nowhere")
    );
}
