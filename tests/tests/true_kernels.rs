//! True kernels of an exposure by our own rasteriser, and how a run is scored against them.

use burn::tensor::{DType, Device, Tensor};
use capture::{Capture, samples};
use glam::{DAffine3, DMat3, DVec2, DVec3};
use host::product;
use io::{Frame, Image, Map, Scene, View};
use limpid_tests::folder::write_npy;
use limpid_tests::{quick_devices, tensor, values, wall};
use splat_core::{Camera, Exposure, Extra, Splats, Transfer, Viewpoint, expose, pose_rows, render};
use std::path::Path;
use trainer::settings::{BlurKind, TransferKind};
use trainer::{KernelScores, PixelKernel, Settings, Trainer};

const FRAMES: usize = 3;
/// As long as the camera needs here to find path and focus.
const ITERATIONS: usize = 600;
const SIZE: f64 = 4.0;
const W: usize = 56;
const H: usize = 40;

/// Of pictures that are so many times larger than `W` by `H`.
fn camera(zoom: usize) -> Camera {
    let z = zoom as f64;
    Camera::pinhole([zoom * W, zoom * H], [60.0 * z; 2], [28.0 * z, 20.0 * z])
}

/// A frame that a camera took on a path and through a lens, both of its own: sharp, blurry, how far what it shows is, and from
/// where the light came.
struct Taken {
    sharp: Vec<f64>,
    blurry: Vec<f64>,
    depth: Vec<f64>,
    cameras: Vec<DAffine3>,
    pose: DAffine3,
}

/// A textured wall that comes nearer to the right, without the things before it: their edges are everywhere. Its Gaussians are
/// larger by `grow`, of a logarithm.
fn slanted_wall(grow: f64, device: &Device) -> Splats {
    let splats = wall::splats(device);
    let rows = |tensor: &Tensor<2>| tensor.clone().narrow(0, 0, 28 * 20);
    let means = rows(&splats.means);
    let slope = tensor(
        &[0.0, 0.0, -0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3, 3],
        device,
        DType::F32,
    );
    Splats {
        means: means.clone() + product(means, slope),
        quats: rows(&splats.quats),
        left_rotations: None,
        log_scales: rows(&splats.log_scales) + grow,
        opacity_logits: rows(&splats.opacity_logits),
        sh: rows(&splats.sh),
    }
}

fn taken(index: usize, (zoom, grow): (usize, f64), device: &Device) -> Taken {
    let splats = slanted_wall(grow, device);
    let f32s = |values: &[f64], shape| tensor(values, shape, device, DType::F32);
    let mut capture = Capture::still(1, 2, (device, DType::F32));
    let mut path = [0.0; 12];
    let turn = [[0.05, 0.03], [-0.02, 0.06], [0.01, -0.05]][index];
    path[..2].copy_from_slice(&turn);
    path[6..8].copy_from_slice(&[0.04, -0.02]);
    path[3] = 0.01;
    capture.paths = f32s(&path, [1, 12]);
    capture.aperture = f32s(&[0.02], [1, 1]);
    capture.focus = f32s(&[1.6], [1, 1]);

    let pose = DAffine3::from_translation(DVec3::new(-0.1 * index as f64, 0.0, 0.0));
    let rows = |pose: &DAffine3| f32s(&pose_rows(pose), [3, 4]);
    let view = Viewpoint {
        camera: camera(zoom),
        cam_from_world: rows(&pose),
        sh_degree: 0,
    };
    let sharp = render(splats.clone(), &view, Extra::default()).expect("a render");
    let of = |pose: &DAffine3| capture.poses(0, &rows(pose), &samples(96, 0.2), SIZE);
    let exposure = Exposure {
        poses: of(&pose),
        movers: None,
        transfer: Transfer::Linear,
    };
    let blurry = expose(splats, &view, exposure, None).expect("a picture");
    let cameras = values(of(&DAffine3::IDENTITY));
    let cameras = cameras.chunks_exact(12).map(|r| DAffine3 {
        matrix3: DMat3::from_cols_array(&[r[0], r[4], r[8], r[1], r[5], r[9], r[2], r[6], r[10]]),
        translation: DVec3::new(r[3], r[7], r[11]),
    });
    Taken {
        depth: values::<2>(sharp.depth() / sharp.alpha().clamp_min(1e-3)),
        sharp: values(sharp.color()),
        blurry: values(blurry.color),
        cameras: cameras.collect(),
        pose,
    }
}

/// The kernels say where light came from: with them, the sharp picture becomes what the rasteriser exposed.
#[test]
fn true_kernels_make_the_blurry_picture_of_the_sharp_one() {
    const RADIUS: usize = 14;
    const SIDE: usize = 2 * RADIUS + 1;
    let camera = camera(2);
    let (w, h) = (camera.width, camera.height);
    for (name, device) in quick_devices() {
        for index in 0..FRAMES {
            // Gaussians that hardly overlap: the order in which they are drawn changes along the path, as nothing real does.
            let taken = taken(index, (2, 0.0), &device);
            let (mut left, mut turned, mut blur, mut count) = (0.0, 0.0, 0.0, 0);
            for (x, y) in
                (RADIUS..h - RADIUS).flat_map(|y| (RADIUS..w - RADIUS).map(move |x| (x, y)))
            {
                let i = y * w + x;
                let at = DVec2::new(x as f64, y as f64) + 0.5;
                let kernel = PixelKernel::exposed(&camera, &taken.cameras, at, taken.depth[i]);
                assert!(kernel.radius() <= RADIUS, "{}", kernel.radius());
                let weights = kernel.on_grid(RADIUS);
                let around = || {
                    (0..SIDE * SIDE).map(|j| (y + j / SIDE - RADIUS) * w + x + j % SIDE - RADIUS)
                };
                for c in 0..3 {
                    let (sharp, blurry) = (taken.sharp[3 * i + c], taken.blurry[3 * i + c]);
                    let pixels = || around().map(|j| taken.sharp[3 * j + c]);
                    let made: f64 = pixels().zip(&weights).map(|(p, w)| w * p).sum();
                    let back: f64 = pixels().zip(weights.iter().rev()).map(|(p, w)| w * p).sum();
                    left += (made - blurry).powi(2);
                    turned += (back - blurry).powi(2);
                    blur += (sharp - blurry).powi(2);
                    count += 1;
                }
            }
            let [left, turned] = [left, turned].map(|error| f64::sqrt(error / blur));
            assert!(count > 1000, "{name}, frame {index}: {count} values");
            // Bilinear interpolation smooths a little.
            assert!(left < 0.1, "{name}, frame {index}: {left} is left");
            assert!(
                turned > 3.0 * left,
                "{turned} is left by kernels turned by half a turn, {left} by these"
            );
        }
    }
}

fn f32s(values: &[f64]) -> Vec<f32> {
    values.iter().map(|v| *v as f32).collect()
}

/// The frames as a scene whose truth is in `folder`.
fn scene(folder: &Path, device: &Device) -> Scene {
    let folders = io::TruthFolders {
        depth: folder.join("depth"),
        exposure: folder.join("exposure"),
        ..io::TruthFolders::default()
    };
    let frame = |index: usize| {
        let taken = taken(index, (1, 0.4), device);
        let name = format!("{index:05}");
        let file = format!("{name}.npy");
        let rows: Vec<f64> = taken.cameras.iter().flat_map(pose_rows).collect();
        let shape = [taken.cameras.len(), 3, 4];
        for (folder, shape, values) in [
            (&folders.depth, &[H, W][..], &taken.depth),
            (&folders.exposure, &shape[..], &rows),
        ] {
            write_npy(&folder.join(&file), shape, &f32s(values)).expect("written");
        }
        Frame {
            view: View {
                name,
                camera: camera(1),
                cam_from_world: taken.pose,
                time: index as f32,
                image: Image {
                    width: W,
                    height: H,
                    pixels: f32s(&taken.blurry),
                },
            },
            depth: Some(Map {
                width: W,
                height: H,
                values: f32s(&taken.depth),
            }),
            mask: None,
        }
    };
    Scene {
        truth_folders: folders.clone(),
        ..Scene::of_frames((0..FRAMES).map(frame).collect())
    }
}

fn trainer(scene: Scene, model: BlurKind, device: &Device) -> Trainer {
    let mut settings = Settings {
        iterations: ITERATIONS,
        ..Settings::default()
    };
    settings.blur.model = model;
    settings.camera.transfer = TransferKind::Linear;
    Trainer::new(scene, settings, device).expect("a trainer")
}

fn scores(trainer: &Trainer) -> KernelScores {
    let evaluation = trainer.evaluate().expect("scores");
    evaluation.kernels.expect("true kernels are known")
}

#[test]
fn kernels_are_scored_where_they_are_known_and_the_camera_finds_them() {
    let device = Device::flex();
    let folder = tempfile::tempdir().expect("a folder");
    let scene = scene(folder.path(), &device);

    let trained = |model, steps: usize| {
        let mut trainer = trainer(scene.clone(), model, &device);
        while trainer.iteration() < steps {
            trainer.step().expect("a step");
        }
        scores(&trainer)
    };
    let [sharp, camera] = [(BlurKind::Off, 1), (BlurKind::Camera, ITERATIONS)]
        .map(|(model, steps)| trained(model, steps));
    assert_eq!((sharp.count, sharp.side), (camera.count, camera.side));
    assert!(sharp.count >= 3 && sharp.side >= 9, "{sharp:?}");
    assert!(
        camera.as_found.psnr > sharp.as_found.psnr + 3.0
            && camera.as_found.kl < 0.5 * sharp.as_found.kl,
        "{camera:?} {sharp:?}"
    );

    // In truth nothing is blurred: a run that blurs nothing has the true kernels.
    let still = pose_rows(&DAffine3::IDENTITY);
    for index in 0..FRAMES {
        let file = scene.truth_folders.exposure.join(format!("{index:05}.npy"));
        write_npy(&file, &[1, 3, 4], &f32s(&still)).expect("written");
    }
    let best = trained(BlurKind::Off, 1);
    for score in [best.as_found, best.centred] {
        assert!(score.psnr > 119.0 && score.kl < 1e-9, "{best:?}");
    }
    std::fs::remove_dir_all(&scene.truth_folders.exposure).expect("removed");
    let unknown = trainer(scene.clone(), BlurKind::Off, &device).evaluate();
    assert_eq!(unknown.expect("scores").kernels, None);
}
