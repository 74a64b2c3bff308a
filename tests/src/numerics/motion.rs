//! The motion bases at their extremes.

use super::case::{Case, Results, weigh};
use crate::{noise, tensor, values};
use burn::tensor::Tensor;
use motion_bases::MotionBases;

/// Gaussians.
const ROWS: usize = 4;

#[derive(Clone)]
struct Input {
    bases: usize,
    frames: usize,
    time: f32,
    rots: Vec<f64>,
    transls: Vec<f64>,
    coefficients: Vec<f64>,
    means: Vec<f64>,
}

fn ordinary(bases: usize, frames: usize) -> Input {
    Input {
        bases,
        frames,
        time: 0.4,
        rots: noise(bases * frames * 6, 11),
        transls: noise(bases * frames * 3, 12),
        coefficients: noise(ROWS * bases, 13),
        means: noise(ROWS * 3, 14),
    }
}

fn case(name: &str, input: Input) -> Case {
    let Input {
        bases,
        frames,
        time,
        ..
    } = input;
    let inputs = vec![input.rots, input.transls, input.coefficients, input.means];
    Case::new("motion", name, inputs, move |inputs, place| {
        let (device, dtype) = place.options();
        let shapes = [
            [bases, frames * 6],
            [bases, frames * 3],
            [ROWS, bases],
            [ROWS, 3],
        ];
        let t: Vec<Tensor<2>> = inputs
            .iter()
            .zip(shapes)
            .map(|(v, shape)| tensor(v, shape, &device, dtype).require_grad())
            .collect();
        let model = MotionBases {
            rots: t[0].clone(),
            transls: t[1].clone(),
            num_frames: frames,
        };
        let (moved, rotations) = model.moved_at(&t[2], &t[3], &[time]);
        let (moved, rotations) = (moved.reshape([ROWS, 3]), rotations.reshape([ROWS, 9]));
        let grads = (weigh(rotations.clone(), 15) + weigh(moved.clone(), 16)).backward();
        let names = ["rots", "transls", "coefficients", "means"];
        Results {
            forward: vec![("rotations", values(rotations)), ("means", values(moved))],
            backward: names
                .into_iter()
                .zip(&t)
                .map(|(name, t)| (name, values(t.grad(&grads).expect("every input is used"))))
                .collect(),
        }
    })
}

pub(super) fn cases() -> Vec<Case> {
    let edited = |name: &str, bases: usize, frames: usize, edit: &dyn Fn(&mut Input)| {
        let mut input = ordinary(bases, frames);
        edit(&mut input);
        case(name, input)
    };
    let plain = |name: &str, edit: &dyn Fn(&mut Input)| edited(name, 3, 3, edit);
    let six = |a1: [f64; 3], a2: [f64; 3]| {
        move |i: &mut Input| {
            for r in i.rots.chunks_exact_mut(6) {
                r[..3].copy_from_slice(&a1);
                r[3..].copy_from_slice(&a2);
            }
        }
    };
    vec![
        plain("ordinary", &|_| {}),
        plain("6D vectors of zero", &six([0.0; 3], [0.0; 3])),
        plain(
            "6D vectors that are parallel",
            &six([0.3, 0.1, -0.2], [0.6, 0.2, -0.4]),
        ),
        plain(
            "a sine of 0.01 between them",
            &six([1.0, 0.0, 0.0], [1.0, 0.01, 0.0]),
        ),
        plain("6D vectors of 1e6", &|i| {
            i.rots.iter_mut().for_each(|v| *v *= 1e6);
        }),
        plain("6D vectors of 1e30", &|i| {
            i.rots.iter_mut().for_each(|v| *v *= 1e30);
        }),
        plain("logits of 1e3 and -1e3", &|i| {
            i.coefficients
                .iter_mut()
                .for_each(|v| *v = 1e3 * v.signum());
        }),
        plain("means at 1e6", &|i| {
            i.means.iter_mut().for_each(|v| *v *= 1e6);
        }),
        plain("translations of 1e6", &|i| {
            i.transls.iter_mut().for_each(|v| *v *= 1e6);
        }),
        edited("one basis", 1, 3, &|_| {}),
        edited("one frame", 3, 1, &|_| {}),
        edited("two frames", 3, 2, &|_| {}),
    ]
}
