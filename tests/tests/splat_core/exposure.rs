//! The exposing op on tensors: gradients through every input in f64, agreement with renders that are averaged one by one,
//! the same bits with any number of threads, and what is refused.

use crate::tensors::{N, inputs as still_inputs};
use burn::tensor::{DType, Device, Tensor};
use limpid_tests::{
    GradLimits, check_gradients, computes, devices, devices_in, in_pool, noise, tensor, values,
    wall,
};
use splat_core::{
    Camera, Exposure, Extra, Movers, SplatError, Splats, Transfer, Viewpoint, expose, render,
};

/// Gaussians that move, and samples.
const MOVING: usize = 2;
const SAMPLES: usize = 3;

/// Named inputs of an exposure as matrices: wide Gaussians in front of a slightly turned camera that moves and is sheared.
fn inputs() -> Vec<(&'static str, [usize; 2], Vec<f64>)> {
    let [means, quats, _, log_scales, opacity_logits, sh, pose, _] = still_inputs();
    let around = |values: &[f64], seed, scale: f64| -> Vec<f64> {
        let noise = noise(SAMPLES * values.len(), seed);
        let moved = noise.iter().zip(values.iter().cycle());
        moved.map(|(noise, v)| v + scale * noise).collect()
    };
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0].repeat(MOVING);
    let poses = around(&pose.2, 8, 0.03);
    let moving_means = around(&means.2[..3 * MOVING], 9, 0.1);
    let left_rotations = around(&identity, 10, 0.1);
    vec![
        means,
        quats,
        log_scales,
        opacity_logits,
        sh,
        pose,
        ("poses", [SAMPLES, 12], poses),
        ("moving_means", [SAMPLES, 3 * MOVING], moving_means),
        ("left_rotations", [SAMPLES, 9 * MOVING], left_rotations),
    ]
}

fn tensors(device: &Device, dtype: DType) -> Vec<Tensor<2>> {
    let inputs = inputs().into_iter();
    inputs
        .map(|(_, shape, values)| tensor(&values, shape, device, dtype))
        .collect()
}

fn splats(t: &[Tensor<2>]) -> Splats {
    Splats {
        means: t[0].clone(),
        quats: t[1].clone(),
        left_rotations: None,
        log_scales: t[2].clone(),
        opacity_logits: t[3].clone(),
        sh: t[4].clone(),
    }
}

fn view(pose: &Tensor<2>, sh_degree: usize) -> Viewpoint {
    Viewpoint {
        camera: Camera::pinhole([19, 17], [20.0, 17.0], [8.5, 9.5]),
        cam_from_world: pose.clone(),
        sh_degree,
    }
}

fn exposure(t: &[Tensor<2>], transfer: Transfer) -> Exposure {
    Exposure {
        poses: t[6].clone().reshape([SAMPLES, 3, 4]),
        movers: Some(Movers {
            means: t[7].clone().reshape([SAMPLES, MOVING, 3]),
            left_rotations: t[8].clone().reshape([SAMPLES, MOVING, 3, 3]),
        }),
        transfer,
    }
}

fn picture(t: &[Tensor<2>], sh_degree: usize, transfer: Transfer) -> Tensor<3> {
    let exposed = expose(
        splats(t),
        &view(&t[5], sh_degree),
        exposure(t, transfer),
        None,
    );
    exposed.expect("a picture").color
}

#[test]
fn every_input_has_the_gradient_of_central_differences() {
    let weights = noise(17 * 19 * 3, 11);
    for (_, device) in devices_in(DType::F64) {
        for sh_degree in 0..=3 {
            for transfer in [Transfer::Srgb, Transfer::Power(2.2), Transfer::Linear] {
                let unseen: &[&str] = if sh_degree == 0 {
                    &["means", "cam_from_world"]
                } else {
                    &[]
                };
                // The pose in the middle counts for colours alone: its gradient is small against the differences' rounding.
                let limits = GradLimits {
                    element: 1e-6,
                    l2: 1e-6,
                    bias: 1e-6,
                    ..GradLimits::default()
                };
                check_gradients(&device, &inputs(), unseen, limits, |t| {
                    let picture = picture(t, sh_degree, transfer);
                    let weights = tensor(&weights, [17, 19, 3], &picture.device(), DType::F64);
                    (picture * weights).sum()
                });
            }
        }
    }
}

#[test]
fn a_picture_is_the_mean_light_of_renders_one_by_one() {
    for (name, device) in devices_in(DType::F64) {
        let t = tensors(&device, DType::F64);
        let mut sum = Tensor::<3>::zeros([17, 19, 3], (&device, DType::F64));
        for i in 0..SAMPLES {
            let row = |k: usize| t[k].clone().narrow(0, i, 1);
            let still = t[0].clone().narrow(0, MOVING, N - MOVING);
            let moved = row(7).reshape([MOVING, 3]);
            let splats = Splats {
                means: Tensor::cat(vec![moved, still], 0),
                left_rotations: Some(row(8).reshape([MOVING, 3, 3])),
                ..splats(&t)
            };
            let view = view(&row(6).reshape([3, 4]), 0);
            let rendered = render(splats, &view, Extra::default()).expect("a render");
            sum = sum + rendered.color();
        }
        let found = values(picture(&t, 0, Transfer::Linear));
        let expected = values(sum / SAMPLES as f64);
        assert!(
            expected.iter().any(|v| *v > 0.2),
            "{name}: there is a picture"
        );
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-12, "{name}: {a} {b}");
        }
    }
}

/// What it costs that all samples see a Gaussian in one colour, with spherical harmonics of degree 3 and a focal length of 213 px
/// (pictures 256 wide): a fortieth of an 8-bit step for a path of 3 px, a fifth for one of 10 (root mean squares).
#[test]
fn one_colour_for_all_samples_is_off_by_little() {
    for (name, device) in devices() {
        let mut splats = wall::splats(&device);
        let count = splats.means.dims()[0];
        let bands = tensor(&noise(count * 45, 12), [count, 45], &device, DType::F32);
        splats.sh = Tensor::cat(vec![splats.sh, bands.mul_scalar(0.1)], 1);
        let camera = Camera::pinhole([56, 40], [213.0; 2], [28.0, 20.0]);
        let seen_from = |x: f64| {
            let pose = [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
            tensor(&pose, [3, 4], &device, DType::F32)
        };
        let view = |pose: Tensor<2>| Viewpoint {
            camera: camera.clone(),
            cam_from_world: pose,
            sh_degree: 3,
        };
        let error = |path_px: f64| {
            // The wall is at depth 4.
            let places: Vec<f64> = (0..8)
                .map(|k| ((k as f64 + 0.5) / 8.0 - 0.5) * path_px * 4.0 / 213.0)
                .collect();
            let poses: Vec<Tensor<2>> = places.iter().map(|x| seen_from(*x)).collect();
            let mut sum = Tensor::<3>::zeros([40, 56, 3], (&device, DType::F32));
            for pose in &poses {
                let rendered = render(splats.clone(), &view(pose.clone()), Extra::default());
                sum = sum + rendered.expect("a render").color();
            }
            let exposure = Exposure {
                poses: Tensor::stack(poses, 0),
                movers: None,
                transfer: Transfer::Linear,
            };
            let exposed = expose(splats.clone(), &view(seen_from(0.0)), exposure, None);
            let difference = values(exposed.expect("a picture").color - sum.div_scalar(8.0));
            let squares = difference.iter().map(|d| d * d).sum::<f64>();
            (squares / difference.len() as f64).sqrt()
        };
        for (path_px, limit) in [(3.0, 0.03 / 255.0), (10.0, 0.2 / 255.0)] {
            let found = error(path_px);
            assert!(
                found > 0.0 && found < limit,
                "{name}, {path_px} px: {found:e}"
            );
        }
    }
}

#[test]
fn what_stands_still_keeps_its_left_rotation() {
    for (name, device) in devices_in(DType::F64) {
        let t = tensors(&device, DType::F64);
        let left = t[8].clone().narrow(0, 0, 1).reshape([MOVING, 3, 3]);
        let splats = Splats {
            left_rotations: Some(left),
            ..splats(&t)
        };
        let still = Exposure {
            poses: t[5].clone().reshape([1, 3, 4]).expand([2, 3, 4]),
            movers: None,
            transfer: Transfer::Linear,
        };
        let view = view(&t[5], 3);
        let exposed = expose(splats.clone(), &view, still, None).expect("a picture");
        let rendered = render(splats, &view, Extra::default()).expect("a render");
        for (a, b) in values(exposed.color).iter().zip(values(rendered.color())) {
            assert!((a - b).abs() < 1e-14, "{name}: {a} {b}");
        }
    }
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let run = |threads| {
        in_pool(threads, || {
            let device = Device::flex().autodiff();
            let t: Vec<_> = tensors(&device, DType::F32)
                .into_iter()
                .map(Tensor::require_grad)
                .collect();
            let picture = picture(&t, 3, Transfer::Srgb);
            let grads = picture.clone().square().sum().backward();
            let mut all = values(picture);
            for tensor in &t {
                all.extend(values(tensor.grad(&grads).expect("a gradient")));
            }
            all
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn density_control_gets_its_statistic() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let t = tensors(&device, DType::F32);
        let screen = Tensor::<1>::zeros([N], (&device, DType::F32)).require_grad();
        let exposure = exposure(&t, Transfer::Srgb);
        let exposed =
            expose(splats(&t), &view(&t[5], 3), exposure, Some(screen.clone())).expect("a picture");
        let grads = exposed.color.square().sum().backward();
        let norms = values(screen.grad(&grads).expect("the statistic"));
        let radii = values(exposed.radii);
        for (norm, radius) in norms.iter().zip(&radii) {
            assert_eq!(*norm > 0.0, *radius > 0.0, "{name}: {norms:?} {radii:?}");
        }
    }
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    for (name, device) in devices() {
        let t = tensors(&device, DType::F32);
        let refused = |change: &dyn Fn(&mut Exposure)| {
            let mut exposure = exposure(&t, Transfer::Srgb);
            change(&mut exposure);
            expose(splats(&t), &view(&t[5], 3), exposure, None).expect_err("not a picture")
        };
        let f32s = (&device, DType::F32);
        let error = refused(&|e| e.poses = Tensor::zeros([SAMPLES, 4, 4], f32s));
        assert!(
            matches!(
                error,
                SplatError::Shape {
                    tensor: "poses",
                    ..
                }
            ),
            "{name}: {error}"
        );
        let error = refused(&|e| e.poses = Tensor::zeros([SAMPLES + 1, 3, 4], f32s));
        assert!(matches!(error, SplatError::Shape { .. }), "{name}: {error}");
        let error = refused(&|e| e.poses = e.poses.clone() * f32::NAN);
        assert!(
            matches!(error, SplatError::NotFinite { .. }),
            "{name}: {error}"
        );
        let error = refused(&|e| e.poses = Tensor::zeros([0, 3, 4], f32s));
        assert!(matches!(error, SplatError::Shape { .. }), "{name}: {error}");
        let mut few_bands = splats(&t);
        few_bands.sh = few_bands.sh.narrow(1, 0, 12);
        let exposure_of = || exposure(&t, Transfer::Srgb);
        let error = expose(few_bands, &view(&t[5], 2), exposure_of(), None).expect_err("no bands");
        let expected = SplatError::ShDegree {
            active: 2,
            stored: 1,
        };
        assert_eq!(error, expected, "{name}");
        if computes(name, &device, DType::F64) {
            let wide = (&device, DType::F64);
            let error = refused(&|e| e.poses = Tensor::zeros([SAMPLES, 3, 4], wide));
            let named = matches!(
                error,
                SplatError::Dtype {
                    tensor: "poses",
                    ..
                }
            );
            assert!(named, "{name}: {error}");
        }
        let error = refused(&|e| {
            e.movers = Some(Movers {
                means: Tensor::zeros([SAMPLES, N + 1, 3], f32s),
                left_rotations: Tensor::zeros([SAMPLES, N + 1, 3, 3], f32s),
            });
        });
        let named = matches!(
            error,
            SplatError::Shape {
                tensor: "moving_means",
                ..
            }
        );
        assert!(named, "{name}: {error}");
    }
}
