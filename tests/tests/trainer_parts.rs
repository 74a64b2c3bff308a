//! Losses, Adam and density control on tensors, on every backend that is compiled in.

use burn::tensor::{DType, Tensor};
use limpid_tests::{GradLimits, check_gradients, devices, tensor};
use trainer::adam::{AdamOptions, AdamState, LearningRate, adam_step};
use trainer::density::{
    DensityOptions, RowEdit, RowKind, add_to_rows, gather_rows, plan_density, reset_opacity,
};
use trainer::losses::{
    depth_loss, downsample_loss, intensity_penalty, l1, mask_band, mask_loss, photometric, ssim,
};

/// Values in (0, 1) without a pattern.
fn noise(count: usize, seed: f64) -> Vec<f64> {
    (0..count)
        .map(|k| ((k as f64 + seed) * 12.9898).sin() * 43_758.545_3)
        .map(|v| v - v.floor())
        .collect()
}

fn values<const D: usize>(tensor: &Tensor<D>) -> Vec<f64> {
    tensor
        .to_data_as::<f64>()
        .try_into_vec::<f64>()
        .expect("converted to f64")
}

fn scalar(tensor: Tensor<1>) -> f64 {
    tensor.into_scalar::<f64>()
}

/// Mean SSIM with zeros outside the picture, straight from the definition.
fn direct_ssim(a: &[f64], b: &[f64], width: usize, height: usize) -> f64 {
    let weight = |k: i64| (-((k * k) as f64) / 4.5).exp();
    let total: f64 = (-5..=5).map(weight).sum::<f64>().powi(2);
    let mut sum = 0.0;
    for y in 0..height as i64 {
        for x in 0..width as i64 {
            for channel in 0..3 {
                let [mut m, mut n, mut p, mut q, mut r] = [0.0; 5];
                for v in -5..=5 {
                    for u in -5..=5 {
                        if (0..height as i64).contains(&(y + v))
                            && (0..width as i64).contains(&(x + u))
                        {
                            let k = ((y + v) as usize * width + (x + u) as usize) * 3 + channel;
                            let w = weight(u) * weight(v) / total;
                            m += w * a[k];
                            n += w * b[k];
                            p += w * a[k] * a[k];
                            q += w * b[k] * b[k];
                            r += w * a[k] * b[k];
                        }
                    }
                }
                sum += (2.0 * m * n + 1e-4) * (2.0 * (r - m * n) + 9e-4)
                    / ((m * m + n * n + 1e-4) * (p - m * m + q - n * n + 9e-4));
            }
        }
    }
    sum / (width * height * 3) as f64
}

#[test]
fn ssim_agrees_with_its_definition() {
    for (name, device) in devices() {
        for (width, height) in [(19, 14), (3, 2), (1, 1), (1, 12)] {
            let a = noise(width * height * 3, 0.1);
            let b: Vec<f64> = a
                .iter()
                .zip(noise(a.len(), 0.7))
                .map(|(a, n)| 0.7 * a + 0.3 * n)
                .collect();
            let expected = direct_ssim(&a, &b, width, height);
            for (dtype, tolerance) in [(DType::F64, 1e-12), (DType::F32, 1e-5)] {
                let of = |v: &[f64]| tensor(v, [height, width, 3], &device, dtype);
                let value = scalar(ssim(of(&a), &of(&b)));
                assert!(
                    (value - expected).abs() < tolerance,
                    "{name} {dtype:?} {width}x{height}: {value} instead of {expected}"
                );
                // The same picture behind other strides.
                let strided = of(&a).permute([1, 0, 2]).reshape([width, height, 3]);
                let strided = scalar(ssim(strided.permute([1, 0, 2]), &of(&b)));
                assert_eq!(value, strided, "{name}: strided input");
            }
            let same = tensor(&a, [height, width, 3], &device, DType::F64);
            assert!((scalar(ssim(same.clone(), &same)) - 1.0).abs() < 1e-12);
        }
    }
}

#[test]
fn ssim_of_extreme_pictures_is_finite() {
    for (name, device) in devices() {
        let device = device.autodiff();
        for level in [0.0, 1.0, 1e4, -1e4] {
            let a = tensor(&[level; 13 * 12 * 3], [13, 12, 3], &device, DType::F32).require_grad();
            let b = tensor(&noise(13 * 12 * 3, 0.5), [13, 12, 3], &device, DType::F32);
            let loss = photometric(a.clone(), b, 0.2);
            let grads = loss.backward();
            let grad = values(&a.grad(&grads).expect("a is tracked"));
            assert!(scalar(loss).is_finite(), "{name} at {level}");
            assert!(grad.iter().all(|g| g.is_finite()), "{name} at {level}");
        }
    }
}

#[test]
fn ssim_has_the_same_bits_with_one_and_two_threads() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("a pool of threads");
            pool.install(|| {
                let shape = [40, 64, 3];
                let a = tensor(&noise(40 * 64 * 3, 0.2), shape, &device, DType::F32);
                let a = a.require_grad();
                let b = tensor(&noise(40 * 64 * 3, 0.6), shape, &device, DType::F32);
                let loss = photometric(a.clone(), b, 0.2);
                let grads = loss.backward();
                (scalar(loss), values(&a.grad(&grads).expect("a is tracked")))
            })
        };
        assert_eq!(run(1), run(2), "{name}");
    }
}

#[test]
fn gradients_of_the_picture_losses() {
    let (width, height) = (9, 7);
    let a = noise(width * height * 3, 0.3);
    // Never equal, so that L1 has no kink nearby, and of one sign within a block of the averages.
    let b: Vec<f64> = noise(a.len(), 0.9)
        .iter()
        .zip(&a)
        .map(|(n, a)| a - 0.1 - 0.4 * n)
        .collect();
    for (_, device) in devices() {
        let target = tensor(&b, [height, width, 3], &device, DType::F64);
        let check = |loss: &dyn Fn(Tensor<3>) -> Tensor<1>| {
            check_gradients(
                &device,
                &[("picture", [height * width, 3], a.clone())],
                &[],
                GradLimits::default(),
                |inputs| loss(inputs[0].clone().reshape([height, width, 3])),
            );
        };
        check(&|a| ssim(a, &target));
        check(&|a| l1(a, target.clone()));
        check(&|a| photometric(a, target.clone(), 0.2));
        check(&|a| downsample_loss(a, target.clone(), 4));
        check(&|a| intensity_penalty(a * 2.0));
    }
}

#[test]
fn downsampling_averages_whole_blocks() {
    for (name, device) in devices() {
        // 5x9: one row of blocks of 4, two columns; the rest is left out.
        let picture = |f: &dyn Fn(usize, usize) -> f64| {
            let values: Vec<f64> = (0..5 * 9).flat_map(|k| [f(k / 9, k % 9); 3]).collect();
            tensor(&values, [5, 9, 3], &device, DType::F64)
        };
        let zero = picture(&|_, _| 0.0);
        let at = |y: usize, x: usize| {
            let sharp = picture(&|v, u| f64::from(u8::from(v == y && u == x)));
            scalar(downsample_loss(sharp, zero.clone(), 4))
        };
        assert!((at(3, 7) - 1.0 / 32.0).abs() < 1e-12, "{name}");
        assert_eq!([at(4, 0), at(0, 8)], [0.0; 2], "{name}: no whole block");
        // A checkerboard vanishes in its average.
        let board = picture(&|v, u| if (u + v) % 2 == 0 { 0.3 } else { -0.3 });
        assert!(scalar(downsample_loss(board, zero, 4)) < 1e-12, "{name}");
        let one = tensor(&[0.5; 3], [1, 1, 3], &device, DType::F64);
        assert!((scalar(downsample_loss(one.clone(), one * 3.0, 4)) - 1.0).abs() < 1e-12);
    }
}

/// A mask [H, W] with a rectangle inside.
fn rectangle(
    [width, height]: [usize; 2],
    x: std::ops::Range<usize>,
    y: std::ops::Range<usize>,
) -> Vec<f32> {
    (0..width * height)
        .map(|k| {
            f32::from(u8::from(
                x.contains(&(k % width)) && y.contains(&(k / width)),
            ))
        })
        .collect()
}

#[test]
fn a_mover_under_two_percent_of_the_picture_has_a_mask_loss() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let size = [64, 36];
        let target = rectangle(size, 20..26, 10..16);
        assert!(target.iter().sum::<f32>() < 0.02 * (64.0 * 36.0));
        let rendered = Tensor::<2>::zeros([36, 64], (&device, DType::F32)).require_grad();
        let loss = mask_loss(rendered.clone(), &target, mask_band(64));
        let grads = loss.backward();
        let grad = values(&rendered.grad(&grads).expect("tracked"));
        assert!(scalar(loss) > 0.0, "{name}");
        let pushed = grad.iter().filter(|g| **g < 0.0).count();
        assert_eq!(pushed, 4 * 4, "{name}: all of the mover but the band");
    }
}

#[test]
fn the_mask_loss_trims_each_side_and_spares_the_band() {
    for (name, device) in devices() {
        let (width, height) = (40, 20);
        let target = rectangle([width, height], 0..20, 0..20);
        let band = 2;
        let rendered = |f: &dyn Fn(usize, usize) -> f64| {
            let values: Vec<f64> = (0..width * height)
                .map(|k| f(k % width, k / width))
                .collect();
            tensor(&values, [height, width], &device, DType::F64)
        };
        // Wrong only beside the edge at x = 20.
        let beside = rendered(&|x, _| {
            if x < 18 {
                1.0
            } else if x < 22 {
                0.5
            } else {
                0.0
            }
        });
        assert_eq!(scalar(mask_loss(beside, &target, band)), 0.0, "{name}");
        // 360 pixels a side count; the largest 2 % of each, seven, are left out.
        let worst = rendered(&|x, y| {
            let right = f64::from(u8::from(x < 20));
            let first = x == if right > 0.5 { 0 } else { 39 } && y < 7;
            let wrong = if first {
                1.0
            } else if right > 0.5 {
                0.1
            } else {
                0.2
            };
            right + wrong
        });
        let loss = scalar(mask_loss(worst, &target, band));
        assert!((loss - 0.15).abs() < 1e-12, "{name}: {loss}");
        // Nothing inside, nothing outside, nothing but the band.
        for whole in [0.0, 1.0] {
            let all = rendered(&|_, _| 0.25);
            let loss = scalar(mask_loss(all, &vec![whole; width * height], band));
            assert!(
                (loss - f64::from(whole - 0.25).abs()).abs() < 1e-12,
                "{name}"
            );
        }
        let thin = rectangle([3, 1], 1..2, 0..1);
        let empty = tensor(&[0.5; 3], [1, 3], &device, DType::F32);
        assert_eq!(scalar(mask_loss(empty, &thin, 2)), 0.0, "{name}");
    }
}

#[test]
fn gradient_of_the_mask_loss() {
    let size = [12, 9];
    let target = rectangle(size, 2..9, 1..8);
    for (_, device) in devices() {
        check_gradients(
            &device,
            // Errors that differ, so that the trimmed ones stay the same under a small step.
            &[("mask", [9, 12], noise(108, 0.4))],
            &[],
            GradLimits::default(),
            |inputs| mask_loss(inputs[0].clone(), &target, 1),
        );
    }
}

#[test]
fn gradient_of_the_depth_loss_goes_to_the_depth_alone() {
    let (height, width) = (4, 6);
    let alpha: Vec<f64> = noise(24, 0.8).iter().map(|n| 0.3 + 0.7 * n).collect();
    let depth: Vec<f64> = noise(24, 0.2)
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
    for (name, device) in devices() {
        let opaque = tensor(&alpha, [height, width], &device, DType::F64);
        check_gradients(
            &device,
            &[("depth", [height, width], depth.clone())],
            &[],
            GradLimits::default(),
            |inputs| depth_loss(inputs[0].clone(), &opaque, &given, 1.7),
        );
        let device = device.autodiff();
        let leaf = |v: &[f64]| tensor(v, [height, width], &device, DType::F64).require_grad();
        let (depth, alpha_leaf) = (leaf(&depth), leaf(&alpha));
        let grads = depth_loss(depth.clone(), &alpha_leaf, &given, 1.7).backward();
        let grad = values(&depth.grad(&grads).expect("tracked"));
        assert!(alpha_leaf.grad(&grads).is_none(), "{name}");
        for k in 0..24 {
            let counts = alpha[k] > 0.5 && given[k] > 0.0 && given[k].is_finite();
            assert_eq!(grad[k] != 0.0, counts, "{name}: pixel {k}");
        }
    }
}

#[test]
fn the_depth_loss_forgives_scale_and_shift_and_nothing_else() {
    for (name, device) in devices() {
        let (width, height) = (32, 18);
        let scene_size = 4.0;
        let depth: Vec<f64> = noise(width * height, 0.6)
            .iter()
            .map(|n| 3.0 + 3.0 * n)
            .collect();
        let loss = |given: &[f32], depth: &[f64], alpha: f64| {
            let depth: Vec<f64> = depth.iter().map(|d| d * alpha).collect();
            let depth = tensor(&depth, [height, width], &device, DType::F64);
            let alpha = depth.full_like(alpha);
            scalar(depth_loss(depth, &alpha, given, scene_size))
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
        assert!((near - 19.0).abs() < 1e-9, "{name}: {near}");
    }
}

/// An edit with every kind: of five rows, 3 goes, 1 is cloned, 4 is split.
fn edit() -> RowEdit {
    use RowKind::{Clone, Kept, SplitChild};
    RowEdit {
        source: vec![0, 1, 1, 2, 4, 4],
        kind: vec![Kept, Kept, Clone, Kept, SplitChild, SplitChild],
        num_dynamic: 3,
    }
}

#[test]
fn adam_leaves_a_leaf_and_follows_its_definition() {
    for (name, device) in devices() {
        for (dtype, tolerance) in [(DType::F64, 1e-12), (DType::F32, 1e-5)] {
            for autodiff in [false, true] {
                let on = if autodiff {
                    device.clone().autodiff()
                } else {
                    device.clone()
                };
                let mut param = tensor(&noise(12, 0.1), [4, 3], &on, dtype);
                let mut state = AdamState::new(&param);
                let rate = LearningRate::first_and_rest(0.1, 1, 0.01, 3);
                let (mut expected, mut m, mut v) = (noise(12, 0.1), [0.0; 12], [0.0; 12]);
                for step in 1..=50 {
                    let grad: Vec<f64> =
                        noise(12, f64::from(step)).iter().map(|n| n - 0.4).collect();
                    adam_step(
                        &mut param,
                        tensor(&grad, [4, 3], &device, dtype),
                        &mut state,
                        &rate,
                        &AdamOptions::default(),
                    )
                    .expect("a finite gradient");
                    for k in 0..12 {
                        m[k] = 0.9 * m[k] + 0.1 * grad[k];
                        v[k] = 0.999 * v[k] + 0.001 * grad[k] * grad[k];
                        let root = (v[k] / (1.0 - 0.999_f64.powi(step))).sqrt() + 1e-15;
                        let rate = if k % 3 == 0 { 0.1 } else { 0.01 };
                        expected[k] -= rate * m[k] / (1.0 - 0.9_f64.powi(step)) / root;
                    }
                }
                assert_eq!(state.steps, 50);
                assert_eq!(param.is_require_grad(), autodiff, "{name}");
                assert_eq!(param.dtype(), dtype, "{name}");
                for (value, expected) in values(&param).iter().zip(&expected) {
                    assert!((value - expected).abs() < tolerance, "{name} {dtype:?}");
                }
                if autodiff {
                    let grads = (param.clone() * 2.0).sum().backward();
                    let grad = param.grad(&grads).expect("a leaf");
                    assert_eq!(values(&grad), [2.0; 12], "{name}");
                }
            }
        }
    }
}

#[test]
fn a_gradient_that_is_not_a_number_changes_nothing() {
    for (name, device) in devices() {
        let mut param = tensor(&noise(6, 0.3), [3, 2], &device, DType::F32);
        let before = values(&param);
        let mut state = AdamState::new(&param);
        for bad in [f64::NAN, f64::INFINITY] {
            let mut grad = vec![1.0; 6];
            grad[3] = bad;
            let error = adam_step(
                &mut param,
                tensor(&grad, [3, 2], &device, DType::F32),
                &mut state,
                &LearningRate::Uniform(0.1),
                &AdamOptions::default(),
            )
            .expect_err("not finite");
            assert_eq!((error.row, error.column), (1, 1), "{name}: {error}");
        }
        assert_eq!(values(&param), before, "{name}");
        assert_eq!(state.steps, 0, "{name}");
        assert_eq!(values(&state.moment2), [0.0; 6], "{name}");
    }
}

#[test]
fn moments_follow_clone_split_and_prune() {
    for (name, device) in devices() {
        let param = tensor(
            &noise(10, 0.2),
            [5, 2],
            &device.clone().autodiff(),
            DType::F32,
        );
        let mut param = param.require_grad();
        let mut state = AdamState::new(&param);
        adam_step(
            &mut param,
            tensor(&noise(10, 0.9), [5, 2], &device, DType::F32),
            &mut state,
            &LearningRate::Uniform(0.1),
            &AdamOptions::default(),
        )
        .expect("a finite gradient");
        let old = [&param, &state.moment1, &state.moment2].map(values);
        state.gather(&edit());
        let new = gather_rows(&param, &edit());
        assert!(new.is_require_grad(), "{name}: a leaf again");
        let new = [&new, &state.moment1, &state.moment2].map(values);
        for (row, (source, kind)) in edit().source.iter().zip(&edit().kind).enumerate() {
            for column in 0..2 {
                let from = 2 * *source as usize + column;
                let to = 2 * row + column;
                assert_eq!(new[0][to], old[0][from], "{name}: the parameter");
                for moment in [1, 2] {
                    let expected = if *kind == RowKind::Kept {
                        old[moment][from]
                    } else {
                        0.0
                    };
                    assert_eq!(new[moment][to], expected, "{name}: moment {moment}");
                }
            }
        }
        assert_eq!(state.steps, 1, "{name}: the count is shared");
        state.zero_moments();
        assert_eq!(values(&state.moment1), [0.0; 12], "{name}");
        assert_eq!(state.moment2.dims(), [6, 2], "{name}");
    }
}

#[test]
fn row_changes_give_leaves() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let logits = tensor(&[-9.0, 0.0, 9.0], [3, 1], &device, DType::F32).require_grad();
        let reset = reset_opacity(&logits, 0.01);
        assert!(reset.is_require_grad(), "{name}");
        let opacity = values(&burn::tensor::activation::sigmoid(reset));
        assert!(
            (opacity[0] - 1.234e-4).abs() < 1e-6,
            "{name}: the lower stays"
        );
        assert!(
            opacity[1..].iter().all(|o| (o - 0.01).abs() < 1e-6),
            "{name}"
        );
        let moved = add_to_rows(&logits, vec![1.0, 2.0, 3.0]);
        assert!(moved.is_require_grad(), "{name}");
        assert_eq!(values(&moved), [-8.0, 2.0, 12.0], "{name}");
    }
}

#[test]
fn density_plans_keep_their_promises() {
    arbtest::arbtest(|u| {
        let rows = u.int_in_range(0..=40_usize)?;
        let num_dynamic = u.int_in_range(0..=rows)?;
        let mut draw = |levels: &[f32]| -> arbtest::arbitrary::Result<Vec<f32>> {
            (0..rows).map(|_| u.choose(levels).copied()).collect()
        };
        let average = draw(&[0.0, 1e-4, 3e-4, 1.0, f32::NAN])?;
        let sizes = draw(&[1e-8, 0.004, 0.03, 0.12, 0.5, 1e4])?;
        let logits = draw(&[-40.0, -6.0, -5.0, 0.0, 40.0])?;
        let options = DensityOptions {
            grad_threshold: 2e-4,
            split_scale: 0.01,
            prune_scale: u.choose(&[None, Some(0.1)]).copied()?,
            prune_opacity: 0.005,
            max_gaussians: u.int_in_range(0..=60_usize)?,
        };
        let log_scales: Vec<f32> = sizes
            .iter()
            .flat_map(|s| [s.ln(), -20.0, s.ln() - 1.0])
            .collect();
        let plan = || plan_density(&average, &log_scales, &logits, num_dynamic, &options);
        let edit = plan();
        assert_eq!(edit, plan(), "the same plan twice");
        assert_eq!(edit.source.len(), edit.kind.len());
        assert!(
            edit.len() <= options.max_gaussians.max(rows),
            "the budget holds"
        );
        for (new, source) in edit.source.iter().enumerate() {
            let dynamic = (*source as usize) < num_dynamic;
            assert_eq!(dynamic, new < edit.num_dynamic, "dynamic rows come first");
        }
        assert_eq!(
            edit.num_dynamic > 0,
            num_dynamic > 0,
            "movers do not die out"
        );
        assert_eq!(
            edit.len() > edit.num_dynamic,
            rows > num_dynamic,
            "nor does the rest"
        );

        let of = |row: usize, kind| {
            let same = |(s, k): (&u32, &RowKind)| *s as usize == row && *k == kind;
            edit.source
                .iter()
                .zip(&edit.kind)
                .filter(|(s, k)| same((s, k)))
                .count()
        };
        let mut left_out = f32::NEG_INFINITY;
        let mut densified = f32::INFINITY;
        for row in 0..rows {
            let counts = [RowKind::Kept, RowKind::Clone, RowKind::SplitChild].map(|k| of(row, k));
            assert!(
                [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 2]].contains(&counts),
                "row {row} became {counts:?}"
            );
            let small = sizes[row] <= options.split_scale;
            let faint = logits[row] < -5.5;
            let offspring = if small { sizes[row] } else { sizes[row] / 1.6 };
            let fits = options.prune_scale.is_none_or(|limit| offspring <= limit);
            if counts[1] + counts[2] > 0 {
                assert!(average[row] >= options.grad_threshold && !faint && fits);
                assert_eq!(
                    small,
                    counts[1] == 1,
                    "small ones are cloned, large ones split"
                );
                densified = densified.min(average[row]);
            } else if average[row] >= options.grad_threshold && !faint && fits {
                left_out = left_out.max(average[row]);
            }
        }
        assert!(left_out <= densified, "the largest gradients win");
        if left_out > 0.0 {
            assert!(
                edit.len() + 2 > options.max_gaussians,
                "left out only for want of room"
            );
        }
        Ok(())
    });
}
