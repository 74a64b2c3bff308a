//! The first fit's loss against its terms as they are defined, in f64, one entry after the other; and its gradient where tracks are
//! too many to perturb each.

use crate::fit::{Moving, shaken_start, two_movers};
use crate::tensors::reference_rotation;
use burn::tensor::DType;
use glam::DVec3;
use limpid_tests::{computes, devices, devices_in, directional_report, values};
use motion_bases::{FitCamera, FitData, InitOptions, MotionInit, fit_loss, initialize};

/// What is fitted, as plain numbers.
struct Numbers {
    rots: Vec<f64>,
    transls: Vec<f64>,
    coefficients: Vec<f64>,
    means: Vec<f64>,
}

impl Numbers {
    /// Softmax weights of a track.
    fn weights(&self, row: usize, bases: usize) -> Vec<f64> {
        let logits = &self.coefficients[row * bases..(row + 1) * bases];
        let total: f64 = logits.iter().map(|v| v.exp()).sum();
        logits.iter().map(|v| v.exp() / total).collect()
    }

    /// Where a track is in a frame, scene units.
    fn position(&self, row: usize, frame: usize, init: &MotionInit) -> DVec3 {
        let (bases, frames) = (init.num_bases, init.tracks.num_frames);
        let weights = self.weights(row, bases);
        let blend = |numbers: &[f64], width: usize, c: usize| -> f64 {
            let of = |b: usize| numbers[(b * frames + frame) * width + c];
            (0..bases).map(|b| weights[b] * of(b)).sum()
        };
        let six: Vec<f64> = (0..6).map(|c| blend(&self.rots, 6, c)).collect();
        let shift = DVec3::from_array([0, 1, 2].map(|c| blend(&self.transls, 3, c)));
        reference_rotation(&six) * DVec3::from_slice(&self.means[3 * row..]) + shift
    }
}

/// Pixel over fx, and depth.
fn pixel(camera: &FitCamera, point: DVec3) -> ([f64; 2], f64) {
    let at = camera.cam_from_world.transform_point3(point);
    let u = camera.fx * at.x / at.z + camera.cx;
    let v = camera.fy * at.y / at.z + camera.cy;
    ([u / camera.fx, v / camera.fx], at.z)
}

fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.into_iter().collect();
    values.iter().sum::<f64>() / values.len() as f64
}

/// The terms that `fit_loss` names, of the tracks in `rows`, where the bases' smoothness weighs `smooth`.
fn defined(
    numbers: &Numbers,
    (init, cameras): (&MotionInit, &[FitCamera]),
    rows: &[usize],
    smooth: f64,
) -> f64 {
    let (tracks, frames, bases) = (&init.tracks, init.tracks.num_frames, init.num_bases);
    let extent = init.extent;
    let at = |row: usize, t: usize| numbers.position(row, t, init) / extent;
    let entries = || rows.iter().flat_map(|row| (0..frames).map(|t| (*row, t)));

    let (mut sum, mut weight) = (0.0, 0.0);
    let mut hidden = Vec::new();
    for (row, t) in entries() {
        let i = tracks.index(row, t);
        let confidence = f64::from(tracks.confidence[i]);
        if tracks.visible[i] {
            let off = (at(row, t) - tracks.positions[i] / extent).abs();
            sum += confidence * (off.x + off.y + off.z);
            weight += confidence;
        } else if confidence > 0.0 {
            let ([u, v], _) = pixel(&cameras[t], at(row, t) * extent);
            let ([seen_u, seen_v], depth) = pixel(&cameras[t], init.observed[i]);
            if depth > 0.0 {
                hidden.push((0.5 * ((u - seen_u).abs() + (v - seen_v).abs()), confidence));
            }
        }
    }
    let to_tracks = sum / (3.0 * weight);
    hidden.sort_by(|a, b| a.0.total_cmp(&b.0));
    let counted = if hidden.is_empty() {
        0
    } else {
        (0.95 * (hidden.len() - 1) as f64).floor() as usize + 1
    };
    let (mut to_pixels, mut total) = (0.0, 0.0);
    for (error, confidence) in &hidden[..counted] {
        to_pixels += error * confidence;
        total += confidence;
    }
    if counted > 0 {
        to_pixels /= total;
    }
    let square = |row: &usize| {
        numbers
            .weights(*row, bases)
            .iter()
            .map(|w| w * w)
            .sum::<f64>()
    };
    let sparse = 1.0 - mean(rows.iter().map(square));
    let mut loss = to_tracks + 0.5 * to_pixels + 0.01 * sparse;
    if frames < 3 {
        return loss;
    }

    let length = |squares: f64| (squares.sqrt() - 1e-6).max(0.0);
    let inner = || 1..frames - 1;
    let of_bases = |numbers: &[f64], width: usize, scale: f64| {
        let second = |b: usize, t: usize, c: usize| {
            let v = |t: usize| numbers[(b * frames + t) * width + c] / scale;
            v(t + 1) - 2.0 * v(t) + v(t - 1)
        };
        let one = |b: usize, t: usize| length((0..width).map(|c| second(b, t, c).powi(2)).sum());
        mean(
            (0..bases)
                .flat_map(|b| inner().map(move |t| (b, t)))
                .map(|(b, t)| one(b, t)),
        )
    };
    loss +=
        smooth * (of_bases(&numbers.rots, 6, 1.0) + 2.0 * of_bases(&numbers.transls, 3, extent));
    let paths = || rows.iter().flat_map(|row| inner().map(|t| (*row, t)));
    loss += 0.5
        * smooth
        * mean(paths().map(|(row, t)| {
            length((at(row, t + 1) - 2.0 * at(row, t) + at(row, t - 1)).length_squared())
        }));
    let along = |row: usize, t: usize, step: DVec3| {
        let center = cameras[t].cam_from_world.inverse().translation / extent;
        let ray = at(row, t) - center;
        step.dot(ray).powi(2) / ray.length_squared()
    };
    loss + 0.1 * mean(paths().map(|(row, t)| along(row, t, at(row, t) - at(row, t - 1))))
        + 0.1 * mean(paths().map(|(row, t)| along(row, t, at(row, t + 1) - at(row, t))))
}

#[test]
fn the_loss_is_the_sum_of_its_terms() {
    for (tracks_each, frames, num_bases) in
        [(1, 1, 1), (9, 2, 2), (20, 3, 2), (150, 9, 5), (2500, 8, 3)]
    {
        let scene = two_movers(tracks_each, frames, 0.05);
        let options = InitOptions {
            num_bases,
            fewest: false,
            seed: 2,
        };
        let init = initialize(&scene.tracks, &options).unwrap();
        let data = FitData::new(&init, &scene.cameras).unwrap();
        let [rots, transls, coefficients, means] = shaken_start(&init).map(|(_, _, values)| values);
        let numbers = Numbers {
            rots,
            transls,
            coefficients,
            means,
        };
        let tracks = init.tracks.len();
        let groups = (tracks * frames).div_ceil(36_000);
        for (step, smooth) in [(0, 0.01), (4, 0.01), (7, 0.055), (9, 0.085)] {
            let rows: Vec<usize> = (step % groups..tracks).step_by(groups).collect();
            let expected = defined(&numbers, (&init, &scene.cameras), &rows, smooth);
            for (name, device) in devices() {
                // Sums of confidences, by which terms are divided, have 1e-8 added.
                for (dtype, limit) in [(DType::F64, 1e-8), (DType::F32, 1e-5)] {
                    if !computes(name, &device, dtype) {
                        continue;
                    }
                    let moving = Moving::new(&shaken_start(&init), frames, &device, dtype);
                    let found = fit_loss(&moving.fit(), &data, step, 10).into_scalar::<f64>();
                    assert!(
                        (found - expected).abs() <= limit * expected,
                        "{name}, {dtype:?}, {tracks} tracks, {frames} frames, step {step}: {found}, not {expected}"
                    );
                }
            }
        }
    }
}

#[test]
fn many_tracks_have_the_right_gradient() {
    for (name, device) in devices_in(DType::F64) {
        let device = device.autodiff();
        let scene = two_movers(2500, 8, 0.05);
        let options = InitOptions {
            num_bases: 3,
            fewest: false,
            seed: 2,
        };
        let init = initialize(&scene.tracks, &options).unwrap();
        let data = FitData::new(&init, &scene.cameras).unwrap();
        let start = shaken_start(&init);
        // A factor behind the loss reaches all gradients.
        let loss = |moving: &Moving| fit_loss(&moving.fit(), &data, 9, 10) * -2.5;
        let moving = Moving::new(&start, 8, &device, DType::F64).leaves();
        let grads = loss(&moving).backward();
        let gradient = moving
            .tensors()
            .map(|leaf| values(leaf.grad(&grads).unwrap()));
        let report = directional_report(&gradient.concat(), 8, 1e-7, 11, |step| {
            let mut moved = start.clone();
            let mut steps = step.iter();
            for (_, _, numbers) in &mut moved {
                numbers
                    .iter_mut()
                    .zip(&mut steps)
                    .for_each(|(v, s)| *v += s);
            }
            loss(&Moving::new(&moved, 8, &device, DType::F64)).into_scalar::<f64>()
        });
        // Some of the 36,000 entries go through a kink of their L1 within a step.
        assert!(report.l2 < 1e-5, "{name}: {report}");
    }
}
