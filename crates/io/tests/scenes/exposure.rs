//! Truth of how frames were blurred.

use glam::{DAffine3, DVec3};
use io::{LoadOptions, Scene};

use crate::make::{FRAMES, HEIGHT, Som, WIDTH, npy, write};

/// The rows of a camera that stands `x` to the left of another one, and is as far from the scene.
fn beside(x: f32) -> [f32; 12] {
    [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
}

/// Two cameras a frame, the second of which is further away with each, and depth of 2.
fn exposed() -> Som {
    let som = Som::new();
    for frame in 0..FRAMES {
        let cameras = [beside(0.0), beside(0.5 * frame as f32)].concat();
        let name = format!("{frame:05}.npy");
        write(
            &som.path("truth/exposure").join(&name),
            npy(&[2, 3, 4], &cameras),
        );
        write(
            &som.path("truth/depth").join(&name),
            npy(&[HEIGHT, WIDTH], &[2.0; HEIGHT * WIDTH]),
        );
    }
    som
}

#[test]
fn cameras_and_depth_of_every_frame_are_read() {
    let som = exposed();
    for downscale in [1, 2] {
        let options = LoadOptions {
            downscale,
            ..LoadOptions::default()
        };
        let scene = Scene::open_with(som.root(), &options).unwrap();
        let exposures = scene.truth().unwrap().exposures.unwrap();
        assert_eq!(exposures.len(), FRAMES);
        for (frame, exposure) in exposures.iter().enumerate() {
            let moved = DVec3::new(0.5 * frame as f64, 0.0, 0.0);
            let expected = [DAffine3::IDENTITY, DAffine3::from_translation(moved)];
            assert_eq!(exposure.cameras, expected);
            let depth = &exposure.depth;
            let size = (WIDTH / downscale, HEIGHT / downscale);
            assert_eq!((depth.width, depth.height), size);
            assert!(depth.values.iter().all(|z| *z == 2.0));
        }
    }
}

#[test]
fn depth_alone_says_nothing_of_exposures() {
    let som = exposed();
    som.remove("truth/exposure");
    let scene = Scene::open(som.root()).unwrap();
    assert_eq!(scene.truth().unwrap().exposures, None);
}

#[test]
fn what_is_wrong_is_named() {
    let nan = [f32::NAN; 12];
    let flat = [0.0; 12];
    let good = beside(1.0);
    for (bytes, why) in [
        (npy(&[12], &good), "[n, 3, 4]"),
        (npy(&[0, 3, 4], &[]), "a camera or more"),
        (npy(&[1, 3, 4], &nan), "camera 0"),
        (npy(&[2, 3, 4], &[good, flat].concat()), "camera 1"),
        (npy(&[3, 3, 4], &good), "bytes"),
    ] {
        let som = exposed();
        write(&som.path("truth/exposure/00001.npy"), bytes);
        let scene = Scene::open(som.root()).unwrap();
        let said = scene.truth().unwrap_err().to_string();
        assert!(said.contains(why) && said.contains("00001.npy"), "{said}");
    }
    for part in ["truth/depth", "truth/exposure/00001.npy"] {
        let som = exposed();
        som.remove(part);
        let scene = Scene::open(som.root()).unwrap();
        let said = scene.truth().unwrap_err().to_string();
        assert!(said.contains("truth"), "{said}");
    }
    let som = exposed();
    let small = npy(&[2, 2], &[2.0; 4]);
    write(&som.path("truth/depth/00001.npy"), small);
    let said = Scene::open(som.root()).unwrap().truth().unwrap_err();
    assert!(said.to_string().contains("00001.npy"), "{said}");
}
