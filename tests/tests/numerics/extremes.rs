//! Input at the extremes: finite numbers stay finite, other numbers are refused by name, and whole training steps survive scenes
//! that have almost nothing in them. (The figures of single ops stand in docs/NUMERICS.md and `figures.rs`.)

use bpnet::{
    BlurField, BlurInputs, BpNet, BpNetConfig, BpNetError, Extractor, HeadInit, composite,
};
use burn::tensor::{DType, Device, Tensor};
use io::Scene;
use limpid_tests::{devices, noise, quick_devices, tensor, tiny, values};
use motion_bases::MotionBases;
use splat_core::cpu::{SplatSlices, View, project, rasterize};
use splat_core::{Camera, SplatError};
use trainer::{SceneProblem, Settings, TrainError, Trainer};

const BROKEN: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

/// Names, widths and values of a render's inputs.
fn splat_inputs() -> Vec<(&'static str, usize, Vec<f32>)> {
    let n = 3;
    let array = |count: usize, seed, scale: f64, shift: f64| -> Vec<f32> {
        let entry = |v: &f64| (v * scale + shift) as f32;
        noise(count, seed).iter().map(entry).collect()
    };
    let mut pose = vec![0.0; 12];
    [pose[0], pose[5], pose[10], pose[11]] = [1.0, 1.0, 1.0, 3.0];
    vec![
        ("means", 3, array(3 * n, 1, 0.5, 0.0)),
        ("quats", 4, array(4 * n, 2, 1.0, 0.0)),
        ("left_rotations", 9, array(9 * 2, 3, 1.0, 0.0)),
        ("log_scales", 3, array(3 * n, 4, 0.3, -1.0)),
        ("opacity_logits", 1, array(n, 5, 1.0, 0.0)),
        ("sh", 48, array(48 * n, 6, 0.2, 0.3)),
        ("features", 2, array(2 * n, 7, 1.0, 0.0)),
        ("cam_from_world", 4, pose),
    ]
}

fn try_render(inputs: &[(&'static str, usize, Vec<f32>)]) -> Result<Vec<f32>, SplatError> {
    let splats = SplatSlices {
        means: &inputs[0].2,
        quats: &inputs[1].2,
        left_rotations: &inputs[2].2,
        log_scales: &inputs[3].2,
        opacity_logits: &inputs[4].2,
        sh: &inputs[5].2,
    };
    let view = View {
        camera: Camera::pinhole([9, 7], [8.0, 8.0], [4.5, 3.5]),
        cam_from_world: std::array::from_fn(|k| inputs[7].2[k].into()),
        sh_degree: 3,
    };
    Ok(rasterize(&project(&splats, &view)?, &inputs[6].2, 2)?.output)
}

#[test]
fn every_poisoned_slot_of_a_render_is_named_with_its_row() {
    let good = splat_inputs();
    assert!(try_render(&good).is_ok());
    for index in 0..good.len() {
        let (name, width, entries) = &good[index];
        for slot in 0..entries.len() {
            for value in BROKEN {
                let mut bad = good.clone();
                bad[index].2[slot] = value;
                let expected = SplatError::NotFinite {
                    tensor: name,
                    row: slot / width,
                };
                assert_eq!(try_render(&bad), Err(expected), "{name}[{slot}] = {value}");
            }
        }
    }
}

#[test]
fn every_poisoned_slot_of_a_blur_is_named_with_its_row() {
    let (h, w, k) = (2, 3, 3);
    for (name, device) in devices() {
        let good = [
            ("image", 3, vec![0.5; h * w * 3]),
            ("blur kernel", k * k, vec![1.0 / 9.0; h * w * k * k]),
            ("blur intensity", 1, vec![0.5; h * w]),
        ];
        let blur = |inputs: &[(&'static str, usize, Vec<f64>); 3]| {
            let image = tensor(&inputs[0].2, [h, w, 3], &device, DType::F32);
            let field = BlurField::new(
                tensor(&inputs[1].2, [h, w, k * k], &device, DType::F32),
                tensor(&inputs[2].2, [h, w], &device, DType::F32),
            )
            .expect("the shapes fit");
            composite(image, &field).map(|blurred| values(blurred.picture()))
        };
        assert!(blur(&good).is_ok(), "{name}");
        for index in 0..good.len() {
            for slot in 0..good[index].2.len() {
                for value in BROKEN {
                    let mut bad = good.clone();
                    bad[index].2[slot] = f64::from(value);
                    let expected = BpNetError::NotFinite {
                        name: good[index].0,
                        row: slot / good[index].1,
                    };
                    assert_eq!(blur(&bad), Err(expected), "{name}: {slot} is {value}");
                }
            }
        }
    }
}

#[test]
fn a_poisoned_blur_model_is_refused_by_name() {
    for (name, device) in devices() {
        let config = BpNetConfig {
            kernel_size: 3,
            num_frames: 2,
            shortcut: true,
            downscale: 1,
            head: HeadInit::Mild,
            seed: 1,
        };
        let run = |net: &BpNet, color: f64| {
            let inputs = BlurInputs {
                color: tensor(&[color; 4 * 5 * 3], [4, 5, 3], &device, DType::F32),
                disparity: Tensor::ones([4, 5], (&device, DType::F32)),
                mask: Tensor::zeros([4, 5], (&device, DType::F32)),
            };
            net.forward(0, &inputs, Extractor::Trained).map(|_| ())
        };
        let net = BpNet::new(&config, &device, DType::F32).expect("a valid configuration");
        assert_eq!(run(&net, 0.5), Ok(()), "{name}");
        let refused = |name, row| Err(BpNetError::NotFinite { name, row });
        assert_eq!(run(&net, f64::NAN), refused("colour", 0), "{name}");
        for (index, (parameter, entries)) in net.parameters().into_iter().enumerate() {
            let mut bad = net.clone();
            let [rows, columns] = entries.dims();
            let mut entries = values(entries);
            entries[(rows - 1) * columns] = f64::INFINITY;
            *bad.parameters_mut()[index].1 = tensor(&entries, [rows, columns], &device, DType::F32);
            assert_eq!(run(&bad, 0.5), refused(parameter, rows - 1), "{name}");
        }
    }
}

#[test]
fn a_poisoned_motion_stays_in_its_rows_for_the_renderer_to_refuse() {
    for (name, device) in devices() {
        let (b, n, rows) = (2, 2, 3);
        let good = [
            [0.5, 0.1, 0.2, -0.3, 0.7, 0.1].repeat(b * n),
            noise(b * n * 3, 2),
            noise(rows * b, 3),
            noise(rows * 3, 4),
        ];
        // Whether each row's motion is finite.
        let finite = |inputs: &[Vec<f64>; 4]| -> Vec<bool> {
            let t = |k: usize, shape| tensor::<2>(&inputs[k], shape, &device, DType::F32);
            let bases = MotionBases {
                rots: t(0, [b, n * 6]),
                transls: t(1, [b, n * 3]),
                num_frames: n,
            };
            let (moved, rotations) = bases.moved_at(&t(2, [rows, b]), &t(3, [rows, 3]), &[0.5]);
            let (moved, rotations) = (values(moved), values(rotations));
            let ok = |v: &[f64]| v.iter().all(|v| v.is_finite());
            let pairs = moved.chunks(3).zip(rotations.chunks(9));
            pairs.map(|(m, r)| ok(m) && ok(r)).collect()
        };
        assert_eq!(finite(&good), [true; 3], "{name}");
        for (index, width) in [(0, 0), (1, 0), (2, b), (3, 3)] {
            for slot in 0..good[index].len() {
                let mut bad = good.clone();
                bad[index][slot] = f64::NAN;
                // A basis moves every Gaussian.
                let expected: Vec<bool> = (0..rows)
                    .map(|row| width > 0 && row != slot / width)
                    .collect();
                assert_eq!(finite(&bad), expected, "{name}: input {index}, slot {slot}");
            }
        }
    }
}

/// The left upper part of every picture and map.
fn cropped(mut scene: Scene, width: usize, height: usize) -> Scene {
    fn crop(values: &mut Vec<f32>, from: usize, channels: usize, width: usize, height: usize) {
        let rows = values.chunks(from * channels).take(height);
        *values = rows
            .flat_map(|row| row[..width * channels].to_vec())
            .collect();
    }
    let views = scene.frames.iter_mut().map(|f| &mut f.view);
    for view in views.chain(&mut scene.test) {
        crop(&mut view.image.pixels, tiny::WIDTH, 3, width, height);
        (view.image.width, view.image.height) = (width, height);
        (view.camera.width, view.camera.height) = (width, height);
    }
    for frame in &mut scene.frames {
        for map in [&mut frame.depth, &mut frame.mask].into_iter().flatten() {
            crop(&mut map.values, tiny::WIDTH, 1, width, height);
            (map.width, map.height) = (width, height);
        }
    }
    scene
}

/// The first frames alone.
fn shortened(mut scene: Scene, frames: usize) -> Scene {
    scene.frames.truncate(frames);
    scene.test.truncate(frames);
    if let Some(tracks) = &mut scene.tracks {
        let before = tracks.num_frames;
        tracks.num_frames = frames;
        tracks.queries.retain(|query| query.frame < frames);
        for query in &mut tracks.queries {
            let kept = query
                .samples
                .chunks(before)
                .flat_map(|track| &track[..frames]);
            query.samples = kept.copied().collect();
        }
    }
    scene
}

/// Trains for `steps` iterations and looks at every parameter and picture.
fn train(
    scene: Scene,
    settings: Settings,
    steps: usize,
    device: &Device,
) -> Result<(), TrainError> {
    let mut trainer = Trainer::new(scene, settings, device)?;
    for _ in 0..steps {
        let report = trainer.step()?;
        assert!(report.loss.is_finite(), "the loss is {}", report.loss);
    }
    for (parameter, tensor) in trainer.model().parameters() {
        let name = parameter.name;
        assert!(values(tensor).iter().all(|v| v.is_finite()), "{name}");
    }
    let evaluation = trainer.evaluate()?;
    assert!(evaluation.test.is_some(), "no score");
    Ok(())
}

#[test]
fn whole_training_steps_survive_scenes_with_almost_nothing_in_them() {
    let with = |edit: &dyn Fn(&mut io::Frame)| {
        let mut scene = tiny::scene();
        scene.frames.iter_mut().for_each(edit);
        scene
    };
    let masks = |value: f32| with(&|f| f.mask.as_mut().expect("a mask").values.fill(value));
    let depths = |value: f32| with(&|f| f.depth.as_mut().expect("a depth").values.fill(value));
    let first = tiny::pose(0.0);
    let scenes = [
        ("as it is", tiny::scene()),
        ("one frame", shortened(tiny::scene(), 1)),
        ("two frames", shortened(tiny::scene(), 2)),
        ("masks of zeros", masks(0.0)),
        ("masks of ones", masks(1.0)),
        ("constant depth", depths(4.0)),
        ("no depth at any pixel", depths(0.0)),
        ("depth of 1e6", depths(1e6)),
        ("depth of 1e-6", depths(1e-6)),
        (
            "one camera for all",
            with(&|f| f.view.cam_from_world = first),
        ),
        ("black frames", with(&|f| f.view.image.pixels.fill(0.0))),
        ("white frames", with(&|f| f.view.image.pixels.fill(1.0))),
        ("pictures of 1 x 1", cropped(tiny::scene(), 1, 1)),
        ("pictures of 1 x 28", cropped(tiny::scene(), 1, 28)),
        ("pictures of 40 x 1", cropped(tiny::scene(), 40, 1)),
        ("pictures of 17 x 19", cropped(tiny::scene(), 17, 19)),
    ];
    for (device_name, device) in quick_devices() {
        for (name, scene) in &scenes {
            let mut settings = tiny::settings();
            settings.blur.kernel_size = 15;
            settings.motion.first_fit_steps = 5;
            // Every part of the method is on from iteration 60; scenes with nothing to place are refused, in words.
            match train(scene.clone(), settings, 62, &device) {
                Ok(()) => {}
                Err(TrainError::Scene(problem)) => {
                    let nothing = ["no depth at any pixel", "pictures of 1 x 1"].contains(name);
                    let said = matches!(
                        problem,
                        SceneProblem::NoDepth | SceneProblem::NothingToPlace
                    );
                    assert!(nothing && said, "{device_name}, {name}: {problem}");
                }
                Err(error) => panic!("{device_name}, {name}: {error}"),
            }
        }
    }
}
