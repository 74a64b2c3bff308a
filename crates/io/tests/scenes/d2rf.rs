//! D2RF's defocus data set, with samples written as its authors' `load_llff.py` and `eval.py` read them.

use std::fs;
use std::path::Path;

use io::{IoError, Scene};
use tempfile::TempDir;

use crate::make::{self, HEIGHT, WIDTH, colmap_binary, npy, poses_bounds, without_movers};

/// What a picture is filled with says which it is: the instant, the eye, and whether it is sharp.
fn blue(instant: usize, eye: &str, sharp: bool) -> usize {
    4 * instant + 2 * usize::from(eye == "right") + usize::from(sharp)
}

fn sample(instants: usize, sharp_ending: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    make::write(&root.join("poses_bounds.npy"), poses_bounds(2 * instants));
    for instant in 0..instants {
        for eye in ["left", "right"] {
            let stem = format!("{instant:06}_{eye}");
            let bokeh = root.join(format!("images_bokeh/{stem}.png"));
            make::ramp(&bokeh, blue(instant, eye, false));
            let sharp = root.join(format!("images/{stem}.{sharp_ending}"));
            make::ramp(&sharp, blue(instant, eye, true));
            // What their loader makes on the way: half the size, in the place of nothing.
            let half = root.join(format!("images_2/{stem}.png"));
            make::picture(&half, (WIDTH / 2, HEIGHT / 2), |_, _| 9);
            let mask = root.join(format!("motion_masks/{stem}.png"));
            make::picture(&mask, (WIDTH, HEIGHT), |x, _| {
                let edge = if eye == "left" { 5 } else { 4 };
                255 * u8::from(x < edge)
            });
            let background = root.join(format!("background_mask/{stem}.png"));
            make::picture(&background, (WIDTH, HEIGHT), |x, _| 255 * u8::from(x > 9));
            let disparity = npy(&[HEIGHT, WIDTH], &[321.0; WIDTH * HEIGHT]);
            make::write(&root.join(format!("dpt/{stem}.npy")), disparity);
        }
    }
    folder
}

/// The tracks and the depth that Shape-of-Motion's tools make of the left frames.
fn preprocess(root: &Path, instants: usize) {
    let pre = root.join("flow3d_preprocessed");
    let left = |instant| format!("{instant:06}_left");
    for query in 0..instants {
        let depth = pre.join(format!("aligned_depth_anything_colmap/{}.npy", left(query)));
        make::write(&depth, npy(&[HEIGHT, WIDTH], &[0.25; WIDTH * HEIGHT]));
        for target in 0..instants {
            let path = format!("2d_tracks/{}_{}.npy", left(query), left(target));
            make::write(&pre.join(path), npy(&[1, 4], &[3.0, 4.0, -5.0, -5.0]));
        }
    }
}

/// The number that a picture was filled with, where JPEG may have rounded it.
fn filling(pixels: &[f32]) -> usize {
    let blues = pixels.iter().skip(2).step_by(3);
    let mean = blues.sum::<f32>() / (pixels.len() / 3) as f32;
    (25.5 * mean).round() as usize
}

#[test]
fn left_cameras_see_the_frames_and_right_ones_the_sharp_test_views() {
    for (instants, ending) in [(1, "png"), (2, "jpg"), (5, "jpg"), (6, "png")] {
        let folder = sample(instants, ending);
        let scene = without_movers(folder.path()).unwrap();
        assert_eq!((scene.layout, scene.frames.len()), ("D2RF", instants));
        assert_eq!(scene.test.len(), instants);
        let truth = scene.truth().unwrap();
        let sharp = truth.sharp.unwrap();
        for i in 0..instants {
            let (frame, test) = (&scene.frames[i].view, &scene.test[i]);
            assert_eq!(filling(&frame.image.pixels), blue(i, "left", false));
            assert_eq!(filling(&test.image.pixels), blue(i, "right", true));
            assert_eq!(filling(&sharp[i].pixels), blue(i, "left", true));
            for (side, view) in [frame, test].into_iter().enumerate() {
                make::assert_stereo_camera(view, 2 * i + side);
            }
        }
        for part in ["dpt/ is not read", "picture's middle"] {
            let told = scene.notes.iter().any(|n| n.contains(part));
            assert!(told, "{part}: {:?}", scene.notes);
        }
    }
}

#[test]
fn movers_need_what_is_not_published() {
    let folder = sample(3, "jpg");
    let error = Scene::open(folder.path()).unwrap_err();
    assert!(
        matches!(error, IoError::MasksWithoutTracks { .. }),
        "{error}"
    );
    assert!(error.to_string().contains("motion_masks"), "{error}");

    // With a COLMAP model in it, it could be taken for Shape-of-Motion's, whose images/ are blurry.
    preprocess(folder.path(), 3);
    let names: Vec<_> = (0..3).map(|i| format!("{i:06}_left.png")).collect();
    let model = folder.path().join("flow3d_preprocessed/colmap/sparse");
    colmap_binary(&model, &names, make::PINHOLE);
    colmap_binary(&folder.path().join("sparse/0"), &names, make::PINHOLE);
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(scene.layout, "D2RF");
    assert_eq!(scene.tracks.as_ref().unwrap().num_tracks(), 3);
    let frame = &scene.frames[1];
    assert_eq!(frame.depth.as_ref().unwrap().values[..2], [4.0, 4.0]);
    let mask = &frame.mask.as_ref().unwrap().values;
    assert_eq!(mask[3..6], [1.0, 1.0, 0.0], "the left camera's");
    assert_eq!(scene.points.len(), make::POINTS.len());
}

#[test]
fn what_is_wrong_with_a_defocus_scene_is_named() {
    type Damage = fn(&Path);
    let cases: [(Damage, &[&str]); 6] = [
        (
            |r| fs::remove_file(r.join("images_bokeh/000001_left.png")).unwrap(),
            &["000001_right and 000002_left found", "images_bokeh"],
        ),
        (
            |r| fs::remove_file(r.join("images_bokeh/000002_right.png")).unwrap(),
            &["000002_left found", "images_bokeh"],
        ),
        (
            |r| make::write(&r.join("poses_bounds.npy"), poses_bounds(4)),
            &["cameras of 2 instants, and 3 pictures", "poses_bounds.npy"],
        ),
        (
            |r| make::write(&r.join("poses_bounds.npy"), poses_bounds(8)),
            &["3 instants with pictures, and cameras of 4", "images_bokeh"],
        ),
        (
            |r| fs::remove_file(r.join("images/000001_right.jpg")).unwrap(),
            &["pictures of 000001_right", "images"],
        ),
        (
            |r| {
                fs::remove_dir_all(r.join("images_bokeh")).unwrap();
                fs::create_dir(r.join("images_bokeh")).unwrap();
            },
            &["missing frames", "images_bokeh"],
        ),
    ];
    for (damage, told) in cases {
        let folder = sample(3, "jpg");
        damage(folder.path());
        let error = without_movers(folder.path()).unwrap_err().to_string();
        for part in told {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
    // Sharp pictures of the left camera need not be there.
    let folder = sample(3, "jpg");
    fs::remove_file(folder.path().join("images/000001_left.jpg")).unwrap();
    let scene = without_movers(folder.path()).unwrap();
    let told = |n: &String| n.contains("images/ is not read as truth");
    assert!(scene.notes.iter().any(told), "{:?}", scene.notes);
    assert_eq!(scene.truth().unwrap().sharp, None);
    fs::remove_dir_all(folder.path().join("images")).unwrap();
    assert!(without_movers(folder.path()).unwrap().test.is_empty());
}
