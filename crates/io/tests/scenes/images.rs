//! Training frames from another folder, of another size than the scene's own pictures.

use std::fs;
use std::path::PathBuf;

use io::{LoadOptions, Scene, TrackSample};

use crate::make::{self, FRAMES, HEIGHT, Som, WIDTH};

/// The scene with frames of this size from another folder.
fn with_frames_of(som: &Som, size: (usize, usize), downscale: usize) -> Scene {
    for i in 0..FRAMES {
        let path = som.path(&format!("other/{i:05}.png"));
        make::picture(&path, size, |x, y| (x * y) as u8);
    }
    let options = LoadOptions {
        images: Some(PathBuf::from("other")),
        downscale,
        ..LoadOptions::default()
    };
    Scene::open_with(som.root(), &options).unwrap()
}

/// Where each sample of the tracks looks: the ray (u, v, 1) of its frame's camera.
fn rays(scene: &Scene) -> Vec<[f64; 2]> {
    let queries = &scene.tracks.as_ref().unwrap().queries;
    let samples = queries.iter().flat_map(|q| q.samples.iter().enumerate());
    let ray = |(at, sample): (usize, &TrackSample)| {
        let c = &scene.frames[at % FRAMES].view.camera;
        [
            (f64::from(sample.x) - c.cx) / c.fx,
            (f64::from(sample.y) - c.cy) / c.fy,
        ]
    };
    samples.map(ray).collect()
}

fn assert_same_rays(scene: &Scene, expected: &[[f64; 2]], what: &str) {
    let found = rays(scene);
    assert_eq!(found.len(), expected.len(), "{what}");
    for (found, expected) in found.iter().zip(expected) {
        let off = (found[0] - expected[0]).hypot(found[1] - expected[1]);
        assert!(off < 1e-6, "{what}: {found:?} is not {expected:?}");
    }
}

fn tells_of_tracks(scene: &Scene) -> bool {
    scene.notes.iter().any(|n| n.contains("tracks were scaled"))
}

#[test]
fn tracks_follow_frames_of_another_size() {
    let som = Som::new();
    let expected = rays(&Scene::open(som.root()).unwrap());
    let own = (WIDTH, HEIGHT);
    // The last has a side that was rounded.
    for size in [own, (2 * WIDTH, 2 * HEIGHT), (8, 6), (33, 24)] {
        for downscale in [1, 2] {
            if !size.0.is_multiple_of(downscale) {
                continue;
            }
            let scene = with_frames_of(&som, size, downscale);
            let what = format!("{size:?} / {downscale}");
            assert_same_rays(&scene, &expected, &what);
            assert_eq!(tells_of_tracks(&scene), size != own, "{what}");
        }
    }
}

/// Cameras may be those of other sizes than the pictures that tracks were made of.
#[test]
fn tracks_are_in_pixels_of_the_scene_s_own_pictures_whatever_its_cameras_are_of() {
    let som = Som::new();
    let cameras = som.path("flow3d_preprocessed/colmap/sparse/cameras.bin");
    let mut data = fs::read(&cameras).unwrap();
    data[16..24].copy_from_slice(&(2 * WIDTH as u64).to_le_bytes());
    data[24..32].copy_from_slice(&(2 * HEIGHT as u64).to_le_bytes());
    fs::write(&cameras, &data).unwrap();
    let expected = rays(&Scene::open(som.root()).unwrap());
    let scene = with_frames_of(&som, (2 * WIDTH, 2 * HEIGHT), 1);
    assert_same_rays(&scene, &expected, "twice as large");
    assert!(tells_of_tracks(&scene), "{:?}", scene.notes);
}

/// Without tracks nothing is asked of the scene's own pictures.
#[test]
fn own_pictures_may_be_broken_where_there_are_no_tracks() {
    let som = Som::new();
    fs::write(som.path("images/00000.png"), "no picture").unwrap();
    for i in 0..FRAMES {
        make::ramp(&som.path(&format!("other/{i:05}.png")), i);
    }
    let mut options = LoadOptions {
        images: Some(PathBuf::from("other")),
        static_scene: true,
        ..LoadOptions::default()
    };
    Scene::open_with(som.root(), &options).unwrap();
    options.static_scene = false;
    let error = Scene::open_with(som.root(), &options).unwrap_err();
    assert!(error.to_string().contains("images/00000.png"), "{error}");
}
