//! Motion bases as tensors: transforms against hand calculation, gradients against differences.

use burn::tensor::{DType, Device, Tensor, TensorData};
use glam::{DMat3, DVec3};
use limpid_tests::{
    GradLimits, check_gradients, computes, devices, devices_in, noise, tensor, values,
};
use motion_bases::{
    MotionBases, along_ray, gram_schmidt, means_acceleration, positions_all_frames,
};

pub(crate) fn assert_close(found: &[f64], expected: &[f64], limit: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (k, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!((a - b).abs() <= limit, "{what}: entry {k} is {a}, not {b}");
    }
}

/// The textbook's Gram–Schmidt; row-major rotation.
pub(crate) fn reference_rotation(six: &[f64]) -> DMat3 {
    let (a1, a2) = (DVec3::from_slice(&six[..3]), DVec3::from_slice(&six[3..6]));
    let x = a1 / a1.length();
    let p = a2 - a2.dot(x) * x;
    let y = p / p.length();
    DMat3::from_cols(x, y, x.cross(y))
}

fn row_major(m: DMat3) -> [f64; 9] {
    m.transpose().to_cols_array()
}

pub(crate) const IDENTITY: [f64; 6] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
/// 90 degrees about z: x goes to y, y to -x.
const QUARTER: [f64; 6] = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0];

/// Two bases over three frames. The first turns by 90 degrees in frame 1, the second never.
fn two_bases(device: &Device, dtype: DType) -> MotionBases {
    let rots = [IDENTITY, QUARTER, IDENTITY, IDENTITY, IDENTITY, IDENTITY].concat();
    let transls = [
        [0.0, 0.0, 0.0],
        [1.0, 2.0, 3.0],
        [4.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [3.0, 0.0, 1.0],
        [0.0, 8.0, 0.0],
    ]
    .concat();
    MotionBases {
        rots: tensor(&rots, [2, 18], device, dtype),
        transls: tensor(&transls, [2, 9], device, dtype),
        num_frames: 3,
    }
}

#[test]
fn transforms_agree_with_hand_calculation() {
    for (name, device) in devices() {
        for dtype in [DType::F32, DType::F64] {
            if !computes(name, &device, dtype) {
                continue;
            }
            let bases = two_bases(&device, dtype);
            // All of the first basis, all of the second, half of each.
            let logits = tensor(&[60.0, 0.0, 0.0, 60.0, 7.0, 7.0], [3, 2], &device, dtype);
            let means = tensor(
                &[1.0, 0.0, 5.0, 1.0, 0.0, 5.0, 1.0, 0.0, 5.0],
                [3, 3],
                &device,
                dtype,
            );
            let at = |time: f32| values(bases.motion_at(&logits, time).transform_means(&means));
            let still = [1.0, 0.0, 5.0];
            assert_close(&at(0.0), &[still, still, still].concat(), 1e-6, name);
            // Half of a quarter turn: the 6D vectors' mean is (½, ½, 0, -½, ½, 0), 45 degrees.
            let half = 0.5_f64.sqrt();
            let expected = [
                [1.0, 3.0, 8.0],
                [4.0, 0.0, 6.0],
                [2.0 + half, 1.0 + half, 7.0],
            ];
            assert_close(&at(1.0), &expected.concat(), 2e-6, name);
            let expected = [[5.0, 0.0, 5.0], [1.0, 8.0, 5.0], [3.0, 4.0, 5.0]];
            assert_close(&at(2.0), &expected.concat(), 2e-6, name);
            // Half-way in time is half-way between the 6D vectors too; translations are their mean.
            let found = at(0.5);
            assert_close(&found[..3], &[0.5 + half, 1.0 + half, 6.5], 2e-6, name);
            // Outside, the ends hold.
            assert_eq!(
                (at(-3.0), at(1e9), at(f32::INFINITY)),
                (at(0.0), at(2.0), at(2.0)),
                "{name}"
            );
            let motion = bases.motion_at(&logits, 1.0);
            let expected = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
            assert_close(&values(motion.rotations)[..9], &expected, 1e-6, name);
        }
    }
}

#[test]
fn a_fractional_time_interpolates_before_gram_schmidt() {
    for (name, device) in devices_in(DType::F64) {
        let (b, n, f) = (3, 4, 5);
        let (rots, transls, logits) = (noise(b * n * 6, 1), noise(b * n * 3, 2), noise(f * b, 3));
        let bases = MotionBases {
            rots: tensor(&rots, [b, n * 6], &device, DType::F64),
            transls: tensor(&transls, [b, n * 3], &device, DType::F64),
            num_frames: n,
        };
        let motion = bases.motion_at(&tensor(&logits, [f, b], &device, DType::F64), 1.75);
        let (rotations, translations) = (values(motion.rotations), values(motion.translations));
        for g in 0..f {
            let weights: Vec<f64> = logits[g * b..(g + 1) * b].iter().map(|l| l.exp()).collect();
            let total: f64 = weights.iter().sum();
            let blend = |frames: &[f64], width: usize, c: usize| -> f64 {
                (0..b)
                    .map(|k| {
                        let at = |t: usize| frames[(k * n + t) * width + c];
                        weights[k] / total * (0.25 * at(1) + 0.75 * at(2))
                    })
                    .sum()
            };
            let six: Vec<f64> = (0..6).map(|c| blend(&rots, 6, c)).collect();
            let expected = row_major(reference_rotation(&six));
            assert_close(&rotations[9 * g..9 * g + 9], &expected, 1e-12, name);
            let expected: Vec<f64> = (0..3).map(|c| blend(&transls, 3, c)).collect();
            assert_close(&translations[3 * g..3 * g + 3], &expected, 1e-12, name);
        }
    }
}

#[test]
fn all_frames_at_once_are_the_frames_one_by_one() {
    for (name, device) in devices_in(DType::F64) {
        let (b, n, f) = (4, 5, 7);
        let bases = MotionBases {
            rots: tensor(&noise(b * n * 6, 4), [b, n * 6], &device, DType::F64),
            transls: tensor(&noise(b * n * 3, 5), [b, n * 3], &device, DType::F64),
            num_frames: n,
        };
        let logits = tensor(&noise(f * b, 6), [f, b], &device, DType::F64);
        let means = tensor(&noise(f * 3, 7), [f, 3], &device, DType::F64);
        let all = values(positions_all_frames(&bases, &logits, &means));
        for t in 0..n {
            let one = values(bases.motion_at(&logits, t as f32).transform_means(&means));
            let of_all: Vec<f64> = (0..3 * f)
                .map(|i| all[(i / 3 * n + t) * 3 + i % 3])
                .collect();
            assert_close(&of_all, &one, 1e-12, name);
        }
        let times = [0.0, 2.25, 1.5, 9.0];
        let (moved, _) = bases.moved_at(&logits, &means, &times);
        for (t, time) in times.iter().enumerate() {
            let one = values(bases.motion_at(&logits, *time).transform_means(&means));
            let at = values(moved.clone().narrow(0, t, 1));
            assert_close(&at, &one, 1e-12, name);
        }
    }
}

/// Six numbers per basis and frame, some of which have no direction or are parallel.
fn degenerate(count: usize) -> Vec<f64> {
    let mut six = noise(count * 6, 21);
    for (k, row) in six.chunks_exact_mut(6).enumerate() {
        match k % 7 {
            1 => row[..3].fill(0.0),
            2 => row.copy_from_slice(&[0.3, 0.1, -0.2, 0.6, 0.2, -0.4]),
            3 => row.copy_from_slice(&[0.0, 2.0, 0.1, 0.0, 4.0, 0.2]),
            4 => row[3..].fill(0.0),
            5 => row.iter_mut().for_each(|v| *v *= 1e-13),
            _ => {}
        }
    }
    six
}

#[test]
fn the_op_is_its_tensor_operations() {
    // More Gaussians than one task has, and no multiple of a vector; a basis each, so that some rows are degenerate.
    for (name, device) in devices() {
        let (b, n, f) = (14, 3, 531);
        let mut logits = noise(f * b, 22);
        for (g, row) in logits.chunks_exact_mut(b).enumerate().take(4 * b) {
            row[g % b] = 80.0;
        }
        let inputs = [
            ("rots", [b, n * 6], degenerate(b * n)),
            ("transls", [b, n * 3], noise(b * n * 3, 23)),
            ("coefficients", [f, b], logits),
            ("means", [f, 3], noise(f * 3, 24)),
        ];
        for (dtype, limit) in [(DType::F64, 1e-11), (DType::F32, 2e-4)] {
            if !computes(name, &device, dtype) {
                continue;
            }
            let run = |fused: bool| -> Vec<Vec<f64>> {
                let leaf = |(_, shape, v): &(&str, [usize; 2], Vec<f64>)| {
                    tensor(v, *shape, &device.clone().autodiff(), dtype).require_grad()
                };
                let t: Vec<Tensor<2>> = inputs.iter().map(leaf).collect();
                let bases = MotionBases {
                    rots: t[0].clone(),
                    transls: t[1].clone(),
                    num_frames: n,
                };
                let times = [0.0, 1.0, 1.75];
                let (moved, rotations) = if fused {
                    bases.moved_at(&t[2], &t[3], &times)
                } else {
                    let motions = times.map(|time| bases.motion_at(&t[2], time));
                    let moved = motions.each_ref().map(|m| m.transform_means(&t[3]));
                    (
                        Tensor::stack(moved.to_vec(), 0),
                        Tensor::stack(motions.map(|m| m.rotations).to_vec(), 0),
                    )
                };
                let weigh = |x: Tensor<1>, seed| {
                    let [count] = x.dims();
                    let weights = tensor(&noise(count, seed), [count], &device, dtype);
                    (x * Tensor::from_inner(weights)).sum()
                };
                let loss = weigh(moved.clone().flatten(0, 2), 25)
                    + weigh(rotations.clone().flatten(0, 3), 26);
                let grads = loss.backward();
                let mut all = vec![values(moved), values(rotations)];
                all.extend(
                    t.iter()
                        .map(|t| values(t.grad(&grads).expect("a gradient"))),
                );
                all
            };
            let kinds = [
                "means",
                "rotations",
                "d rots",
                "d transls",
                "d logits",
                "d means",
            ];
            for ((kind, fused), plain) in kinds.iter().zip(run(true)).zip(run(false)) {
                let size = plain.iter().fold(1.0_f64, |a, v| a.max(v.abs()));
                assert_close(&fused, &plain, limit * size, &format!("{name}: {kind}"));
            }
        }
    }
}

#[test]
fn no_gaussian_is_no_error() {
    for (name, device) in devices() {
        let bases = two_bases(&device, DType::F32);
        let (logits, means) = (
            tensor(&[], [0, 2], &device, DType::F32),
            tensor(&[], [0, 3], &device, DType::F32),
        );
        let motion = bases.motion_at(&logits, 0.5);
        assert_eq!(motion.rotations.dims(), [0, 3, 3], "{name}");
        assert_eq!(motion.transform_means(&means).dims(), [0, 3], "{name}");
        let (moved, rotations) = bases.moved_at(&logits, &means, &[0.0, 0.5]);
        assert_eq!(moved.dims(), [2, 0, 3], "{name}");
        assert_eq!(rotations.dims(), [2, 0, 3, 3], "{name}");
        assert_eq!(
            values(means_acceleration([&means, &means, &means], 1.0)),
            [0.0],
            "{name}"
        );
        assert_eq!(
            values(along_ray([&means, &means, &means], DVec3::ZERO, 1.0)),
            [0.0],
            "{name}"
        );
    }
}

#[test]
fn every_six_numbers_give_a_rotation_and_finite_gradients() {
    // Name, six numbers, and the rotation where it is known.
    type Case = (&'static str, [f64; 6], Option<[f64; 9]>);
    let cases: [Case; 12] = [
        (
            "zeros",
            [0.0; 6],
            Some([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        ),
        ("no a1", [0.0, 0.0, 0.0, 0.0, 0.0, 2.0], None),
        (
            "no a2",
            [0.0, 0.0, 3.0, 0.0, 0.0, 0.0],
            Some([0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]),
        ),
        ("parallel", [0.3, 0.1, -0.2, 0.6, 0.2, -0.4], None),
        ("opposite", [0.3, 0.1, -0.2, -0.3, -0.1, 0.2], None),
        (
            "parallel to y",
            [0.0, 0.4, 0.0, 0.0, 0.7, 0.0],
            Some([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
        ),
        ("nearly parallel", [1.0, 0.0, 0.0, 1.0, 2e-3, 0.0], None),
        (
            "all but parallel",
            [0.3, 0.1, -0.2, 0.6, 0.2, -0.400003],
            None,
        ),
        ("tiny", [1e-20, 0.0, 0.0, 0.0, 1e-20, 1e-20], None),
        ("huge", [1e30, 2e30, -1e30, 5e29, -1e29, 1e30], None),
        ("huge and small", [1e8, 0.0, 0.0, 1e-3, 1e-3, 0.0], None),
        ("plain", [0.5, -0.2, 0.1, 0.3, 0.9, -0.4], None),
    ];
    let rows: Vec<f64> = cases.iter().flat_map(|c| c.1).collect();
    for (name, device) in devices() {
        for (dtype, limit) in [(DType::F32, 1e-6), (DType::F64, 1e-14)] {
            if !computes(name, &device, dtype) {
                continue;
            }
            let device = device.clone().autodiff();
            let six = tensor(&rows, [cases.len(), 6], &device, dtype).require_grad();
            let rotations = gram_schmidt(six.clone());
            let direction = Tensor::<3>::from_data(
                TensorData::new(noise(9 * cases.len(), 8), [cases.len(), 3, 3]),
                (&device, dtype),
            );
            let grads = (rotations.clone() * direction).sum().backward();
            let gradient = values(six.grad(&grads).expect("a gradient"));
            let rotations = values(rotations);
            for (k, (case, input, expected)) in cases.iter().enumerate() {
                let what = format!("{name}, {dtype:?}, {case}");
                let found = DMat3::from_cols_slice(&rotations[9 * k..9 * k + 9]).transpose();
                let product = row_major(found.transpose() * found);
                assert_close(&product, &row_major(DMat3::IDENTITY), limit, &what);
                assert!(
                    (found.determinant() - 1.0).abs() < limit,
                    "{what}: a reflection"
                );
                let gradient = &gradient[6 * k..6 * k + 6];
                assert!(
                    gradient.iter().all(|v| v.is_finite()),
                    "{what}: gradient {gradient:?}"
                );
                if let Some(expected) = expected {
                    assert_close(&row_major(found), expected, 1e-6, &what);
                }
                let replaced = |part: &[f64]| part.iter().all(|&v| v == 0.0);
                if replaced(&input[..3]) {
                    assert!(replaced(&gradient[..3]), "{what}: gradient {gradient:?}");
                }
                if replaced(&input[3..])
                    || case.contains("opposite")
                    || case.starts_with("parallel")
                {
                    assert!(replaced(&gradient[3..]), "{what}: gradient {gradient:?}");
                }
            }
        }
    }
}

#[test]
fn gram_schmidt_has_the_right_gradient() {
    // Each with a step that is small against the sine. The last a2 is parallel to a1: R still depends
    // on a1.
    let across = |sine: f64| vec![0.3, 0.1, -0.2, 0.6 + sine, 0.2 - sine, -0.4];
    let cases = [
        (noise(4 * 6, 9), 1e-5),
        (across(1e-2), 1e-6),
        (across(1e-3), 1e-7),
        (across(1e-5), 1e-9),
        (across(0.0), 1e-8),
    ];
    for (_, device) in devices_in(DType::F64) {
        for (six, step) in &cases {
            let rows = six.len() / 6;
            let direction = tensor(&noise(rows * 9, 10), [rows, 9], &device, DType::F64);
            check_gradients(
                &device,
                &[("six", [rows, 6], six.clone())],
                &[],
                GradLimits {
                    step: *step,
                    ..GradLimits::default()
                },
                |x| {
                    let direction = Tensor::from_inner(direction.clone());
                    (gram_schmidt(x[0].clone()).reshape([rows, 9]) * direction).sum()
                },
            );
        }
    }
}

#[test]
fn motion_has_the_right_gradient() {
    for (_, device) in devices_in(DType::F64) {
        let (b, n, f) = (3, 3, 4);
        let inputs = [
            ("rots", [b, n * 6], noise(b * n * 6, 11)),
            ("transls", [b, n * 3], noise(b * n * 3, 12)),
            ("coefficients", [f, b], noise(f * b, 13)),
            ("means", [f, 3], noise(f * 3, 14)),
        ];
        let direction = tensor(&noise(f * 3, 15), [f, 3], &device, DType::F64);
        for time in [0.4, 1.0] {
            check_gradients(&device, &inputs, &[], GradLimits::default(), |x| {
                let bases = MotionBases {
                    rots: x[0].clone(),
                    transls: x[1].clone(),
                    num_frames: n,
                };
                let (moved, rotations) = bases.moved_at(&x[2], &x[3], &[time]);
                let moved = moved.reshape([f, 3]) * Tensor::from_inner(direction.clone());
                moved.sum() + rotations.narrow(3, 0, 2).sin().sum()
            });
        }
        check_gradients(&device, &inputs, &[], GradLimits::default(), |x| {
            let bases = MotionBases {
                rots: x[0].clone(),
                transls: x[1].clone(),
                num_frames: n,
            };
            positions_all_frames(&bases, &x[2], &x[3]).square().sum()
        });
    }
}

#[test]
fn an_exposure_sees_the_motion_at_its_moments_and_beyond_the_ends() {
    for (name, device) in devices_in(DType::F64) {
        let bases = two_bases(&device, DType::F64);
        let logits = tensor(&[1.0, 0.0, -2.0, 0.5], [2, 2], &device, DType::F64);
        let means = tensor(&noise(6, 5), [2, 3], &device, DType::F64);
        let times = [0.25, 1.0, 1.75, -0.25, 2.25, 9.0];
        let at = Tensor::<1>::from_data(times, (&device, DType::F64));
        let (moved, rotations) = bases.exposed_at(&logits, &means, &at, &times);
        assert_eq!(moved.dims(), [6, 2, 3], "{name}");
        for (i, time) in times.into_iter().enumerate().take(3) {
            let motion = bases.motion_at(&logits, time as f32);
            let (found, turned) = (
                moved.clone().narrow(0, i, 1),
                rotations.clone().narrow(0, i, 1),
            );
            let expected = values(motion.transform_means(&means));
            assert_close(&values(found), &expected, 1e-12, name);
            assert_close(&values(turned), &values(motion.rotations), 1e-12, name);
        }
        // Translations alone go on as they came: the second basis, whose rotation stays.
        let one = tensor(&[-60.0, 60.0], [1, 2], &device, DType::F64);
        let origin = tensor(&[0.0; 3], [1, 3], &device, DType::F64);
        let (moved, _) = bases.exposed_at(&one, &origin, &at, &times);
        let moved = values(moved);
        assert_close(
            &moved[9..12],
            &[-0.75, 0.0, -0.25],
            1e-12,
            "before the first frame",
        );
        assert_close(
            &moved[12..15],
            &[-0.75, 10.0, -0.25],
            1e-12,
            "after the last frame",
        );
        assert_close(
            &moved[15..18],
            &[-1.5, 12.0, -0.5],
            1e-12,
            "no more than half a frame",
        );
    }
}

#[test]
fn an_exposures_moments_have_gradients() {
    for (_, device) in devices_in(DType::F64) {
        let means = noise(6, 5);
        let inputs = [("times", [1, 4], vec![0.3, 0.8, 1.4, 2.2])];
        check_gradients(&device, &inputs, &[], GradLimits::default(), |t| {
            let device = t[0].device();
            let bases = two_bases(&device, DType::F64);
            let logits = tensor(&[1.0, 0.0, -2.0, 0.5], [2, 2], &device, DType::F64);
            let means = tensor(&means, [2, 3], &device, DType::F64);
            let times = t[0].clone().reshape([4]);
            let known = values(times.clone());
            let (moved, rotations) = bases.exposed_at(&logits, &means, &times, &known);
            moved.sin().sum() + rotations.narrow(2, 0, 1).sum()
        });
    }
}
