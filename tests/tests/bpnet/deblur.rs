//! The blur model against blur that is known: frames of one sharp picture, each with its own line blur,
//! from which picture and model are learned together, as design section 4.1 starts them.

use bpnet::{BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, cell_means, composite};
use burn::tensor::{DType, Device, Gradients, Tensor};
use limpid_tests::{devices_for_long_trainings, tensor, values};
use trainer::adam::{AdamState, AdamStep, LearningRate, adam_step};

const SIZE: usize = 40;
/// The frames are cut out of a larger picture, so that blur carries light over their borders.
const MARGIN: usize = 6;
const FRAMES: usize = 8;

/// Rectangles in front of a slope: edges in many directions and at many scales.
fn picture() -> Vec<f64> {
    let side = SIZE + 2 * MARGIN;
    let mut state = 1_u64;
    let mut draw = |limit: usize| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % limit
    };
    let mut pixels = vec![0.0; side * side * 3];
    for (i, pixel) in pixels.chunks_exact_mut(3).enumerate() {
        pixel.fill(0.3 + 0.3 * (i % side) as f64 / side as f64);
    }
    for _ in 0..90 {
        let (top, left) = (draw(side), draw(side));
        let (bottom, right) = (top + 2 + draw(8), left + 2 + draw(8));
        let slant = draw(3) as isize - 1;
        let color = [draw(256), draw(256), draw(256)].map(|c| c as f64 / 255.0);
        for y in top..bottom.min(side) {
            let shift = slant * (y - top) as isize;
            for x in left..right {
                let x = x as isize + shift;
                if (0..side as isize).contains(&x) {
                    let start = (y * side + x as usize) * 3;
                    pixels[start..start + 3].copy_from_slice(&color);
                }
            }
        }
    }
    pixels
}

/// The picture as a camera saw it that moved by `length` px in the direction `angle`, the middle of its
/// path at rest.
fn line_blur(picture: &[f64], length: f64, angle: f64) -> Vec<f64> {
    const SAMPLES: usize = 41;
    let side = SIZE + 2 * MARGIN;
    let mut output = vec![0.0; SIZE * SIZE * 3];
    for sample in 0..SAMPLES {
        let along = length * (sample as f64 / (SAMPLES - 1) as f64 - 0.5);
        let (dy, dx) = (along * angle.sin(), along * angle.cos());
        for (i, pixel) in output.chunks_exact_mut(3).enumerate() {
            let y = (i / SIZE + MARGIN) as f64 + dy;
            let x = (i % SIZE + MARGIN) as f64 + dx;
            let (y0, x0) = (y.floor(), x.floor());
            let (fy, fx) = (y - y0, x - x0);
            let start = (y0 as usize * side + x0 as usize) * 3;
            for (c, value) in pixel.iter_mut().enumerate() {
                let at = |offset: usize| picture[start + offset + c];
                let upper = (1.0 - fx) * at(0) + fx * at(3);
                let lower = (1.0 - fx) * at(side * 3) + fx * at(side * 3 + 3);
                *value += ((1.0 - fy) * upper + fy * lower) / SAMPLES as f64;
            }
        }
    }
    output
}

fn psnr(a: &[f64], b: &[f64]) -> f64 {
    let square: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
    -10.0 * (square / a.len() as f64).log10()
}

/// A step of Adam on one parameter.
fn step(parameter: &mut Tensor<2>, grads: &Gradients, state: &mut AdamState, rate: f64) {
    let gradient = parameter.grad(grads).expect("every parameter is trained");
    let rate = &LearningRate::Uniform(rate);
    adam_step(parameter, gradient, state, &AdamStep { rate, drawn: &[] });
}

struct Outcome {
    picture: Vec<f64>,
    mean_intensity: Vec<f64>,
    /// Mean over frames and pixels of m Σ k Δ, x and y, in pixels.
    shift: [f64; 2],
}

struct Recipe {
    steps: usize,
    /// Weight of the gauge.
    gauge: f64,
    /// How far to the right of their centre all kernels start, in pixels.
    off_center: f64,
}

/// Learns picture and blur model from the frames, which start from the frames' mean.
fn learn(frames: &[Vec<f64>], start: &[f64], recipe: &Recipe, device: &Device) -> Outcome {
    let device = device.clone().autodiff();
    let steps = recipe.steps;
    let hold = 25.min(steps / 8);
    let config = BpNetConfig {
        kernel_size: 9,
        num_frames: frames.len(),
        shortcut: true,
        downscale: 1,
        head: HeadInit::Mild,
        seed: 3,
    };
    let mut net = BpNet::new(&config, &device, DType::F32).expect("the configuration is valid");
    for (name, parameter) in net.parameters_mut() {
        if name == "head.kernel.bias" {
            let logits: Vec<f64> = (0..81)
                .map(|j| {
                    (
                        f64::from(j % 9) - 4.0 - recipe.off_center,
                        f64::from(j / 9) - 4.0,
                    )
                })
                .map(|(x, y)| -0.5 * (x * x + y * y))
                .collect();
            *parameter = tensor(&logits, [1, 81], &device, DType::F32).require_grad();
        }
    }
    let mut net_states: Vec<AdamState> = net
        .parameters()
        .iter()
        .map(|(_, parameter)| AdamState::new(parameter))
        .collect();
    let mut picture = tensor(start, [SIZE * SIZE, 3], &device, DType::F32).require_grad();
    let mut picture_state = AdamState::new(&picture);
    let seen: Vec<Tensor<3>> = frames
        .iter()
        .map(|frame| tensor(frame, [SIZE, SIZE, 3], &device, DType::F32))
        .collect();
    let inputs = |picture: &Tensor<2>| BlurInputs {
        color: picture.clone().reshape([SIZE, SIZE, 3]),
        disparity: Tensor::ones([SIZE, SIZE], (&device, DType::F32)),
        mask: Tensor::zeros([SIZE, SIZE], (&device, DType::F32)),
    };
    // The gauge's table: each frame's cells as of its last visit.
    let mut table: Vec<Option<Tensor<2>>> = vec![None; frames.len()];

    for k in 0..steps {
        // 5 and 8 have no common divisor: all frames in a mixed order.
        let frame = k * 5 % frames.len();
        let inputs = inputs(&picture);
        let field = net
            .forward(frame, &inputs, Extractor::Trained)
            .expect("the shapes fit");
        let output = composite(inputs.color, &field).expect("the shapes fit");
        let cells = cell_means(output.centroid(), 4, 8);
        table[frame] = None;
        let others = table.iter().flatten().cloned();
        let visited = 1 + table.iter().flatten().count();
        let mean = others.fold(cells.clone(), |sum, cells| sum + cells) / visited as f64;
        let gauge = (mean.clone() * mean).sum_dim(1).mean() * visited as f64;
        let loss = (output.picture() - seen[frame].clone()).abs().mean() + gauge * recipe.gauge;
        table[frame] = Some(cells.detach());

        let grads = loss.backward();
        let decay = 0.1_f64.powf(k as f64 / steps as f64);
        step(&mut picture, &grads, &mut picture_state, 1e-2 * decay);
        if k >= hold {
            for ((_, parameter), state) in net.parameters_mut().into_iter().zip(&mut net_states) {
                step(parameter, &grads, state, 2e-3 * decay);
            }
        }
    }

    let (mut mean_intensity, mut shift) = (Vec::new(), [0.0; 2]);
    for frame in 0..frames.len() {
        let inputs = inputs(&picture);
        let field = net
            .forward(frame, &inputs, Extractor::Frozen)
            .expect("the shapes fit");
        let output = composite(inputs.color, &field).expect("the shapes fit");
        mean_intensity.push(values(field.intensity().mean())[0]);
        let mean = values(cell_means(output.centroid(), 1, 1));
        for axis in 0..2 {
            shift[axis] += mean[axis] / frames.len() as f64;
        }
    }
    Outcome {
        picture: values(picture),
        mean_intensity,
        shift,
    }
}

/// The sharp picture, the frames and their mean.
fn scene() -> (Vec<f64>, Vec<Vec<f64>>, Vec<f64>) {
    let large = picture();
    let frames: Vec<Vec<f64>> = (0..FRAMES)
        .map(|i| {
            let length = 3.0 + 4.0 * (i * 3 % FRAMES) as f64 / (FRAMES - 1) as f64;
            let angle = std::f64::consts::PI * (i as f64 + 0.3) / FRAMES as f64;
            line_blur(&large, length, angle)
        })
        .collect();
    let mean = (0..SIZE * SIZE * 3)
        .map(|i| frames.iter().map(|frame| frame[i]).sum::<f64>() / FRAMES as f64)
        .collect();
    (line_blur(&large, 0.0, 0.0), frames, mean)
}

/// The device that trains, if any. (On ndarray the same kernels run, and each test of their values.)
fn device() -> Option<Device> {
    let mut quick = devices_for_long_trainings().into_iter();
    quick.next().map(|(_, device)| device)
}

#[test]
fn known_blur_is_taken_out_and_the_intensity_neither_dies_nor_saturates() {
    let Some(device) = device() else { return };
    let (sharp, frames, mean) = scene();
    let recipe = Recipe {
        steps: 500,
        gauge: 0.1,
        off_center: 0.0,
    };
    let outcome = learn(&frames, &mean, &recipe, &device);
    let (before, after) = (psnr(&mean, &sharp), psnr(&outcome.picture, &sharp));
    let figures = format!(
        "{before:.2} dB before, {after:.2} dB after, m {:.2?}, shift {:.3?} px",
        outcome.mean_intensity, outcome.shift
    );
    eprintln!("{figures}");
    for m in &outcome.mean_intensity {
        assert!((0.05..0.98).contains(m), "{figures}");
    }
    assert!(outcome.shift.iter().all(|s| s.abs() < 0.1), "{figures}");
    // 28.5 dB against 18.6 when this was written.
    assert!(after > before + 4.0, "{figures}");
}

#[test]
fn the_gauge_takes_a_common_shift_of_the_kernels_out() {
    let Some(device) = device() else { return };
    let (_, frames, mean) = scene();
    let shift = |gauge: f64| {
        let recipe = Recipe {
            steps: 200,
            gauge,
            off_center: 1.0,
        };
        learn(&frames, &mean, &recipe, &device).shift
    };
    let (with, without) = (shift(0.1), shift(0.0));
    eprintln!("shift with the gauge {with:.3?} px, without {without:.3?} px");
    assert!(without[0] > 0.2, "nothing else takes it out: {without:?}");
    assert!(with.iter().all(|s| s.abs() < 0.1), "it remains: {with:?}");
}
