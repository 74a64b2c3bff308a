//! Renders and exposures in f32 on every device against f64 on the CPU: forward, back, and the stages between.

mod case;
mod stages;

use burn::tensor::{DType, Device, Tensor};
use case::{CASES, Case, tracked};
use limpid_tests::{devices, noise, skipped, tensor, values};
use splat_core::{
    Exposure, Extra, Movers, SplatError, Splats, Transfer, Viewpoint, expose, prepare, rasterize,
};

impl Case {
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
        let (splats, view) = self.scene(&inputs, device, DType::F32);
        let prepared = prepare(&splats, &view)?;
        let extra = Extra {
            features: (self.features > 0).then(|| tracked(&inputs, "features", device, DType::F32)),
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
