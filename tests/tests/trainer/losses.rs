//! The trainer's losses on tensors, on every backend that is compiled in.

mod depth;

use burn::tensor::{DType, Device, Tensor};
use limpid_tests::{
    GradLimits, check_gradients, computes, devices, devices_in, in_pool, map_like, tensor,
    unit_noise, values,
};
use trainer::losses::{
    detail_loss, downsample_loss, intensity_penalty, mask_band, mask_loss, photometric, ssim,
};
use trainer::metrics::{LARGEST_PSNR, masked_psnr, psnr_of};

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
            let a = unit_noise(width * height * 3, 1);
            let b: Vec<f64> = a
                .iter()
                .zip(unit_noise(a.len(), 7))
                .map(|(a, n)| 0.7 * a + 0.3 * n)
                .collect();
            let expected = direct_ssim(&a, &b, width, height);
            for (dtype, tolerance) in [(DType::F64, 1e-12), (DType::F32, 1e-5)] {
                if !computes(name, &device, dtype) {
                    continue;
                }
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
                let same = scalar(ssim(of(&a), &of(&a)));
                assert!((same - 1.0).abs() < tolerance, "{name} {dtype:?}: {same}");
            }
        }
    }
}

#[test]
fn ssim_of_extreme_pictures_is_finite() {
    for (name, device) in devices() {
        let device = device.autodiff();
        for level in [0.0, 1.0, 1e4, -1e4] {
            let a = tensor(&[level; 13 * 12 * 3], [13, 12, 3], &device, DType::F32).require_grad();
            let b = tensor(
                &unit_noise(13 * 12 * 3, 5),
                [13, 12, 3],
                &device,
                DType::F32,
            );
            let loss = photometric(a.clone(), b, 0.2);
            let grads = loss.backward();
            let grad = values(a.grad(&grads).expect("a is tracked"));
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
            in_pool(threads, || {
                let shape = [40, 64, 3];
                let a = tensor(&unit_noise(40 * 64 * 3, 2), shape, &device, DType::F32);
                let a = a.require_grad();
                let b = tensor(&unit_noise(40 * 64 * 3, 6), shape, &device, DType::F32);
                let loss = photometric(a.clone(), b, 0.2);
                let grads = loss.backward();
                (scalar(loss), values(a.grad(&grads).expect("a is tracked")))
            })
        };
        assert_eq!(run(1), run(2), "{name}");
    }
}

#[test]
fn gradients_of_the_picture_losses() {
    let (width, height) = (9, 11);
    let a = unit_noise(width * height * 3, 3);
    // Never equal, so that L1 has no kink nearby, and of one sign within a block of the averages.
    let b: Vec<f64> = unit_noise(a.len(), 9)
        .iter()
        .zip(&a)
        .map(|(n, a)| a - 0.1 - 0.4 * n)
        .collect();
    for (_, device) in devices_in(DType::F64) {
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
        check(&|a| photometric(a, target.clone(), 0.0));
        check(&|a| photometric(a, target.clone(), 0.2));
        check(&|a| downsample_loss(a, target.clone(), 4));
        check(&|a| detail_loss(a, target.clone()));
        check(&|a| intensity_penalty(a * 2.0));
    }
}

/// A picture [H, W, 3] of the same value in all channels, by row and column.
fn gray(
    [height, width]: [usize; 2],
    device: &Device,
    f: &dyn Fn(usize, usize) -> f64,
) -> Tensor<3> {
    let values = (0..height * width).flat_map(|k| [f(k / width, k % width); 3]);
    let values: Vec<f64> = values.collect();
    tensor(&values, [height, width, 3], device, DType::F64)
}

#[test]
fn fine_detail_is_what_differs_from_the_pixels_around_it() {
    for (name, device) in devices_in(DType::F64) {
        let picture = |f: &dyn Fn(usize, usize) -> f64| gray([6, 9], &device, f);
        let zero = picture(&|_, _| 0.0);
        let of = |picture: Tensor<3>| scalar(detail_loss(picture, zero.clone()));
        // A slope has none; a checkerboard of ±0.3 stands out by 0.6 against its neighbours, and by nothing two pixels away.
        assert!(
            of(picture(&|v, u| 0.1 * v as f64 - 0.2 * u as f64)) < 1e-12,
            "{name}"
        );
        let board = picture(&|v, u| if (u + v) % 2 == 0 { 0.3 } else { -0.3 });
        assert!((of(board) - 0.6).abs() < 1e-12, "{name}");
        // Stripes two pixels wide stand out by 0.15 where their neighbour along the row is the other stripe, and by 0.3 two away.
        let stripes = picture(&|_, u| if u / 2 % 2 == 0 { 0.3 } else { -0.3 });
        assert!((of(stripes) - 0.15 - 0.3).abs() < 1e-12, "{name}");
        let one = tensor(&[0.5; 3], [1, 1, 3], &device, DType::F64);
        assert_eq!(scalar(detail_loss(one.clone(), one * 3.0)), 0.0, "{name}");
    }
}

#[test]
fn fine_detail_is_a_mean_over_each_scale() {
    for [height, width] in [[3, 3], [4, 30], [19, 5], [33, 21]] {
        let shape = [height, width, 3];
        let [a, b] = [3, 9].map(|seed| unit_noise(height * width * 3, seed));
        let at = |y: usize, x: usize, c: usize| {
            let i = (y * width + x) * 3 + c;
            a[i] - b[i]
        };
        let mut expected = 0.0;
        for step in [1, 2] {
            let (mut sum, mut count) = (0.0, 0.0_f64);
            for y in step..height.saturating_sub(step) {
                for x in step..width.saturating_sub(step) {
                    for c in 0..3 {
                        let around = at(y - step, x, c)
                            + at(y + step, x, c)
                            + at(y, x - step, c)
                            + at(y, x + step, c);
                        sum += (at(y, x, c) - around / 4.0).abs();
                        count += 1.0;
                    }
                }
            }
            expected += sum / count.max(1.0);
        }
        for (name, device) in devices_in(DType::F64) {
            let [a, b] = [&a, &b].map(|v| tensor::<3>(v, shape, &device, DType::F64));
            let found = scalar(detail_loss(a, b));
            assert!(
                (found - expected).abs() < 1e-12,
                "{name}, {height}x{width}: {found}, not {expected}"
            );
        }
    }
}

#[test]
fn downsampling_averages_whole_blocks() {
    for (name, device) in devices_in(DType::F64) {
        // 5x9: one row of blocks of 4, two columns; the rest is left out.
        let picture = |f: &dyn Fn(usize, usize) -> f64| gray([5, 9], &device, f);
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
        let target = map_like(&target, &rendered);
        let loss = mask_loss(rendered.clone(), target, None, mask_band(64));
        let grads = loss.backward();
        let grad = values(rendered.grad(&grads).expect("tracked"));
        assert!(scalar(loss) > 0.0, "{name}");
        let pushed = grad.iter().filter(|g| **g < 0.0).count();
        assert_eq!(pushed, 4 * 4, "{name}: all of the mover but the band");
    }
}

#[test]
fn the_mask_loss_trims_each_side_and_spares_the_band() {
    for (name, device) in devices_in(DType::F64) {
        let (width, height) = (40, 20);
        let target = rectangle([width, height], 0..20, 0..20);
        let band = 2;
        let mask_loss = |rendered: Tensor<2>, target: &[f32]| {
            let target = map_like(target, &rendered);
            scalar(mask_loss(rendered, target, None, band))
        };
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
        assert_eq!(mask_loss(beside, &target), 0.0, "{name}");
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
        let loss = mask_loss(worst, &target);
        assert!((loss - 0.15).abs() < 1e-12, "{name}: {loss}");
        // Nothing inside, nothing outside, nothing but the band.
        for whole in [0.0, 1.0] {
            let all = rendered(&|_, _| 0.25);
            let loss = mask_loss(all, &vec![whole; width * height]);
            assert!(
                (loss - f64::from(whole - 0.25).abs()).abs() < 1e-12,
                "{name}"
            );
        }
        let thin = rectangle([3, 1], 1..2, 0..1);
        let empty = tensor(&[0.5; 3], [1, 3], &device, DType::F32);
        assert_eq!(mask_loss(empty, &thin), 0.0, "{name}");
    }
}

#[test]
fn gradient_of_the_mask_loss() {
    let size = [12, 9];
    let target = rectangle(size, 2..9, 1..8);
    for (_, device) in devices_in(DType::F64) {
        check_gradients(
            &device,
            // Errors that differ, so that the trimmed ones stay the same under a small step.
            &[("mask", [9, 12], unit_noise(108, 4))],
            &[],
            GradLimits::default(),
            |inputs| {
                let target = map_like(&target, &inputs[0]);
                mask_loss(inputs[0].clone(), target, None, 1)
            },
        );
    }
}

#[test]
fn the_psnr_of_a_step_counts_valid_pixels_alone() {
    for (name, device) in devices() {
        let of = |v: &[f64]| tensor(v, [4, 5, 3], &device, DType::F32);
        let picture = unit_noise(60, 1);
        // The lower half is filled with the picture itself, as an unseen view's holes are.
        let target: Vec<f64> = unit_noise(60, 2)
            .iter()
            .zip(&picture)
            .enumerate()
            .map(|(k, (t, p))| if k < 30 { *t } else { *p })
            .collect();
        let score = |valid: Option<&[bool]>| psnr_of(&of(&picture), &of(&target), valid);
        let upper: Vec<bool> = (0..20).map(|k| k < 10).collect();
        let lower: Vec<bool> = upper.iter().map(|valid| !valid).collect();
        let narrow = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let expected = masked_psnr(&narrow(&picture), &narrow(&target), &upper);
        let expected = expected.expect("ten pixels are set");
        assert!((score(Some(&upper)) - expected).abs() < 1e-4, "{name}");
        assert_eq!(
            score(Some(&[true; 20])),
            score(None),
            "{name}: the same bits"
        );
        assert!(
            score(None) > score(Some(&upper)) + 3.0,
            "{name}: holes flatter"
        );
        assert_eq!(score(Some(&lower)), LARGEST_PSNR, "{name}");
        assert!(score(Some(&[false; 20])).is_nan(), "{name}");
    }
}
