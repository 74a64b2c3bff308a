//! The trainer's kernels on every device in f32, against f64 in main memory.

use burn::tensor::{DType, Device, Tensor, TensorData};
use host::{all_zero, count_not_finite, first_not_finite};
use limpid_tests::{assert_close, devices, map_like, noise, rounded, tensor, unit_noise, values};
use trainer::adam::{AdamState, AdamStep, LearningRate, Steps, adam_step};
use trainer::losses::{depth_loss, detail_loss, mask_loss, photometric, ssim};
use trainer::metrics::psnr_of;

/// A loss of a tensor and its gradient.
fn with_gradient<const D: usize>(
    input: &[f64],
    shape: [usize; D],
    device: &Device,
    dtype: DType,
    loss: &dyn Fn(Tensor<D>, &Device) -> Tensor<1>,
) -> (Vec<f64>, Vec<f64>) {
    let device = device.clone().autodiff();
    let input = tensor(input, shape, &device, dtype).require_grad();
    let loss = loss(input.clone(), &device);
    let grads = loss.backward();
    let gradient = input.grad(&grads).expect("the input is tracked");
    (values(loss), values(gradient))
}

/// Compares a loss and its gradient on every device with f64 on flex, and a second run with the first.
fn check<const D: usize>(
    what: &str,
    input: &[f64],
    shape: [usize; D],
    [value_tolerance, gradient_tolerance]: [f64; 2],
    loss: &dyn Fn(Tensor<D>, &Device, DType) -> Tensor<1>,
) {
    let input = rounded(input);
    let run = |device: &Device, dtype| {
        with_gradient(&input, shape, device, dtype, &|t, d| loss(t, d, dtype))
    };
    let (value, gradient) = run(&Device::flex(), DType::F64);
    for (name, device) in devices() {
        let found = run(&device, DType::F32);
        assert_close(
            &format!("{name}, {what}, value"),
            &found.0,
            &value,
            value_tolerance,
        );
        assert_close(
            &format!("{name}, {what}, gradient"),
            &found.1,
            &gradient,
            gradient_tolerance,
        );
        assert_eq!(found, run(&device, DType::F32), "{name}, {what}: twice");
    }
}

#[test]
fn image_losses() {
    for [height, width] in [[1, 1], [1, 13], [7, 3], [16, 16], [17, 33], [45, 70]] {
        let count = height * width * 3;
        let a = unit_noise(count, 3);
        let blend = |(n, a): (f64, &f64)| 0.3 * n + 0.7 * a;
        let b: Vec<f64> = unit_noise(count, 8)
            .into_iter()
            .zip(&a)
            .map(blend)
            .collect();
        let b = rounded(&b);
        let shape = [height, width, 3];
        let of = |d: &Device, dtype, v: &[f64]| tensor::<3>(v, shape, &d.clone().inner(), dtype);
        let size = format!("{height}x{width}");
        check(
            &format!("ssim {size}"),
            &a,
            shape,
            [3e-6, 3e-5],
            &|t, d, dtype| ssim(t, &of(d, dtype, &b)),
        );
        check(
            &format!("photometric {size}"),
            &a,
            shape,
            [3e-6, 3e-5],
            &|t, d, dtype| photometric(t, of(d, dtype, &b), 0.2),
        );
        if height.min(width) >= 3 {
            // Nothing that is a multiple of one number: second differences that are 0 have no sign.
            let a: Vec<f64> = noise(count, 3).iter().map(|v| 0.5 + 0.5 * v).collect();
            check(
                &format!("detail {size}"),
                &a,
                shape,
                [3e-6, 3e-5],
                &|t, d, dtype| detail_loss(t, of(d, dtype, &b)),
            );
        }
        // Flat pictures, whose variances are nothing but rounding.
        let flat = |level| rounded(&vec![level; count]);
        check(
            &format!("flat {size}"),
            &flat(0.3),
            shape,
            [1e-4, 1e-3],
            &|t, d, dtype| photometric(t, of(d, dtype, &flat(0.4)), 0.2),
        );
        // Far outside [0, 1] the absolute difference is the loss.
        let bright: Vec<f64> = a.iter().map(|v| 1e4 * (v - 0.5)).collect();
        check(
            &format!("bright {size}"),
            &bright,
            shape,
            [3e-6, 3e-5],
            &|t, d, dtype| photometric(t, of(d, dtype, &b), 0.0),
        );
    }
}

/// Rates of which the first so many rows have others.
fn first_rows(rows: usize, columns: usize) -> LearningRate {
    let rest = LearningRate::first_and_rest(0.1, 1, 0.02, columns);
    LearningRate::Uniform(0.05).then(rows, &rest, columns)
}

#[test]
fn adam() {
    for (rows, rates, drawn) in [
        (1, LearningRate::Uniform(0.1), None),
        (1031, LearningRate::Uniform(1e-3), None),
        (
            517,
            LearningRate::first_and_rest(2.5e-3, 3, 1.25e-4, 48),
            None,
        ),
        (
            65,
            LearningRate::PerColumn(vec![0.1, 0.1, 0.2, 0.3, 0.3]),
            None,
        ),
        (7, LearningRate::Uniform(0.1), Some(vec![])),
        (
            7,
            LearningRate::first_and_rest(0.1, 1, 0.2, 3),
            Some(vec![6, 0, 3]),
        ),
        (0, LearningRate::Uniform(0.1), None),
        (7, first_rows(3, 5), None),
        (2000, first_rows(1234, 48), None),
        (7, first_rows(7, 2), None),
    ] {
        let columns = match &rates {
            LearningRate::Uniform(_) => 3,
            LearningRate::PerColumn(rates) | LearningRate::FirstRows { rest: rates, .. } => {
                rates.len()
            }
        };
        let (count, shape) = (rows * columns, [rows, columns]);
        // All sizes that a gradient has, and none.
        let gradient = |step: u64| -> Vec<f64> {
            let size = |(k, n): (usize, &f64)| n * 10.0_f64.powi(k as i32 % 12 - 9);
            let mut gradient: Vec<f64> = noise(count, step).iter().enumerate().map(size).collect();
            for (value, extreme) in gradient.iter_mut().zip([0.0, 3e38, -3e38, 1e-42, -1e-30]) {
                *value = extreme;
            }
            rounded(&gradient)
        };
        let run = |device: &Device, dtype| {
            let mut parameter = tensor(&rounded(&noise(count, 9)), shape, device, dtype);
            let mut state = match &drawn {
                None => AdamState::new(&parameter),
                Some(_) => AdamState::per_row(&parameter),
            };
            let step = AdamStep {
                rate: &rates,
                drawn: drawn.as_deref().unwrap_or_default(),
            };
            // Another handle: it must not see the steps.
            let before = parameter.clone();
            for number in 1..=20 {
                let gradient = tensor(&gradient(number), shape, device, dtype);
                adam_step(&mut parameter, gradient, &mut state, &step);
            }
            if let Steps::PerRow(steps) = &state.steps {
                let drawn = drawn.as_ref().expect("rows step by themselves");
                let expected = |row| if drawn.contains(&row) { 20 } else { 0 };
                assert_eq!(*steps, (0..rows).map(expected).collect::<Vec<_>>());
            }
            assert_eq!(values(before), rounded(&noise(count, 9)));
            [parameter, state.moment1, state.moment2].map(values)
        };
        let expected = run(&Device::flex(), DType::F64);
        for (name, device) in devices() {
            let found = run(&device, DType::F32);
            let what = |part| format!("{name}, adam {rows}x{columns}, {part}");
            let ([parameter, first, second], wanted) = (&found, &expected);
            assert_close(&what("parameter"), parameter, &wanted[0], 2e-6);
            assert_close(&what("first moment"), first, &wanted[1], 2e-6);
            // Value by value: they differ by many orders of magnitude.
            let share = |(f, e): (&f64, &f64)| f / e.max(1e-36);
            let shares: Vec<f64> = second.iter().zip(&wanted[2]).map(share).collect();
            let ones = wanted[2].iter().map(|v| f64::from(u8::from(*v > 0.0)));
            assert_close(
                &what("second moment"),
                &shares,
                &ones.collect::<Vec<_>>(),
                2e-6,
            );
            assert_eq!(found, run(&device, DType::F32), "{name}: twice");
        }
    }
}

/// More numbers than 65,535 groups of 128 units take, of which WebGPU launches no more in a dimension.
#[test]
fn adam_and_faults_of_more_numbers_than_a_dimension_has_groups_for() {
    let rows: usize = 65_535 * 128 + 12_345;
    let gradient: Vec<f32> = (0..rows)
        .map(|row| if row % 3 == 0 { 2.0 } else { -0.5 })
        .collect();
    for (name, device) in devices() {
        let of = |values: &[f32]| {
            Tensor::<2>::from_data(TensorData::new(values.to_vec(), [rows, 1]), &device)
        };
        let mut parameter = Tensor::zeros([rows, 1], (&device, DType::F32));
        let mut state = AdamState::new(&parameter);
        let step = AdamStep {
            rate: &LearningRate::Uniform(0.25),
            drawn: &[],
        };
        adam_step(&mut parameter, of(&gradient), &mut state, &step);
        // The first step is as long as the rate, against the gradient.
        let found = parameter.clone().into_data();
        for (row, (found, gradient)) in found.iter::<f32>().zip(&gradient).enumerate() {
            let wanted = -0.25 * gradient.signum();
            assert!((found - wanted).abs() < 1e-5, "{name}, {row}: {found}");
        }
        let mut broken = gradient.clone();
        broken[rows - 1] = f32::NAN;
        let broken = of(&broken);
        assert!(all_zero(vec![count_not_finite(&parameter)]), "{name}");
        assert!(!all_zero(vec![count_not_finite(&broken)]), "{name}");
        let (at, _) = first_not_finite(&broken).expect("the last");
        assert_eq!(at, rows - 1, "{name}");
    }
}

#[test]
fn psnr() {
    for ([height, width], scale) in [
        ([1, 1], 1.0),
        ([5, 7], 1.0),
        ([37, 59], 1.0),
        ([37, 59], 1e-3),
        ([37, 59], 1e30),
    ] {
        let (count, shape) = (height * width * 3, [height, width, 3]);
        let a: Vec<f64> = unit_noise(count, 1).iter().map(|v| scale * v).collect();
        let (a, b) = (rounded(&a), rounded(&unit_noise(count, 5)));
        let valid: Vec<bool> = (0..height * width).map(|k| k % 5 != 3).collect();
        for valid in [None, Some(&valid[..])] {
            let run = |device: &Device, dtype| {
                let of = |v: &[f64]| tensor::<3>(v, shape, device, dtype);
                psnr_of(&of(&a), &of(&b), valid)
            };
            let expected = run(&Device::flex(), DType::F64);
            for (name, device) in devices() {
                let found = run(&device, DType::F32);
                let what = format!("{name}, psnr {height}x{width} of {scale}");
                assert_close(&what, &[found], &[expected], 2e-6);
                assert_eq!(found, run(&device, DType::F32), "{what}: twice");
                let none = vec![false; height * width];
                let of = tensor::<3>(&a, shape, &device, DType::F32);
                assert!(psnr_of(&of, &of, Some(&none)).is_nan(), "{what}");
                assert_eq!(psnr_of(&of, &of, valid), 120.0, "{what}: the same");
            }
        }
    }
}

#[test]
fn depth_losses() {
    let scene_size = 1.7;
    // Sizes below and above a fit and its sample; scale and shift that are believed and that are not.
    for ([height, width], scale, shift) in [
        ([1, 1], 1.0, 0.0),
        ([5, 6], 1.1, 0.1),
        ([9, 13], 1.1, -0.05),
        ([41, 67], 0.8, 0.2),
        ([130, 171], 1.3, -0.1),
        ([130, 171], 3.0, 0.0),
        ([33, 40], 0.0, 1.5),
    ] {
        let count = height * width;
        let alpha: Vec<f64> = unit_noise(count, 8).iter().map(|n| 0.4 + 0.6 * n).collect();
        let alpha = rounded(&alpha);
        let wave = |k: usize| 1.0 + 0.6 * (k as f64 * 0.037).sin();
        let depth: Vec<f64> = (0..count)
            .map(|k| {
                // Never as it should be, so that the loss has no kink nearby.
                let off = if k % 2 == 0 { 0.02 } else { -0.02 } * (1.0 + (k % 7) as f64);
                let disparity = match k % 11 {
                    0 => 4.0,
                    _ => scale * wave(k) + shift + off,
                };
                alpha[k] * scene_size / disparity
            })
            .collect();
        let given: Vec<f32> = (0..count)
            .map(|k| match k % 13 {
                1 => 0.0,
                2 => f32::INFINITY,
                3 => -1.0,
                4 => f32::NAN,
                5 => 1e-3,
                6 => f32::MAX,
                _ => (scene_size / wave(k)) as f32,
            })
            .collect();
        let what = format!("depth {height}x{width}, {scale} and {shift}");
        let tolerances = [2e-5, 2e-5];
        check(
            &what,
            &depth,
            [height, width],
            tolerances,
            &|t, d, dtype| {
                let alpha = tensor::<2>(&alpha, [height, width], &d.clone().inner(), dtype);
                let given = map_like(&given, &t);
                depth_loss(t, &alpha.autodiff(), given, [scene_size, 0.05])
            },
        );
        let nothing = vec![0.0; count];
        check(
            &format!("{what}, nothing given"),
            &depth,
            [height, width],
            [0.0, 0.0],
            &|t, d, dtype| {
                let alpha = tensor::<2>(&alpha, [height, width], &d.clone().inner(), dtype);
                let nothing = map_like(&nothing, &t);
                depth_loss(t, &alpha.autodiff(), nothing, [scene_size, 0.05])
            },
        );
    }
}

#[test]
fn mask_losses() {
    for ([height, width], band) in [
        ([1, 1], 1),
        ([3, 1], 2),
        ([9, 12], 1),
        ([45, 67], 2),
        ([90, 131], 1),
        ([31, 20], 1000),
    ] {
        let count = height * width;
        let inside = |k: usize| {
            let (y, x) = (k / width, k % width);
            (y / 11 + x / 13) % 2 == 0
        };
        let target: Vec<f32> = (0..count).map(|k| f32::from(u8::from(inside(k)))).collect();
        let valid: Vec<bool> = (0..count).map(|k| k % 7 != 2).collect();
        // In steps that f32 holds in differences too, with ties; the errors of some are large, as those of blurred movers.
        let rendered: Vec<f64> = unit_noise(count, 2)
            .iter()
            .enumerate()
            .map(|(k, n)| {
                let error = (n * 512.0).floor() / 4096.0 + f64::from(u8::from(k % 61 == 3)) * 0.5;
                if inside(k) { 1.0 - error } else { error }
            })
            .collect();
        for valid in [None, Some(&valid[..])] {
            let what = format!("mask {height}x{width}, {band}, {}", valid.is_some());
            check(
                &what,
                &rendered,
                [height, width],
                [2e-6, 2e-6],
                &|t, _, _| {
                    let target = map_like(&target, &t);
                    mask_loss(t, target, valid, band)
                },
            );
        }
        let whole = vec![1.0; count];
        check(
            &format!("mask {height}x{width}, inside alone"),
            &rendered,
            [height, width],
            [2e-6, 2e-6],
            &|t, _, _| {
                let whole = map_like(&whole, &t);
                mask_loss(t, whole, None, band)
            },
        );
    }
}

#[test]
fn what_is_no_number_is_found_on_the_device() {
    for (name, device) in devices() {
        for count in [1, 255, 300, 5000, 200_003] {
            let good = unit_noise(count, 4);
            let of = |v: &[f64]| tensor::<1>(v, [count], &device, DType::F32);
            assert_eq!(first_not_finite(&of(&good)), None, "{name}");
            for (at, value) in [
                (0, f64::NAN),
                (count / 2, f64::INFINITY),
                (count - 1, f64::NEG_INFINITY),
            ] {
                let mut values = good.clone();
                values[at] = value;
                let bad = of(&values);
                let (position, found) = first_not_finite(&bad).expect("one");
                assert_eq!(position, at, "{name}");
                assert!(
                    found == value || found.is_nan() && value.is_nan(),
                    "{name}: {found}"
                );
                let counts = |bad: &Tensor<1>| [&of(&good), bad, &of(&good)].map(count_not_finite);
                assert!(!all_zero(counts(&bad).to_vec()), "{name}");
                assert!(all_zero(counts(&of(&good)).to_vec()), "{name}");
            }
        }
        // The ends of f32 are numbers.
        let ends = [f64::from(f32::MAX), f64::from(f32::MIN), 1e-42, -0.0];
        let ends = tensor::<1>(&ends, [4], &device, DType::F32);
        assert_eq!(first_not_finite(&ends), None, "{name}");
        let none = Tensor::<2>::zeros([0, 3], (&device, DType::F32));
        assert_eq!(first_not_finite(&none), None, "{name}");
        assert!(all_zero(vec![]), "{name}");
    }
}
