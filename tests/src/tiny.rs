//! A tiny scene that needs every part of the method: a textured wall, a patch that moves in front of it, and a camera that moves
//! during the exposure.

use crate::values;
use burn::tensor::Device;
use glam::{DAffine3, DVec2, DVec3};
use io::{Frame, Image, Map, QueryTracks, Scene, TrackSample, Tracks, View};
use splat_core::Camera;
use std::path::Path;
use trainer::settings::{BlurKind, When};
use trainer::{Settings, Trainer};

/// Number of training frames.
pub const FRAMES: usize = 6;
/// Width, px.
pub const WIDTH: usize = 40;
/// Height, px.
pub const HEIGHT: usize = 28;
/// Depth of the wall.
pub const WALL: f64 = 4.0;
/// Depth of the patch.
pub const PATCH: f64 = 3.0;

/// The camera of every frame.
#[must_use]
pub fn camera() -> Camera {
    Camera::pinhole([WIDTH, HEIGHT], [40.0, 40.0], [20.0, 14.0])
}

/// `cam_from_world` at a time.
#[must_use]
pub fn pose(time: f64) -> DAffine3 {
    DAffine3::from_translation(DVec3::new(-0.12 * time, 0.02 * (2.0 * time).sin(), 0.0))
}

/// Centre of the moving patch; it is one unit of half a length wide.
fn patch_center(time: f64) -> DVec2 {
    DVec2::new(-0.3 + 0.15 * time, 0.1)
}

/// Colour, depth and whether the patch is seen.
fn trace(time: f64, pixel: DVec2) -> ([f64; 3], f64, bool) {
    let center = pose(time).inverse().translation;
    let ray = camera().unproject(pixel, 1.0);
    let at = |z: f64| DVec2::new(center.x + ray.x * z, center.y + ray.y * z);
    let on_patch = at(PATCH) - patch_center(time);
    if on_patch.abs().max_element() < 0.35 {
        let s = (9.0 * on_patch.x).sin() * (7.0 * on_patch.y).cos();
        return ([0.8 + 0.15 * s, 0.3 - 0.2 * s, 0.2], PATCH, true);
    }
    let p = at(WALL);
    let s = (6.0 * p.x).sin() * (5.0 * p.y).sin();
    (
        [0.4 + 0.3 * s, 0.5 - 0.2 * s, 0.5 + 0.3 * (4.0 * p.x).cos()],
        WALL,
        false,
    )
}

/// What the camera sees with the shutter open for `exposure` frames around a time.
fn picture(time: f64, exposure: f64) -> Image {
    let samples = 7;
    let mut pixels = Vec::new();
    for i in 0..WIDTH * HEIGHT {
        let pixel = DVec2::new((i % WIDTH) as f64 + 0.5, (i / WIDTH) as f64 + 0.5);
        let mut sum = [0.0; 3];
        for k in 0..samples {
            let t = time + exposure * (k as f64 / (samples - 1) as f64 - 0.5);
            for (s, c) in sum.iter_mut().zip(trace(t, pixel).0) {
                *s += c / samples as f64;
            }
        }
        pixels.extend(sum.map(|c| c as f32));
    }
    Image {
        width: WIDTH,
        height: HEIGHT,
        pixels,
    }
}

/// The scene: blurry frames with depth, masks and tracks, and sharp test views at their poses.
#[must_use]
pub fn scene() -> Scene {
    scene_of(FRAMES)
}

/// The same with so many frames.
#[must_use]
pub fn scene_of(length: usize) -> Scene {
    let map = |time: f64, of: fn(f64, bool) -> f64| {
        let values = (0..WIDTH * HEIGHT).map(|i| {
            let (_, depth, patch) = trace(
                time,
                DVec2::new((i % WIDTH) as f64 + 0.5, (i / WIDTH) as f64 + 0.5),
            );
            of(depth, patch) as f32
        });
        Some(Map {
            width: WIDTH,
            height: HEIGHT,
            values: values.collect(),
        })
    };
    let view = |index: usize, exposure: f64| View {
        name: format!("{index:05}"),
        camera: camera(),
        cam_from_world: pose(index as f64),
        time: index as f32,
        image: picture(index as f64, exposure),
    };
    let frames = (0..length).map(|i| Frame {
        view: view(i, 0.9),
        depth: map(i as f64, |depth, _| depth),
        mask: map(i as f64, |_, patch| f64::from(u8::from(patch))),
    });
    let queries = (0..length).map(|query| {
        let mut samples = Vec::new();
        for k in 0..36 {
            let offset = DVec2::new((k % 6) as f64 - 2.5, (k / 6) as f64 - 2.5) * 0.12;
            for t in 0..length {
                let p = patch_center(t as f64) + offset;
                let seen = camera().project(pose(t as f64).transform_point3(p.extend(PATCH)));
                samples.push(TrackSample {
                    x: seen.x as f32,
                    y: seen.y as f32,
                    occlusion: -5.0,
                    expected_distance: -5.0,
                });
            }
        }
        QueryTracks {
            frame: query,
            samples,
        }
    });
    Scene {
        test: (0..length).map(|i| view(i, 0.0)).collect(),
        tracks: Some(Tracks {
            num_frames: length,
            queries: queries.collect(),
        }),
        ..Scene::of_frames(frames.collect())
    }
}

/// Every event of the schedule falls into the first 60 iterations.
#[must_use]
pub fn settings() -> Settings {
    let mut settings = Settings {
        iterations: 200,
        ..Settings::default()
    };
    // A quarter of what there is by default: a GPU that a CPU plays takes a fifth less time.
    settings.gaussians.initial_static_per_pixel = 0.5;
    settings.motion.num_bases = 4;
    settings.motion.first_fit_steps = 40;
    settings.blur.model = BlurKind::Kernels;
    settings.blur.hold = 0;
    settings.unseen.when = When::Always;
    settings.blur.kernel_size = 5;
    settings.loss.intensity = 0.001;
    settings.frames.offsets = true;
    settings.frames.gains = When::Always;
    settings
}

/// The numbers of a parameter, by its name in checkpoints.
///
/// # Panics
/// Where there is none of that name.
#[must_use]
pub fn parameter(trainer: &Trainer, name: &str) -> Vec<f64> {
    let mut all = trainer.model().parameters().into_iter();
    let found = all.find(|(parameter, _)| parameter.name == name);
    values(found.unwrap_or_else(|| panic!("no {name}")).1)
}

/// Trains the scene on the CPU for so many iterations with a model of blur, and leaves a checkpoint in a folder.
///
/// # Panics
/// Where it cannot.
pub fn checkpoint(folder: &Path, model: BlurKind, iterations: usize) -> Trainer {
    let mut settings = settings();
    settings.blur.model = model;
    let mut trainer = Trainer::new(scene(), settings, &Device::flex()).expect("a trainer");
    for _ in 0..iterations {
        trainer.step().expect("a step");
    }
    trainer.save(folder).expect("a checkpoint");
    trainer
}
