//! The stereo blur dataset of DyBluRF, and MoBGS's additions to it, with samples written as DyBluRF's
//! README lists it, as its `save_poses_nerf.py` writes poses, and as MoBGS's `readStereoCameras` reads them.

use std::path::Path;

use io::{IoError, Scene};
use tempfile::TempDir;

use crate::make::{
    self, FRAMES, HEIGHT, WIDTH, colmap_binary, names, npy, poses_bounds, without_movers,
};

/// DyBluRF's own files.
fn dyblurf() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    make::write(&root.join("poses_bounds.npy"), poses_bounds(2 * FRAMES));
    for (i, name) in names(FRAMES).iter().enumerate() {
        make::picture(
            &root.join("images").join(name),
            (2 * WIDTH, 2 * HEIGHT),
            |_, _| 9,
        );
        make::ramp(&root.join("images_512x288").join(name), i);
        make::ramp(&root.join("inference_images").join(name), i + 10);
        make::ramp(&root.join("sharp_images").join(name), i + 20);
        make::picture(
            &root.join("motion_masks").join(name),
            (2 * WIDTH, 2 * HEIGHT),
            |x, _| 255 * u8::from(x < 10),
        );
        let stem = name.trim_end_matches(".png");
        let disparity = npy(&[HEIGHT, WIDTH], &[321.0; WIDTH * HEIGHT]);
        make::write(&root.join(format!("disp/{stem}.npy")), disparity);
    }
    folder
}

/// The same with what MoBGS adds.
fn mobgs() -> TempDir {
    let folder = dyblurf();
    let root = folder.path();
    for (i, name) in names(FRAMES).iter().enumerate() {
        let stem = name.trim_end_matches(".png");
        let depth = npy(&[HEIGHT, WIDTH], &[2.0 + i as f32; WIDTH * HEIGHT]);
        make::write(
            &root.join(format!("align_uni_depth_noclip/{stem}.npy")),
            depth,
        );
        let path = root.join("motion_masks_manual").join(name);
        make::picture(&path, (WIDTH, HEIGHT), |x, _| 255 * u8::from(x < 3));
        for target in 0..FRAMES {
            let path = root.join(format!("bootstapir/{stem}_{target:05}.npy"));
            make::write(&path, npy(&[1, 4], &[3.0, 4.0, -5.0, -5.0]));
        }
    }
    make::write(
        &root.join("scene.json"),
        r#"{"scale": 1.0, "center": [0, 0, 0]}"#,
    );
    folder
}

#[test]
fn the_stereo_blur_dataset_is_read_as_its_authors_read_it() {
    let folder = dyblurf();
    let scene = without_movers(folder.path()).unwrap();
    assert_eq!((scene.layout, scene.frames.len()), ("DyBluRF", FRAMES));
    for (views, side) in [
        (scene.frames.iter().map(|f| &f.view).collect::<Vec<_>>(), 0),
        (scene.test.iter().collect(), 1),
    ] {
        for (i, view) in views.into_iter().enumerate() {
            make::assert_stereo_camera(view, 2 * i + side);
        }
    }
    assert_eq!(
        scene.test[1].image.pixels[2],
        110.0 / 255.0,
        "the right camera's own"
    );
    let sharp = scene.truth().unwrap().sharp.unwrap();
    assert_eq!(sharp[1].pixels[2], 210.0 / 255.0);
    assert!(scene.frames[0].depth.is_none() && scene.points.is_empty());
    for part in ["disp/ is not read", "picture's middle"] {
        let told = scene.notes.iter().any(|n| n.contains(part));
        assert!(told, "{part}: {:?}", scene.notes);
    }
    // It has masks of what moves and no tracks.
    let error = Scene::open(folder.path()).unwrap_err();
    assert!(
        matches!(error, IoError::MasksWithoutTracks { .. }),
        "{error}"
    );
    assert!(error.to_string().contains("motion_masks"), "{error}");

    colmap_binary(
        &folder.path().join("sparse"),
        &names(2 * FRAMES),
        make::PINHOLE,
    );
    let scene = without_movers(folder.path()).unwrap();
    assert_eq!(
        scene.points.len(),
        make::POINTS.len(),
        "points of its own model"
    );
    // Of which nothing else is used: its cameras may be of a kind that no reader of ours knows.
    colmap_binary(
        &folder.path().join("sparse"),
        &names(2 * FRAMES),
        (10, &[1.0; 12]),
    );
    let scene = without_movers(folder.path()).unwrap();
    assert_eq!(scene.points.len(), make::POINTS.len());
}

#[test]
fn what_mobgs_adds_is_read() {
    let folder = mobgs();
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(scene.layout, "DyBluRF");
    let frame = &scene.frames[1];
    assert_eq!(frame.depth.as_ref().unwrap().values, [3.0; WIDTH * HEIGHT]);
    assert_eq!(
        frame.mask.as_ref().unwrap().values[..4],
        [1.0, 1.0, 1.0, 0.0],
        "the manual ones"
    );
    let tracks = scene.tracks.as_ref().unwrap();
    assert_eq!(
        (tracks.num_tracks(), tracks.queries.len()),
        (FRAMES, FRAMES)
    );
    let first = tracks.queries[0].samples[0];
    assert_eq!((first.x, first.y), (3.5, 4.5));
}

#[test]
fn what_is_wrong_with_a_stereo_blur_scene_is_named() {
    type Damage = fn(&Path);
    let cases: [(Damage, &[&str]); 6] = [
        (
            |r| make::write(&r.join("poses_bounds.npy"), poses_bounds(2 * FRAMES - 2)),
            &["2 instants, and 3 pictures", "poses_bounds.npy"],
        ),
        (
            |r| make::write(&r.join("poses_bounds.npy"), poses_bounds(2 * FRAMES - 1)),
            &["5 cameras", "poses_bounds.npy"],
        ),
        (
            |r| make::write(&r.join("poses_bounds.npy"), npy(&[2, 15], &[0.0; 30])),
            &["[2, 15]", "poses_bounds.npy"],
        ),
        (
            |r| make::write(&r.join("poses_bounds.npy"), npy(&[6, 17], &[f32::NAN; 102])),
            &["row 0 has no rigid transform", "poses_bounds.npy"],
        ),
        (
            |r| {
                std::fs::remove_dir_all(r.join("images")).unwrap();
                std::fs::remove_dir_all(r.join("images_512x288")).unwrap();
            },
            &["images_512x288/ or images/"],
        ),
        (
            |r| std::fs::remove_file(r.join("align_uni_depth_noclip/00001.npy")).unwrap(),
            &["depth of 00001", "align_uni_depth_noclip"],
        ),
    ];
    for (damage, told) in cases {
        let folder = mobgs();
        damage(folder.path());
        let error = Scene::open(folder.path()).unwrap_err().to_string();
        for part in told {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
    // More cameras than frames, and truth of another size: said.
    let folder = mobgs();
    make::write(
        &folder.path().join("poses_bounds.npy"),
        poses_bounds(2 * FRAMES + 2),
    );
    make::picture(
        &folder.path().join("sharp_images/00001.png"),
        (8, 6),
        |_, _| 9,
    );
    let scene = Scene::open(folder.path()).unwrap();
    for part in ["4 instants for 3 frames", "sharp_images/ is not read"] {
        let told = scene.notes.iter().any(|n| n.contains(part));
        assert!(told, "{part}: {:?}", scene.notes);
    }
    assert_eq!(scene.truth().unwrap().sharp, None);
}
