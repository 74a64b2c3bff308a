//! Losses that keep motion smooth: values, gradients, and rest.

use crate::tensors::{IDENTITY, assert_close};
use burn::tensor::{DType, Tensor};
use glam::DVec3;
use limpid_tests::{GradLimits, check_gradients, devices, devices_in, noise, tensor, values};
use motion_bases::{MotionBases, along_ray, bases_acceleration, means_acceleration};

#[test]
fn smoothness_has_the_right_value_and_gradient() {
    for (name, device) in devices_in(DType::F64) {
        let (b, n) = (2, 5);
        let inputs = [
            ("rots", [b, n * 6], noise(b * n * 6, 16)),
            ("transls", [b, n * 3], noise(b * n * 3, 17)),
        ];
        let bases = |x: &[Tensor<2>]| MotionBases {
            rots: x[0].clone(),
            transls: x[1].clone(),
            num_frames: n,
        };
        check_gradients(&device, &inputs, &[], GradLimits::default(), |x| {
            bases_acceleration(&bases(x), 3.0)
        });
        let mean = |values: &[f64], width: usize| -> f64 {
            let at = |k: usize, t: usize, c: usize| values[(k * n + t) * width + c];
            let length = |k: usize, t: usize| -> f64 {
                (0..width)
                    .map(|c| (2.0 * at(k, t, c) - at(k, t - 1, c) - at(k, t + 1, c)).powi(2))
                    .sum::<f64>()
                    .sqrt()
            };
            (0..b)
                .flat_map(|k| (1..n - 1).map(move |t| (k, t)))
                .map(|(k, t)| length(k, t))
                .sum::<f64>()
                / (b * (n - 2)) as f64
        };
        let expected = mean(&inputs[0].2, 6) + 2.0 * mean(&inputs[1].2, 3) / 3.0;
        let tensors: Vec<_> = inputs
            .iter()
            .map(|i| tensor(&i.2, i.1, &device, DType::F64))
            .collect();
        assert_close(
            &values(bases_acceleration(&bases(&tensors), 3.0)),
            &[expected],
            1e-5,
            name,
        );

        let means = [
            ("prev", [6, 3], noise(18, 18)),
            ("cur", [6, 3], noise(18, 19)),
            ("next", [6, 3], noise(18, 20)),
        ];
        check_gradients(&device, &means, &[], GradLimits::default(), |x| {
            means_acceleration([&x[0], &x[1], &x[2]], 2.0)
        });
        let center = DVec3::new(0.5, -0.3, -4.0);
        check_gradients(&device, &means, &[], GradLimits::default(), |x| {
            along_ray([&x[0], &x[1], &x[2]], center, 2.0)
        });
        // A point that recedes by 0.5 and then by 1 along the ray, at scale 2, and sideways at will.
        let point = |z: f64, side: f64| tensor(&[side, 0.0, z], [1, 3], &device, DType::F64);
        let found = along_ray(
            [&point(3.5, 9.0), &point(4.0, 0.0), &point(5.0, -7.0)],
            DVec3::ZERO,
            2.0,
        );
        assert_close(&values(found), &[0.0625 + 0.25], 1e-12, name);
    }
}

#[test]
fn rest_has_no_loss_and_no_gradient() {
    for (name, device) in devices() {
        let device = device.autodiff();
        for n in [1, 2, 3, 6] {
            let rots =
                tensor(&IDENTITY.repeat(2 * n), [2, n * 6], &device, DType::F32).require_grad();
            let transls = tensor(
                &[0.3, 1.0, -2.0].repeat(2 * n),
                [2, n * 3],
                &device,
                DType::F32,
            )
            .require_grad();
            let bases = MotionBases {
                rots: rots.clone(),
                transls: transls.clone(),
                num_frames: n,
            };
            let loss = bases_acceleration(&bases, 3.0);
            assert_eq!(values(loss.clone()), [0.0], "{name}, {n} frames");
            if n >= 3 {
                let grads = loss.backward();
                for leaf in [rots, transls] {
                    let gradient = values(leaf.grad(&grads).expect("a gradient"));
                    assert!(
                        gradient.iter().all(|&v| v == 0.0),
                        "{name}, {n} frames: {gradient:?}"
                    );
                }
            }
        }
        let mean = || tensor(&[0.1, 0.2, 5.0], [1, 3], &device, DType::F32).require_grad();
        let means = [mean(), mean(), mean()];
        let [prev, cur, next] = &means;
        // The camera sits in the point itself: there is no ray.
        let losses = means_acceleration([prev, cur, next], 2.0)
            + along_ray([prev, cur, next], DVec3::new(0.1, 0.2, 5.0), 2.0);
        assert_eq!(values(losses.clone()), [0.0], "{name}");
        let grads = losses.backward();
        for leaf in &means {
            let gradient = values(leaf.grad(&grads).expect("a gradient"));
            assert_eq!(gradient, [0.0; 3], "{name}");
        }
    }
}
