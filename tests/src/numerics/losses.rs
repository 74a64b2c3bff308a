//! The trainer's losses, and Adam, at their extremes.

use super::case::{Case, Results, scaled};
use crate::{map_like, noise, tensor, unit_noise, values};
use burn::tensor::Tensor;
use trainer::adam::{AdamState, AdamStep, LearningRate, adam_step};
use trainer::losses::{depth_loss, mask_loss, photometric};

/// A loss of one rank-2 input.
fn loss_case(
    op: &'static str,
    name: &str,
    shape: [usize; 2],
    input: Vec<f64>,
    loss: impl Fn(Tensor<2>) -> Tensor<1> + 'static,
) -> Case {
    Case::new(op, name, vec![input], move |inputs, place| {
        let (device, dtype) = place.options();
        let input = tensor(&inputs[0], shape, &device, dtype).require_grad();
        let loss = loss(input.clone());
        let grads = loss.backward();
        let gradient = input
            .grad(&grads)
            .map_or_else(|| vec![0.0; inputs[0].len()], values);
        Results {
            forward: vec![("loss", values(loss))],
            backward: vec![("input", gradient)],
        }
    })
}

fn image_case(name: &str, [h, w]: [usize; 2], picture: Vec<f64>, target: Vec<f64>) -> Case {
    let target: Vec<f64> = target.iter().map(|v| f64::from(*v as f32)).collect();
    loss_case("L1 and SSIM", name, [h * w, 3], picture, move |x| {
        let target = tensor(&target, [h, w, 3], &x.device(), x.dtype());
        photometric(x.reshape([h, w, 3]), target, 0.2)
    })
}

fn depth_case(name: &str, depth: Vec<f64>, alpha: f64, given: Vec<f32>) -> Case {
    let (h, w) = (8, 10);
    loss_case("depth loss", name, [h, w], depth, move |x| {
        let alpha = x.full_like(f64::from(alpha as f32));
        let given = map_like(&given, &x);
        depth_loss(x, &alpha, given, [3.0, 0.05])
    })
}

fn mask_case(name: &str, target: Vec<f32>) -> Case {
    loss_case("mask loss", name, [9, 12], unit_noise(108, 4), move |x| {
        let target = map_like(&target, &x);
        mask_loss(x, target, None, 1)
    })
}

/// Five steps of Adam on one row.
fn adam_case(name: &str, gradient: f64) -> Case {
    let inputs = vec![noise(4, 31), scaled(4, 32, gradient, 0.0)];
    Case::new("Adam", name, inputs, |inputs, place| {
        let (device, dtype) = place.options();
        let row = |v: &[f64]| tensor::<2>(v, [1, 4], &device.clone().inner(), dtype);
        let mut parameter = row(&inputs[0]);
        let mut state = AdamState::new(&parameter);
        let rate = &LearningRate::Uniform(0.01);
        for _ in 0..5 {
            let step = AdamStep { rate, drawn: &[] };
            adam_step(&mut parameter, row(&inputs[1]), &mut state, &step);
        }
        Results {
            forward: vec![("parameter", values(parameter))],
            backward: Vec::new(),
        }
    })
}

pub(super) fn cases() -> Vec<Case> {
    let [h, w] = [13, 15];
    let texture = unit_noise(h * w * 3, 5);
    let other = unit_noise(h * w * 3, 6);
    let flat = |v: f64| vec![v; h * w * 3];
    let relief = || scaled(80, 7, 1.0, 3.0);
    let given = || {
        relief()
            .iter()
            .map(|v| 1.03 * *v as f32 + 0.05)
            .collect::<Vec<f32>>()
    };
    vec![
        image_case("ordinary", [h, w], texture.clone(), other.clone()),
        image_case("equal pictures", [h, w], texture.clone(), texture.clone()),
        image_case(
            "a constant against texture",
            [h, w],
            flat(0.5),
            other.clone(),
        ),
        image_case("black against white", [h, w], flat(0.0), flat(1.0)),
        image_case(
            "colours of 1e4",
            [h, w],
            scaled(h * w * 3, 5, 1e4, 0.0),
            other,
        ),
        image_case("a picture of 1 x 1", [1, 1], vec![0.3; 3], vec![0.6; 3]),
        image_case(
            "a picture of 1 x 20",
            [1, 20],
            unit_noise(60, 5),
            unit_noise(60, 6),
        ),
        depth_case("ordinary", relief(), 1.0, given()),
        depth_case("a constant depth", vec![3.0; 80], 1.0, vec![4.0; 80]),
        depth_case("depths of zero", vec![0.0; 80], 1.0, given()),
        depth_case("no depth given", relief(), 1.0, vec![0.0; 80]),
        depth_case("depths of 1e6", scaled(80, 7, 1e6, 2e6), 1.0, given()),
        mask_case(
            "ordinary",
            (0..108).map(|k| f32::from(u8::from(k % 12 > 5))).collect(),
        ),
        mask_case("a mask of zeros", vec![0.0; 108]),
        mask_case("a mask of ones", vec![1.0; 108]),
        adam_case("gradients of 1", 1.0),
        adam_case("gradients of 1e-30", 1e-30),
        adam_case("gradients of 1e30", 1e30),
    ]
}
