//! The losses on depth.

use super::scalar;
use burn::tensor::DType;
use limpid_tests::{GradLimits, check_gradients, devices_in, map_like, tensor, unit_noise, values};
use trainer::losses::{depth_loss, depth_shift_loss, point_disparity};

#[test]
fn gradient_of_the_depth_loss_goes_to_the_depth_alone() {
    let (height, width) = (4, 6);
    let alpha: Vec<f64> = unit_noise(24, 8).iter().map(|n| 0.3 + 0.7 * n).collect();
    let depth: Vec<f64> = unit_noise(24, 2)
        .iter()
        .zip(&alpha)
        .map(|(n, alpha)| (1.0 + n) * alpha)
        .collect();
    // Missing in some places, far from what is rendered in the others.
    let given: Vec<f32> = (0..24)
        .map(|k| match k % 6 {
            0 => 0.0,
            1 => f32::INFINITY,
            2 => 5.0,
            _ => 0.6,
        })
        .collect();
    for (name, device) in devices_in(DType::F64) {
        let opaque = tensor(&alpha, [height, width], &device, DType::F64);
        check_gradients(
            &device,
            &[("depth", [height, width], depth.clone())],
            &[],
            GradLimits::default(),
            |inputs| {
                let given = map_like(&given, &inputs[0]);
                depth_loss(inputs[0].clone(), &opaque, given, [1.7, 0.05])
            },
        );
        let device = device.autodiff();
        let leaf = |v: &[f64]| tensor(v, [height, width], &device, DType::F64).require_grad();
        let (depth, alpha_leaf) = (leaf(&depth), leaf(&alpha));
        let targets = map_like(&given, &depth);
        let grads = depth_loss(depth.clone(), &alpha_leaf, targets, [1.7, 0.05]).backward();
        let grad = values(depth.grad(&grads).expect("tracked"));
        assert!(alpha_leaf.grad(&grads).is_none(), "{name}");
        for k in 0..24 {
            let counts = alpha[k] > 0.5 && given[k] > 0.0 && given[k].is_finite();
            assert_eq!(grad[k] != 0.0, counts, "{name}: pixel {k}");
        }
    }
}

#[test]
fn the_depth_shift_loss_is_the_squared_mean_over_the_points() {
    for (name, device) in devices_in(DType::F64) {
        let (width, height, scene_size) = (8, 5, 4.0);
        let points: Vec<f32> = (0..width * height)
            .map(|k| {
                if k % 3 == 0 {
                    3.0 + 0.1 * k as f32
                } else {
                    0.0
                }
            })
            .collect();
        // Disparities times S lie off by `shift`, more and less by turns; elsewhere the depth is any.
        let loss = |shift: f64, noise: f64, alpha: f64| {
            let depth = points.iter().enumerate().map(|(k, &z)| {
                let off = shift + if k % 2 == 0 { noise } else { -noise };
                alpha
                    * if z > 0.0 {
                        scene_size / (scene_size / f64::from(z) + off)
                    } else {
                        7.0
                    }
            });
            let depth: Vec<f64> = depth.collect();
            let depth = tensor(&depth, [height, width], &device, DType::F64);
            let alpha = depth.full_like(alpha);
            let points = map_like(&point_disparity(&points, scene_size), &depth);
            scalar(depth_shift_loss(depth, &alpha, points, scene_size))
        };
        assert!(loss(0.0, 0.02, 0.9) < 1e-12, "{name}: noise has no mean");
        let shifted = loss(0.01, 0.02, 0.9);
        assert!((shifted / 1e-4 - 1.0).abs() < 1e-6, "{name}: {shifted}");
        let edges = loss(3.0, 0.0, 0.9);
        assert!(
            (edges / 2.5e-3 - 1.0).abs() < 1e-6,
            "{name}: clamped: {edges}"
        );
        assert_eq!(loss(0.01, 0.0, 0.4), 0.0, "{name}: nothing is there");
    }
}

#[test]
fn the_depth_loss_forgives_scale_and_shift_and_nothing_else() {
    for (name, device) in devices_in(DType::F64) {
        let (width, height) = (32, 18);
        let scene_size = 4.0;
        let depth: Vec<f64> = unit_noise(width * height, 6)
            .iter()
            .map(|n| 3.0 + 3.0 * n)
            .collect();
        let loss = |given: &[f32], depth: &[f64], alpha: f64| {
            let depth: Vec<f64> = depth.iter().map(|d| d * alpha).collect();
            let depth = tensor(&depth, [height, width], &device, DType::F64);
            let alpha = depth.full_like(alpha);
            let given = map_like(given, &depth);
            scalar(depth_loss(depth, &alpha, given, [scene_size, 0.05]))
        };
        let given: Vec<f32> = depth
            .iter()
            .map(|z| (1.0 / (0.97 / z + 0.01)) as f32)
            .collect();
        assert!(loss(&given, &depth, 0.9) < 1e-3, "{name}");
        let bent: Vec<f32> = depth
            .iter()
            .enumerate()
            .map(|(k, z)| (z * if k % 3 == 0 { 1.2 } else { 1.0 }) as f32)
            .collect();
        assert!(loss(&bent, &depth, 0.9) > 0.02, "{name}");
        // Nothing to compare with: no loss, and no not-a-number from empty pixels.
        assert_eq!(loss(&vec![0.0; depth.len()], &depth, 0.9), 0.0, "{name}");
        assert_eq!(loss(&given, &depth, 0.4), 0.0, "{name}");
        assert_eq!(loss(&given, &depth, 0.0), 0.0, "{name}");
        // Depths at zero keep to the floor: S / (0.05 S) against S / z.
        let near = loss(&vec![4.0; depth.len()], &vec![0.0; depth.len()], 1.0);
        assert!((near - (19.0 - 0.025)).abs() < 1e-9, "{name}: {near}");
    }
}

/// Where depth is right the loss pushes little, however many pixels there are to push; where it is wrong it is L1, and so it is
/// everywhere with nothing that is round.
#[test]
fn the_depth_loss_pushes_less_the_less_depth_is_off() {
    for (name, device) in devices_in(DType::F64) {
        // Too few pixels for a fit of scale and shift.
        let shape = [2, 5];
        let push = |off: f64, round: f64| {
            let device = device.clone().autodiff();
            let depth = tensor(&[1.0 / (0.5 + off); 10], shape, &device, DType::F64).require_grad();
            let opaque = depth.ones_like();
            let given = map_like(&[2.0; 10], &depth);
            let loss = depth_loss(depth.clone(), &opaque, given, [1.0, round]);
            let grad = values(depth.grad(&loss.backward()).expect("tracked"))[0];
            // To the disparity 1 / z, from the mean over ten pixels.
            (scalar(loss), -grad * 10.0 / (0.5 + off).powi(2))
        };
        for off in [0.0, 0.001, 0.01, 0.04, -0.03] {
            for round in [0.05, 0.2] {
                let (loss, slope) = push(off, round);
                let expected = off * off / (2.0 * round);
                assert!((loss - expected).abs() < 1e-12, "{name}: {off}");
                assert!((slope - off / round).abs() < 1e-9, "{name}: {off}");
            }
        }
        for off in [0.06, 0.3, -0.2_f64] {
            for round in [0.05, 0.0] {
                let (loss, slope) = push(off, round);
                let expected = off.abs() - round / 2.0;
                assert!((loss - expected).abs() < 1e-12, "{name}: {off}");
                assert!((slope - off.signum()).abs() < 1e-9, "{name}: {off}");
            }
        }
    }
}
