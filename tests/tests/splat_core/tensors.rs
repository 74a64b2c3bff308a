//! The splatting op on tensors: gradients through every input in f64, agreement with the slice
//! kernels, errors, and what a render gives beside the image.

use burn::tensor::{DType, Device, Tensor, TensorData};
use limpid_tests::{
    GradLimits, check_gradients, computes, devices, devices_in, noise, tensor, values,
};
use splat_core::cpu::{SplatSlices, View, project, rasterize as rasterize_slices};
use splat_core::{
    Camera, Extra, Rendered, SplatError, Splats, Viewpoint, prepare, rasterize, render,
};

/// Gaussians.
pub(crate) const N: usize = 5;
const FEATURES: usize = 2;

fn camera() -> Camera {
    Camera::pinhole([19, 17], [20.0, 17.0], [8.5, 9.5])
}

/// Named inputs of a render as matrices, wide Gaussians in front of a slightly turned camera.
pub(crate) fn inputs() -> [(&'static str, [usize; 2], Vec<f64>); 8] {
    let scaled = |count, seed, scale: f64, shift: f64| -> Vec<f64> {
        noise(count, seed)
            .iter()
            .map(|v| v * scale + shift)
            .collect()
    };
    let mut means = scaled(3 * N, 1, 0.8, 0.0);
    means.iter_mut().skip(2).step_by(3).for_each(|z| *z += 3.0);
    let mut left = scaled(9 * 2, 2, 0.2, 0.0);
    (0..2).for_each(|f| (0..3).for_each(|k| left[9 * f + 4 * k] += 1.0));
    let (s, c) = 0.1_f64.sin_cos();
    let pose = vec![c, 0.0, s, 0.1, 0.0, 1.0, 0.0, -0.2, -s, 0.0, c, 0.3];
    let mut sh = scaled(N * 48, 3, 0.1, 0.0);
    sh.chunks_exact_mut(48)
        .for_each(|row| row[..3].iter_mut().for_each(|v| *v += 1.0));
    [
        ("means", [N, 3], means),
        ("quats", [N, 4], scaled(4 * N, 4, 1.3, 0.1)),
        ("left_rotations", [2, 9], left),
        ("log_scales", [N, 3], scaled(3 * N, 5, 0.2, -0.3)),
        ("opacity_logits", [N, 1], scaled(N, 6, 1.0, 0.5)),
        ("sh", [N, 48], sh),
        ("cam_from_world", [3, 4], pose),
        ("features", [N, FEATURES], noise(FEATURES * N, 7)),
    ]
}

fn tensors(device: &Device, dtype: DType) -> Vec<Tensor<2>> {
    inputs()
        .into_iter()
        .map(|(_, shape, values)| {
            Tensor::from_data(TensorData::new(values, shape), (device, dtype))
        })
        .collect()
}

fn splats(t: &[Tensor<2>]) -> Splats {
    Splats {
        means: t[0].clone(),
        quats: t[1].clone(),
        left_rotations: Some(t[2].clone().reshape([2, 3, 3])),
        log_scales: t[3].clone(),
        opacity_logits: t[4].clone(),
        sh: t[5].clone(),
    }
}

fn view(t: &[Tensor<2>], sh_degree: usize) -> Viewpoint {
    Viewpoint {
        camera: camera(),
        cam_from_world: t[6].clone(),
        sh_degree,
    }
}

/// The features to be blended.
fn features(t: &[Tensor<2>]) -> Extra {
    Extra {
        features: Some(t[7].clone()),
        screen_grad: None,
    }
}

/// All inputs, with SH of degree 3 and features.
fn render_all(t: &[Tensor<2>]) -> Rendered {
    render(splats(t), &view(t, 3), features(t)).expect("a render")
}

/// Weights on the output's channels: those that `counts` names are random, the others zero.
fn channel_weights(counts: &dyn Fn(usize) -> bool) -> Vec<f64> {
    let channels = 5 + FEATURES;
    let mut weights = noise(19 * 17 * channels, 8);
    for (k, w) in weights.iter_mut().enumerate() {
        *w *= f64::from(u8::from(counts(k % channels)));
    }
    weights
}

fn check_render(
    device: &Device,
    inputs: &[(&str, [usize; 2], Vec<f64>)],
    weights: &[f64],
    sh_degree: usize,
    allow_zero: &[&str],
) {
    check_gradients(device, inputs, allow_zero, GradLimits::default(), |t| {
        let rendered = render(splats(t), &view(t, sh_degree), features(t)).expect("a render");
        let output = rendered.output().clone();
        let shape = [17, 19, 5 + FEATURES];
        (output.clone() * tensor(weights, shape, &output.device(), DType::F64)).sum()
    });
}

#[test]
fn every_input_has_the_gradient_of_central_differences() {
    let all = channel_weights(&|_| true);
    for (_, device) in devices_in(DType::F64) {
        for sh_degree in 0..=3 {
            check_render(&device, &inputs(), &all, sh_degree, &[]);
        }
        // Colour, alpha, depth and features each by themselves. Depth takes its share of the pose's translation through
        // the mean's z; neither depth nor alpha knows a colour.
        let [color, alpha, depth, features] =
            [0..3, 3..4, 4..5, 5..7].map(|channels| channel_weights(&|c| channels.contains(&c)));
        check_render(&device, &inputs(), &color, 3, &["features"]);
        check_render(&device, &inputs(), &alpha, 3, &["sh", "features"]);
        check_render(&device, &inputs(), &depth, 3, &["sh", "features"]);
        check_render(&device, &inputs(), &features, 3, &["sh"]);
    }
}

#[test]
fn gaussians_at_the_edge_of_the_view_have_the_right_gradients() {
    // The first reaches behind the camera, the second is behind it altogether, the third's mean lies outside the image,
    // beyond where the projection's Jacobian is clamped.
    let mut inputs = inputs();
    inputs[0].2[..9].copy_from_slice(&[0.02, 0.2, 0.0, 0.3, -0.1, -2.0, 2.6, 0.1, 2.0]);
    inputs[3].2[..9].copy_from_slice(&[-1.0, -1.2, -0.7, 0.0, 0.0, 0.0, 0.3, 0.1, 0.2]);
    let weights = channel_weights(&|_| true);
    for (name, device) in devices_in(DType::F64) {
        check_render(&device, &inputs, &weights, 3, &[]);
        let t: Vec<_> = inputs
            .iter()
            .map(|(_, shape, v)| tensor(v, *shape, &device, DType::F64))
            .collect();
        let rendered = render(splats(&t), &view(&t, 3), Extra::default()).unwrap();
        let drawn: Vec<bool> = values(rendered.radii()).iter().map(|r| *r > 0.0).collect();
        assert_eq!(drawn[..3], [true, false, true], "{name}");
    }
}

#[test]
fn slices_of_the_output_carry_gradients_too() {
    for (name, device) in devices_in(DType::F64) {
        let device = device.autodiff();
        let t: Vec<_> = tensors(&device, DType::F64)
            .into_iter()
            .map(Tensor::require_grad)
            .collect();
        let gradient = |whole: bool| {
            let rendered = render_all(&t);
            let loss = if whole {
                rendered.output().clone().sum()
            } else {
                rendered.color().sum()
                    + rendered.alpha().sum()
                    + rendered.depth().sum()
                    + rendered.features().unwrap().sum()
            };
            let grads = loss.backward();
            t.iter()
                .flat_map(|t| values(t.grad(&grads).unwrap()))
                .collect::<Vec<_>>()
        };
        for (a, b) in gradient(true).iter().zip(gradient(false)) {
            assert!(
                (a - b).abs() <= 1e-12 * a.abs().max(1.0),
                "{name}: {a} and {b}"
            );
        }
    }
}

#[test]
fn tensors_and_slices_give_the_same_image() {
    let inputs = inputs();
    let slices = SplatSlices {
        means: &inputs[0].2,
        quats: &inputs[1].2,
        left_rotations: &inputs[2].2,
        log_scales: &inputs[3].2,
        opacity_logits: &inputs[4].2,
        sh: &inputs[5].2,
    };
    let view = View {
        camera: camera(),
        cam_from_world: std::array::from_fn(|k| inputs[6].2[k]),
        sh_degree: 3,
    };
    let projection = project(&slices, &view).unwrap();
    let image = rasterize_slices(&projection, &inputs[7].2, FEATURES).unwrap();
    for (name, device) in devices_in(DType::F64) {
        for device in [device.clone(), device.autodiff()] {
            let t = tensors(&device, DType::F64);
            let rendered = render_all(&t);
            assert_eq!(values(rendered.output().clone()), image.output, "{name}");
            let radii: Vec<f64> = projection.radii().iter().map(|&r| f64::from(r)).collect();
            assert_eq!(values(rendered.radii()), radii, "{name}");
            assert_eq!(projection.num_visible(), N, "{name}");
            assert_eq!(rendered.color().dims(), [17, 19, 3], "{name}");
            assert_eq!(rendered.alpha().dims(), [17, 19], "{name}");
            let color: Vec<f64> = image.color().flatten().collect();
            assert_eq!(values(rendered.color()), color, "{name}");
            let alpha: Vec<f64> = image.alpha().collect();
            assert_eq!(values(rendered.alpha()), alpha, "{name}");
            let depth: Vec<f64> = image.depth().collect();
            assert_eq!(values(rendered.depth()), depth, "{name}");
            let features: Vec<f64> = image.features().flatten().copied().collect();
            assert_eq!(values(rendered.features().unwrap()), features, "{name}");
        }
    }
}

#[test]
fn layouts_that_are_not_contiguous_are_read_in_order() {
    for (name, device) in devices() {
        let t = tensors(&device, DType::F32);
        let image = |t: &[Tensor<2>]| values(render_all(t).output().clone());
        let turned: Vec<_> = t
            .iter()
            .map(|t| Tensor::<2>::from_data(t.clone().transpose().into_data(), &device).transpose())
            .collect();
        assert_eq!(image(&t), image(&turned), "{name}: transposed views");
        let parts: Vec<_> = t
            .iter()
            .map(|t| {
                let [rows, columns] = t.dims();
                Tensor::cat(vec![t.clone(), t.clone().neg()], 0).slice([0..rows, 0..columns])
            })
            .collect();
        assert_eq!(image(&t), image(&parts), "{name}: slices of larger tensors");
    }
}

#[test]
fn untracked_inputs_get_no_gradient_and_the_screen_statistic_arrives() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let mut t = tensors(&device, DType::F32);
        t[0] = t[0].clone().require_grad();
        let screen = Tensor::<1>::zeros([N], (&device, DType::F32)).require_grad();
        // Prepared without a graph: what is tracked is what is blended.
        let plain: Vec<_> = t.iter().map(|t| t.clone().inner()).collect();
        let prepared = prepare(&splats(&plain), &view(&plain, 3)).unwrap();
        let extra = Extra {
            features: None,
            screen_grad: Some(screen.clone()),
        };
        let rendered = rasterize(&prepared, splats(&t), t[6].clone(), extra).unwrap();
        let grads = rendered.color().sum().backward();
        assert!(t[0].grad(&grads).is_some(), "{name}: means");
        for k in [1, 2, 3, 4, 5, 6] {
            assert!(t[k].grad(&grads).is_none(), "{name}: input {k}");
        }
        let screen = values(screen.grad(&grads).unwrap());
        assert!(
            screen.len() == N && screen.iter().all(|v| *v > 0.0),
            "{name}: {screen:?}"
        );
    }
}

#[test]
fn no_gaussian_and_one_pixel_render() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let empty =
            |columns: usize| Tensor::<2>::zeros([0, columns], (&device, DType::F32)).require_grad();
        let none = Splats {
            means: empty(3),
            quats: empty(4),
            left_rotations: None,
            log_scales: empty(3),
            opacity_logits: empty(1),
            sh: empty(48),
        };
        let pose = tensors(&device, DType::F32)[6].clone().require_grad();
        let from = Viewpoint {
            camera: camera(),
            cam_from_world: pose.clone(),
            sh_degree: 3,
        };
        let rendered = render(none, &from, Extra::default()).unwrap();
        assert!(
            values(rendered.output().clone()).iter().all(|v| *v == 0.0),
            "{name}"
        );
        let grads = rendered.color().sum().backward();
        assert_eq!(values(pose.grad(&grads).unwrap()), vec![0.0; 12], "{name}");

        let t = tensors(&device, DType::F32);
        let pixel = Viewpoint {
            camera: Camera::pinhole([1, 1], [1.0, 1.0], [0.5, 0.5]),
            ..view(&t, 3)
        };
        let rendered = render(splats(&t), &pixel, Extra::default()).unwrap();
        assert_eq!(rendered.output().dims(), [1, 1, 5], "{name}");
        assert!(values(rendered.alpha())[0] > 0.0, "{name}");
    }
}

#[test]
fn bad_inputs_are_errors_that_say_which() {
    for (name, device) in devices() {
        let t = tensors(&device, DType::F32);
        let fails = |splats: Splats| prepare(&splats, &view(&t, 3)).unwrap_err();

        let mut bad = splats(&t);
        let mut v = values(bad.log_scales.clone());
        v[3 * 3 + 1] = f64::NAN;
        bad.log_scales = Tensor::from_data(TensorData::new(v, [N, 3]), (&device, DType::F32));
        let expected = SplatError::NotFinite {
            tensor: "log_scales",
            row: 3,
        };
        assert_eq!(fails(bad), expected, "{name}");

        let mut bad = splats(&t);
        bad.quats = t[3].clone();
        let message = fails(bad).to_string();
        assert!(
            message.contains("quats") && message.contains("[5, 4]"),
            "{name}: {message}"
        );

        let mut bad = splats(&t);
        bad.sh = t[5].clone().slice([0..N, 0..12]);
        let expected = SplatError::ShDegree {
            active: 3,
            stored: 1,
        };
        assert_eq!(fails(bad), expected, "{name}");

        let wrong = Viewpoint {
            cam_from_world: t[0].clone(),
            ..view(&t, 3)
        };
        let message = prepare(&splats(&t), &wrong).unwrap_err().to_string();
        assert!(message.contains("cam_from_world"), "{name}: {message}");

        if computes(name, &device, DType::F64) {
            let mut bad = splats(&t);
            bad.means = bad.means.cast(DType::F64);
            let message = fails(bad).to_string();
            assert!(
                message.contains("F64") && message.contains("F32"),
                "{name}: {message}"
            );
        }

        // An op that is tracked refuses as one that is not.
        for (tracked, device) in [(false, device.clone()), (true, device.autodiff())] {
            let t: Vec<_> = tensors(&device, DType::F32)
                .into_iter()
                .map(|t| if tracked { t.require_grad() } else { t })
                .collect();
            let prepared = prepare(&splats(&t), &view(&t, 3)).unwrap();
            let blend = |features: Tensor<2>| {
                let extra = Extra {
                    features: Some(features),
                    screen_grad: None,
                };
                rasterize(&prepared, splats(&t), t[6].clone(), extra).unwrap_err()
            };
            let message = blend(t[7].clone().slice([0..N - 1, 0..FEATURES])).to_string();
            assert!(message.contains("features"), "{name}: {message}");
            let expected = SplatError::NotFinite {
                tensor: "features",
                row: 0,
            };
            assert_eq!(blend(t[7].clone() / 0.0), expected, "{name}");
        }
    }
}

#[test]
fn a_gradient_that_is_not_finite_does_not_vanish_on_its_way_back() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let t: Vec<_> = tensors(&device, DType::F32)
            .into_iter()
            .map(Tensor::require_grad)
            .collect();
        let rendered = render_all(&t);
        let grads = (rendered.color() * f64::NAN).sum().backward();
        for (index, (input, ..)) in inputs().into_iter().enumerate().take(7) {
            let gradient = values(t[index].grad(&grads).expect("every input is used"));
            assert!(gradient.iter().any(|v| v.is_nan()), "{name}: {input}");
        }
    }
}
