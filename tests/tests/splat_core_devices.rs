//! Renders and exposures in f32 on every device against f64 on the CPU, forward and back: generated scenes from a single
//! Gaussian to lists of several batches a tile, with thin, huge, hidden and faint Gaussians among them.

use burn::tensor::{DType, Device, Tensor};
use limpid_tests::{devices, noise, skipped, tensor, values};
use splat_core::{
    Camera, Exposure, Extra, Movers, SplatError, Splats, Transfer, Viewpoint, expose, prepare,
    rasterize,
};

/// A scene's inputs as matrices, by name.
type Inputs = Vec<(&'static str, [usize; 2], Vec<f64>)>;

/// Sizes of a case.
#[derive(Clone, Copy, Debug)]
struct Case {
    rows: usize,
    moving: usize,
    samples: usize,
    width: usize,
    height: usize,
    sh_degree: usize,
    features: usize,
}

const CASES: [Case; 5] = [
    Case {
        rows: 1,
        moving: 1,
        samples: 1,
        width: 1,
        height: 1,
        sh_degree: 0,
        features: 0,
    },
    Case {
        rows: 5,
        moving: 0,
        samples: 2,
        width: 19,
        height: 17,
        sh_degree: 1,
        features: 1,
    },
    // As many features as a GPU blends.
    Case {
        rows: 200,
        moving: 7,
        samples: 1,
        width: 40,
        height: 24,
        sh_degree: 0,
        features: 8,
    },
    Case {
        rows: 333,
        moving: 40,
        samples: 3,
        width: 50,
        height: 35,
        sh_degree: 2,
        features: 2,
    },
    Case {
        rows: 3001,
        moving: 1000,
        samples: 5,
        width: 33,
        height: 49,
        sh_degree: 3,
        features: 0,
    },
];

impl Case {
    fn camera(&self) -> Camera {
        let (w, h) = (self.width as f64, self.height as f64);
        Camera::pinhole(
            [self.width, self.height],
            [w, 0.9 * w],
            [0.45 * w, 0.55 * h],
        )
    }

    /// Every eighth Gaussian is thin, huge, behind the camera or faint; scales shrink with their number.
    fn inputs(&self) -> Inputs {
        let n = self.rows;
        let scaled = |count, seed, scale: f64, shift: f64| -> Vec<f64> {
            let noise = noise(count, seed);
            noise.iter().map(|v| v * scale + shift).collect()
        };
        let mut means = scaled(3 * n, 1, 1.5, 0.0);
        means.iter_mut().skip(2).step_by(3).for_each(|z| *z += 4.0);
        let mut log_scales = scaled(3 * n, 2, 0.7, -0.6 - (n as f64).ln() / 3.0);
        let mut logits = scaled(n, 3, 2.0, 0.5);
        for row in 1..n {
            match row % 32 {
                1 => log_scales[3 * row + 1] -= 5.0,
                9 => log_scales[3 * row] += 2.5,
                17 => means[3 * row + 2] = -1.0,
                25 => logits[row] = -7.0,
                _ => {}
            }
        }
        let (s, c) = 0.1_f64.sin_cos();
        let pose = vec![c, 0.0, s, 0.1, 0.0, 1.0, 0.0, -0.2, -s, 0.0, c, 0.3];
        let around = |values: &[f64], count: usize, seed, scale: f64| -> Vec<f64> {
            let noise = noise(count * values.len(), seed);
            let moved = noise.iter().zip(values.iter().cycle());
            moved.map(|(noise, v)| v + scale * noise).collect()
        };
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0].repeat(self.moving);
        let moving = &means[..3 * self.moving];
        let bands = (self.sh_degree + 1).pow(2) * 3;
        let mut sh = scaled(n * bands, 4, 0.2, 0.0);
        sh.chunks_exact_mut(bands)
            .for_each(|row| row[..3].iter_mut().for_each(|v| *v += 0.6));
        vec![
            ("quats", [n, 4], scaled(4 * n, 5, 1.3, 0.1)),
            ("log_scales", [n, 3], log_scales),
            ("opacity_logits", [n, 1], logits),
            ("sh", [n, bands], sh),
            ("features", [n, self.features], noise(n * self.features, 6)),
            (
                "poses",
                [self.samples, 12],
                around(&pose, self.samples, 7, 0.02),
            ),
            (
                "moving_means",
                [self.samples, 3 * self.moving],
                around(moving, self.samples, 8, 0.05),
            ),
            (
                "left_rotations",
                [self.samples, 9 * self.moving],
                around(&identity, self.samples, 9, 0.1),
            ),
            ("cam_from_world", [3, 4], pose),
            ("means", [n, 3], means),
        ]
    }

    /// A render's output, or an exposure's picture, the radii, the gradients of all inputs, and the statistic of density control.
    fn run(
        &self,
        device: &Device,
        dtype: DType,
        transfer: Option<Transfer>,
    ) -> Vec<(String, Vec<f64>)> {
        let inputs = self.inputs();
        let tensors: Vec<Tensor<2>> = inputs
            .iter()
            .map(|(_, shape, values)| tensor(values, *shape, device, dtype).require_grad())
            .collect();
        let [
            quats,
            log_scales,
            opacity_logits,
            sh,
            features,
            poses,
            moving,
            left,
            pose,
            means,
        ] = std::array::from_fn(|k| tensors[k].clone());
        let rows_of = |sample: usize, width: usize, table: &Tensor<2>| {
            let row = table.clone().slice_dim(0, sample..sample + 1);
            row.reshape([self.moving, width])
        };
        let mut splats = Splats {
            means,
            quats,
            left_rotations: None,
            log_scales,
            opacity_logits,
            sh,
        };
        let view = Viewpoint {
            camera: self.camera(),
            cam_from_world: pose,
            sh_degree: self.sh_degree,
        };
        let screen = Tensor::<1>::zeros([self.rows], (device, dtype)).require_grad();
        let (output, radii): (Tensor<3>, Tensor<1>) = match transfer {
            None => {
                splats.left_rotations =
                    (self.moving > 0).then(|| rows_of(0, 9, &left).reshape([self.moving, 3, 3]));
                let prepared = prepare(&splats, &view).expect("a view");
                let extra = Extra {
                    features: (self.features > 0).then_some(features),
                    screen_grad: Some(screen.clone()),
                };
                let pose = view.cam_from_world;
                let rendered = rasterize(&prepared, splats, pose, extra).expect("a render");
                (rendered.output().clone(), rendered.radii())
            }
            Some(transfer) => {
                let (n, f) = (self.samples, self.moving);
                let exposure = Exposure {
                    poses: poses.reshape([n, 3, 4]),
                    movers: (f > 0).then(|| Movers {
                        means: moving.reshape([n, f, 3]),
                        left_rotations: left.reshape([n, f, 3, 3]),
                    }),
                    transfer,
                };
                let exposed =
                    expose(splats, &view, exposure, Some(screen.clone())).expect("a picture");
                (exposed.color, exposed.radii)
            }
        };
        let weights = noise(output.dims().iter().product(), 10);
        let weights = tensor(&weights, output.dims(), device, dtype);
        let mut found = vec![
            ("output".to_owned(), values(output.clone())),
            ("radii".to_owned(), values(radii)),
        ];
        let gradients = (output * weights).sum().backward();
        for ((name, ..), tensor) in inputs.iter().zip(&tensors) {
            let gradient = tensor.grad(&gradients).map(values).unwrap_or_default();
            found.push((format!("gradient of {name}"), gradient));
        }
        let statistic = screen.grad(&gradients).map(values).unwrap_or_default();
        found.push(("statistic of density control".to_owned(), statistic));
        found
    }

    /// Renders in f32, with a way back.
    fn render(&self, device: &Device) -> Result<(), SplatError> {
        let inputs = self.inputs();
        let of = |name: &str| {
            let (_, shape, values) = inputs
                .iter()
                .find(|input| input.0 == name)
                .expect("an input");
            tensor(values, *shape, device, DType::F32).require_grad()
        };
        let splats = Splats {
            means: of("means"),
            quats: of("quats"),
            left_rotations: None,
            log_scales: of("log_scales"),
            opacity_logits: of("opacity_logits"),
            sh: of("sh"),
        };
        let view = Viewpoint {
            camera: self.camera(),
            cam_from_world: of("cam_from_world"),
            sh_degree: self.sh_degree,
        };
        let prepared = prepare(&splats, &view)?;
        let extra = Extra {
            features: (self.features > 0).then(|| of("features")),
            screen_grad: None,
        };
        rasterize(&prepared, splats, view.cam_from_world, extra).map(|_| ())
    }
}

/// Size of a difference against the size of what it is from; and whether both are all numbers.
fn distance(found: &[f64], exact: &[f64]) -> f64 {
    assert_eq!(found.len(), exact.len(), "as many values");
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let error = norm(&mut found.iter().zip(exact).map(|(a, b)| a - b));
    let size = norm(&mut exact.iter().copied());
    if size == 0.0 { error } else { error / size }
}

#[test]
fn single_precision_on_every_device_follows_double_on_the_cpu() {
    for case in CASES {
        let transfers = [
            None,
            Some(Transfer::Srgb),
            Some(Transfer::Power(2.2)),
            Some(Transfer::Linear),
        ];
        for transfer in transfers {
            let exact = case.run(&Device::flex().autodiff(), DType::F64, transfer);
            for (name, device) in devices() {
                let found = case.run(&device.clone().autodiff(), DType::F32, transfer);
                for ((what, found), (_, exact)) in found.iter().zip(&exact) {
                    let error = distance(found, exact);
                    // A threshold that falls the other way in f32 changes single pixels.
                    let limit = if what == "output" || what == "radii" {
                        1e-5
                    } else {
                        2e-4
                    };
                    assert!(
                        error < limit,
                        "{name}, {case:?}, {transfer:?}: {what} is off by {error:e}"
                    );
                }
            }
        }
    }
}

/// More projected Gaussians, and more places in the tiles' lists, than two levels of a prefix sum take (1,048,576).
#[test]
fn more_gaussians_than_fit_into_two_levels_of_a_prefix_sum() {
    let case = Case {
        rows: 140_000,
        moving: 100,
        samples: 8,
        width: 64,
        height: 48,
        sh_degree: 0,
        features: 0,
    };
    let transfer = Some(Transfer::Linear);
    let devices = devices();
    if devices.iter().all(|(name, _)| *name == "flex") {
        return;
    }
    let exact = case.run(&Device::flex().autodiff(), DType::F32, transfer);
    for (name, device) in devices.iter().filter(|(name, _)| *name != "flex") {
        let found = case.run(&device.clone().autodiff(), DType::F32, transfer);
        for ((what, found), (_, exact)) in found.iter().zip(&exact) {
            let error = distance(found, exact);
            assert!(error < 3e-5, "{name}: {what} is off by {error:e}");
        }
    }
}

#[test]
fn what_a_device_cannot_hold_or_blend_is_an_error_that_says_so() {
    let [_, mut case, ..] = CASES;
    case.features = 9;
    for (name, device) in devices() {
        let Ok(gpu) = trainer::Gpu::best(name) else {
            continue;
        };
        let error = case
            .render(&device.clone().autodiff())
            .expect_err("nine features");
        let limit = matches!(error, SplatError::TooManyFeatures { found: 9, limit: 8 });
        assert!(limit, "{error}");
        if gpu.largest_buffer > 2 << 30 {
            skipped(
                "gradients that do not fit",
                "the adapter has larger buffers",
            );
            continue;
        }
        // Seven numbers a pixel go back of a render with colours and depth.
        let side = (gpu.largest_buffer as f64 / 28.0).sqrt().ceil() as usize + 1;
        let huge = Case {
            width: side,
            height: side,
            features: 0,
            ..case
        };
        let error = huge.render(&device.autodiff()).expect_err("no room");
        let SplatError::TooLarge { bytes, limit, .. } = error else {
            panic!("{error}");
        };
        assert!(bytes > limit && limit == gpu.largest_buffer, "{error}");
        assert!(error.to_string().contains("smaller pictures"), "{error}");
    }
}

#[test]
fn the_same_scene_gives_the_same_bits_again() {
    let [.., case] = CASES;
    for (name, device) in devices() {
        let run = || case.run(&device.clone().autodiff(), DType::F32, Some(Transfer::Srgb));
        for ((what, first), (_, second)) in run().into_iter().zip(run()) {
            assert!(first == second, "{name}: {what} has other bits");
        }
    }
}
