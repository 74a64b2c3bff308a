//! What blur, motion and warp leave as it is, and what their weights add up to: properties in f64 and
//! in f32, on every backend.

use arbtest::arbitrary::{Result, Unstructured};
use bpnet::{BlurField, BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, blur, composite};
use burn::tensor::{DType, Device};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use limpid_tests::{computes, property, quick_devices, tensor, uniform, values};
use motion_bases::{
    InitOptions, MotionBases, Tracks3d, gram_schmidt, initialize, positions_all_frames,
};
use splat_core::Camera;
use unseen_views::{Source, WarpOptions, warp};

/// The error of one rounding: half the distance from 1 to the next number.
fn rounding(dtype: DType) -> f64 {
    match dtype {
        DType::F32 => f64::from(f32::EPSILON) / 2.0,
        _ => f64::EPSILON / 2.0,
    }
}

/// Every backend with every float type, by name.
fn backends() -> Vec<(String, Device, DType)> {
    [DType::F32, DType::F64]
        .into_iter()
        .flat_map(|dtype| {
            let mut devices = quick_devices();
            devices.retain(|(name, device)| computes(name, device, dtype));
            let named = move |(name, device)| (format!("{name}, {dtype:?}"), device, dtype);
            devices.into_iter().map(named)
        })
        .collect()
}

fn numbers(u: &mut Unstructured<'_>, count: usize, low: f64, high: f64) -> Result<Vec<f64>> {
    (0..count).map(|_| uniform(u, low, high)).collect()
}

fn vector(u: &mut Unstructured<'_>, size: f64) -> Result<DVec3> {
    Ok(DVec3::from_slice(&numbers(u, 3, -size, size)?))
}

/// A number whose logarithm is uniform.
fn log_uniform(u: &mut Unstructured<'_>, low: f64, high: f64) -> Result<f64> {
    Ok(uniform(u, low.ln(), high.ln())?.exp())
}

/// A kernel's side.
fn kernel_size(u: &mut Unstructured<'_>) -> Result<usize> {
    Ok(2 * u.int_in_range(0..=7)? + 1)
}

#[test]
fn predicted_kernels_sum_to_one() {
    property("kernels", 100, |u| {
        let k = kernel_size(u)?;
        let (height, width) = (u.int_in_range(1..=6)?, u.int_in_range(1..=6)?);
        let config = BpNetConfig {
            kernel_size: k,
            num_frames: 2,
            shortcut: u.arbitrary()?,
            downscale: *u.choose(&[1, 2, 3])?,
            head: *u.choose(&[HeadInit::Mild, HeadInit::Framework])?,
            seed: u.arbitrary()?,
        };
        // From a head at its start to one whose logits differ by thousands.
        let sharper = log_uniform(u, 1.0, 1e4)?;
        let color = numbers(u, height * width * 3, 0.0, 1.0)?;
        let disparity = numbers(u, height * width, 0.0, 3.0)?;
        let mask = numbers(u, height * width, 0.0, 1.0)?;
        for (name, device, dtype) in backends() {
            let mut net = BpNet::new(&config, &device, dtype).expect("a good configuration");
            for (parameter, tensor) in net.parameters_mut() {
                if parameter == "head.kernel.weight" {
                    *tensor = tensor.clone() * sharper;
                }
            }
            let inputs = BlurInputs {
                color: tensor(&color, [height, width, 3], &device, dtype),
                disparity: tensor(&disparity, [height, width], &device, dtype),
                mask: tensor(&mask, [height, width], &device, dtype),
            };
            let field = net.forward(1, &inputs, Extractor::Trained);
            let kernel = values(field.expect("good inputs").kernel());
            // The total by which all are divided is a sum of K² roundings.
            let limit = (k * k + 3) as f64 * rounding(dtype);
            for kernel in kernel.chunks_exact(k * k) {
                assert!(kernel.iter().all(|w| *w >= 0.0), "{name}: {kernel:?}");
                let sum: f64 = kernel.iter().sum();
                assert!((sum - 1.0).abs() <= limit, "{name}, K = {k}: {sum}");
            }
        }
        Ok(())
    });
}

#[test]
fn a_delta_kernel_returns_the_image_whatever_the_intensity() {
    property("delta", 500, |u| {
        let k = kernel_size(u)?;
        let (height, width) = (u.int_in_range(1..=20)?, u.int_in_range(1..=9)?);
        let mut kernel = vec![0.0; height * width * k * k];
        for pixel in kernel.chunks_exact_mut(k * k) {
            pixel[k * k / 2] = 1.0;
        }
        let size = log_uniform(u, 1e-6, 1e6)?;
        let image = numbers(u, height * width * 3, -size, size)?;
        let mut intensity = numbers(u, height * width, 0.0, 1.0)?;
        intensity[0] = *u.choose(&[0.0, 1.0, -5.0, 1e6])?;
        for (name, device, dtype) in backends() {
            let field = BlurField::new(
                tensor(&kernel, [height, width, k * k], &device, dtype),
                tensor(&intensity, [height, width], &device, dtype),
            )
            .expect("the shapes fit");
            let image = tensor::<3>(&image, [height, width, 3], &device, dtype);
            let output = composite(image.clone(), &field).expect("the shapes fit");
            assert_eq!(values(output.picture()), values(image), "{name}, K = {k}");
        }
        Ok(())
    });
}

#[test]
fn blurring_a_constant_image_returns_it_at_the_border_too() {
    property("constant", 500, |u| {
        let k = kernel_size(u)?;
        let (height, width) = (u.int_in_range(1..=12)?, u.int_in_range(1..=5)?);
        // Of any sum, with zeros; now and then nothing is left inside the image.
        let size = log_uniform(u, 1e-9, 1e6)?;
        let zeros = uniform(u, 0.0, 1.0)?;
        let kernel: Vec<f64> = numbers(u, height * width * k * k, 0.0, 1.0)?
            .iter()
            .map(|v| size * (v - zeros).max(0.0))
            .collect();
        let color = numbers(u, 3, -10.0, 10.0)?;
        let intensity = numbers(u, height * width, 0.0, 1.0)?;
        for (name, device, dtype) in backends() {
            let field = BlurField::new(
                tensor(&kernel, [height, width, k * k], &device, dtype),
                tensor(&intensity, [height, width], &device, dtype),
            )
            .expect("the shapes fit");
            let image = tensor::<3>(
                &color.repeat(height * width),
                [height, width, 3],
                &device,
                dtype,
            );
            let blurred = blur(image.clone(), field.kernel()).expect("the shapes fit");
            let mixed = composite(image.clone(), &field).expect("the shapes fit");
            // Numerator and denominator are sums of 2K roundings each; products, the quotient and the
            // mixing with the image add a few.
            let limit = (4 * k + 6) as f64 * rounding(dtype);
            let image = values(image);
            for output in [values(blurred), values(mixed.picture())] {
                for (entry, (a, b)) in output.iter().zip(&image).enumerate() {
                    assert!(
                        (a - b).abs() <= limit * b.abs(),
                        "{name}, K = {k}: entry {entry} is {a}, not {b}"
                    );
                }
            }
        }
        Ok(())
    });
}

/// Two vectors with a sine of about 1e-10 to 1 between them, lengths 1e-13 to 9e8: six numbers.
fn six_numbers(u: &mut Unstructured<'_>) -> Result<[f64; 6]> {
    let a = vector(u, 1.0)?.try_normalize().unwrap_or(DVec3::X);
    let across = a.cross(vector(u, 1.0)?).try_normalize();
    let across = across.unwrap_or(a.any_orthonormal_vector());
    let sine = log_uniform(u, 1e-10, 1.0)?;
    let cosine = (1.0 - sine * sine).sqrt() * *u.choose(&[-1.0, 1.0])?;
    let lengths = [log_uniform(u, 1e-13, 9e8)?, log_uniform(u, 1e-13, 9e8)?];
    let (a1, a2) = (lengths[0] * a, lengths[1] * (cosine * a + sine * across));
    Ok([a1.x, a1.y, a1.z, a2.x, a2.y, a2.z])
}

/// The rotation whose first column is `x` and whose third lies along `x` x `a2`.
fn frame(x: DVec3, a2: DVec3) -> DMat3 {
    let z = x.cross(a2).normalize_or_zero();
    DMat3::from_cols(x, z.cross(x), z)
}

#[test]
fn six_numbers_give_a_rotation_that_follows_them_or_the_documented_axis() {
    const ROWS: usize = 50;
    if backends().is_empty() {
        return;
    }
    let mut kinds = [0; 3];
    property("rotations", 400, |u| {
        let six: Vec<f64> = (0..ROWS)
            .map(|_| six_numbers(u))
            .collect::<Result<Vec<_>>>()?
            .concat();
        let direction = numbers(u, 9 * ROWS, -1.0, 1.0)?;
        for (name, device, dtype) in backends() {
            let device = device.autodiff();
            let six = tensor(&six, [ROWS, 6], &device, dtype).require_grad();
            let rotations = gram_schmidt(six.clone());
            let direction = tensor(&direction, [ROWS, 3, 3], &device, dtype);
            let grads = (rotations.clone() * direction).sum().backward();
            let gradient = values(six.grad(&grads).expect("a gradient"));
            // As they were rounded.
            let (six, rotations) = (values(six), values(rotations));
            for row in 0..ROWS {
                let six = &six[6 * row..6 * row + 6];
                let (a1, a2) = (DVec3::from_slice(six), DVec3::from_slice(&six[3..]));
                let found = DMat3::from_cols_slice(&rotations[9 * row..9 * row + 9]).transpose();
                let gradient = &gradient[6 * row..6 * row + 6];
                let what = format!("{name}: {six:?}: {found}, {gradient:?}");

                let error = found.transpose() * found - DMat3::IDENTITY;
                let limit = if dtype == DType::F32 { 1e-6 } else { 2e-15 };
                assert!(
                    error.abs_diff_eq(DMat3::ZERO, limit) && found.determinant() > 0.0,
                    "not a rotation: {what}"
                );
                // 1 / (length sine), times entries of the direction.
                assert!(
                    gradient.iter().all(|g| g.abs() < 1e19),
                    "a large gradient: {what}"
                );

                // As documented, with the part of a2 across a1 relative to |a2| or, for the shortest,
                // to 1e-12.
                let a1_counts = a1.length() > 1e-12;
                let x = if a1_counts {
                    a1.normalize_or_zero()
                } else {
                    DVec3::X
                };
                let part =
                    x.cross(a2.normalize_or_zero()).length() * (a2.length() / 1e-12).min(1.0);
                let a2_counts = part > 1e-6;
                let axis = if x.y * x.y > 0.8 { DVec3::Z } else { DVec3::Y };
                // Vectors and cross product have a few roundings each; they turn the cross product
                // by as much over the sine. That close to a limit, either side may be taken.
                let roundings = 6.0 * rounding(dtype);
                let beside = |value: f64, limit: f64, error: f64| (value - limit).abs() <= error;
                if beside(a1.length(), 1e-12, 1e-18)
                    || beside(part, 1e-6, roundings)
                    || (!a2_counts && beside(x.y * x.y, 0.8, roundings))
                {
                    continue;
                }
                let second = if a2_counts { a2 } else { axis };
                let expected = frame(x, second);
                let sine = x.cross(second.normalize_or_zero()).length();
                assert!(
                    found.abs_diff_eq(expected, roundings / sine),
                    "not {expected}: {what}"
                );
                for (counts, gradient) in [(a1_counts, &gradient[..3]), (a2_counts, &gradient[3..])]
                {
                    let zero = gradient.iter().all(|&g| g == 0.0);
                    assert_eq!(zero, !counts, "gradient: {what}");
                }
                kinds[usize::from(a1_counts) + usize::from(a2_counts && a1_counts)] += 1;
            }
        }
        Ok(())
    });
    assert!(
        kinds.iter().all(|&count| count > 50),
        "rows without a1, parallel, and followed: {kinds:?}"
    );
}

#[test]
fn motion_weights_are_not_negative_and_sum_to_one_at_most() {
    property("motion weights", 500, |u| {
        let (rows, bases) = (u.int_in_range(1..=20)?, u.int_in_range(1..=20)?);
        let size = log_uniform(u, 0.1, 1e4)?;
        let logits = numbers(u, rows * bases, -size, size)?;
        let rots = numbers(u, bases * 6, -1.0, 1.0)?;
        for (name, device, dtype) in backends() {
            // Frame t holds the weights of bases 3t, 3t + 1 and 3t + 2 as translations.
            let frames = bases.div_ceil(3);
            let mut transls = vec![0.0; bases * frames * 3];
            (0..bases).for_each(|k| transls[k * frames * 3 + k] = 1.0);
            let motion_bases = MotionBases {
                rots: tensor(&rots.repeat(frames), [bases, frames * 6], &device, dtype),
                transls: tensor(&transls, [bases, frames * 3], &device, dtype),
                num_frames: frames,
            };
            let logits = tensor(&logits, [rows, bases], &device, dtype);
            let mut sums = vec![0.0; rows];
            for frame in 0..frames {
                let motion = motion_bases.motion_at(&logits, frame as f32);
                for (i, weight) in values(motion.translations).into_iter().enumerate() {
                    assert!(weight >= 0.0, "{name}: weight {weight}");
                    sums[i / 3] += weight;
                }
            }
            // The total by which all are divided is a sum of B roundings.
            let limit = (bases + 3) as f64 * rounding(dtype);
            for sum in sums {
                assert!((sum - 1.0).abs() <= limit, "{name}: the sum is {sum}");
            }
        }
        Ok(())
    });
}

/// Noisy tracks with gaps of points that turn about different centres.
fn tracks(u: &mut Unstructured<'_>) -> Result<Tracks3d> {
    let (count, frames) = (u.int_in_range(1..=40)?, u.int_in_range(1..=8)?);
    let size = log_uniform(u, 1e-3, 1e3)?;
    let noise = uniform(u, 0.0, 0.1)?;
    let mut tracks = Tracks3d {
        num_frames: frames,
        colors: vec![[0.5; 3]; count],
        ..Tracks3d::default()
    };
    for _ in 0..count {
        let (start, axis) = (vector(u, 1.0)?, vector(u, 0.3)?);
        for t in 0..frames {
            let turned = DQuat::from_scaled_axis(axis * t as f64) * start;
            tracks.positions.push(size * (turned + vector(u, noise)?));
            tracks.visible.push(u.ratio(3, 4)?);
            tracks.confidence.push(uniform(u, 0.1, 1.0)? as f32);
        }
    }
    tracks.visible[0] = true;
    Ok(tracks)
}

#[test]
fn right_after_initialisation_the_canonical_time_is_the_identity() {
    property("time t0", 300, |u| {
        let options = InitOptions {
            num_bases: u.int_in_range(1..=6)?,
            fewest: false,
            seed: u.arbitrary()?,
        };
        let init = initialize(&tracks(u)?, &options).expect("a track is visible");
        let (rows, bases) = (init.tracks.len(), init.num_bases);
        let frames = init.tracks.num_frames;
        let coefficients: Vec<f64> = init.coefficients.iter().map(|&c| f64::from(c)).collect();
        let means = init.tracks.positions.iter().skip(init.canonical_frame);
        let means: Vec<f64> = means.step_by(frames).flat_map(|p| p.to_array()).collect();
        for (name, device, dtype) in backends() {
            let coefficients = tensor(&coefficients, [rows, bases], &device, dtype);
            let motion_bases = MotionBases::from_init(&init, &device, dtype);
            let motion = motion_bases.motion_at(&coefficients, init.canonical_frame as f32);
            // The weights' sum w is not quite 1; w / sqrt(w w) has four roundings.
            let limit = 4.0 * rounding(dtype);
            for rotation in values(motion.rotations.clone()).chunks_exact(9) {
                let rotation = DMat3::from_cols_slice(rotation);
                assert!(
                    rotation.abs_diff_eq(DMat3::IDENTITY, limit),
                    "{name}: {rotation}"
                );
            }
            assert!(
                values(motion.translations.clone())
                    .iter()
                    .all(|&t| t == 0.0),
                "{name}: a translation"
            );
            let means = tensor::<2>(&means, [rows, 3], &device, dtype);
            let one = values(motion.transform_means(&means));
            let all = positions_all_frames(&motion_bases, &coefficients, &means);
            let all = values(
                all.reshape([rows, frames, 3])
                    .narrow(1, init.canonical_frame, 1),
            );
            let means = values(means);
            for moved in [one, all] {
                for (a, b) in moved.iter().zip(&means) {
                    // One more for the product with the mean.
                    let error = (a - b).abs();
                    assert!(
                        error <= 5.0 * rounding(dtype) * b.abs(),
                        "{name}: {b} to {a}"
                    );
                }
            }
        }
        Ok(())
    });
}

#[test]
fn a_picture_warped_into_its_own_pose_comes_back() {
    property("warp", 2000, |u| {
        let (width, height) = (u.int_in_range(1..=20)?, u.int_in_range(1..=20)?);
        let pixels = width * height;
        let camera = Camera::pinhole(
            [width, height],
            [uniform(u, 5.0, 500.0)?, uniform(u, 5.0, 500.0)?],
            [uniform(u, -10.0, 30.0)?, uniform(u, -10.0, 30.0)?],
        );
        // Far from the origin: a point comes back to its pixel to 1e-13 of that distance.
        let far = log_uniform(u, 1.0, 1e4)?;
        let pose = DAffine3::from_rotation_translation(
            DQuat::from_scaled_axis(vector(u, 2.0)?),
            vector(u, far)?,
        );
        let single = |values: Vec<f64>| -> Vec<f32> { values.iter().map(|&v| v as f32).collect() };
        let (color, mask) = (
            single(numbers(u, 3 * pixels, 0.0, 1.0)?),
            single(numbers(u, pixels, 0.0, 1.0)?),
        );
        let mut depth = single(numbers(u, pixels, 0.1, 50.0)?);
        for depth in &mut depth {
            if u.ratio(1, 8)? {
                *depth = *u.choose(&[0.0, f32::INFINITY])?;
            }
        }
        let source = Source {
            camera: &camera,
            cam_from_world: &pose,
            color: &color,
            depth: &depth,
            mask: Some(&mask),
        };
        let options = WarpOptions {
            sharpness: *u.choose(&[0.0, 50.0, 1e6])?,
            edge_jump: f64::INFINITY,
        };
        let warped = warp(&source, &camera, &pose, &options).expect("good input");
        let warped_mask = warped.mask.expect("a mask went in");
        for pixel in 0..pixels {
            let valid = depth[pixel] > 0.0 && depth[pixel].is_finite();
            assert_eq!(warped.valid[pixel], valid, "validity of pixel {pixel}");
            let expected = |value: f32| if valid { value } else { 0.0 };
            for k in 3 * pixel..3 * pixel + 3 {
                assert_eq!(warped.color[k], expected(color[k]), "colour {k}");
            }
            assert_eq!(warped_mask[pixel], expected(mask[pixel]), "mask {pixel}");
            let (found, depth) = (f64::from(warped.depth[pixel]), expected(depth[pixel]));
            let error = (found - f64::from(depth)).abs();
            // The last digit in f32, and the distance's in f64.
            assert!(
                error <= 1.2e-7 * f64::from(depth) + 1e-14 * far,
                "depth of pixel {pixel} is off by {error}"
            );
        }
        Ok(())
    });
}
