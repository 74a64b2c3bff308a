//! Adam (Kingma and Ba, 2015) over rank-2 parameters, with state that follows row edits.
//!
//! The state is ours and not `burn::optim`'s, because density control clones, splits and removes
//! rows, and the moments have to follow.

use crate::density::{RowEdit, RowKind, gather_rows};
use crate::real::{Real, leaf, values, vectorized, with_real};
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;

/// Elements per parallel task. The update is element-wise, so the partition does not change a bit.
const BLOCK: usize = 1 << 15;

/// Gradients beyond this magnitude count as this much. Its square stays far inside f32: an infinite
/// second moment would never decay, and the element would stand still for ever.
const LARGEST_GRADIENT: f64 = 1e15;

/// First moments below this magnitude are zero: they move nothing, and would decay into denormal
/// numbers, which are slow, and stay there.
const SMALLEST_FIRST: f64 = 1e-30;

/// Second moments below this are zero: their root vanishes beside epsilon.
const SMALLEST_SECOND: f64 = 1e-37;

/// Adam's constants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamOptions {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
}

impl Default for AdamOptions {
    /// The constants of 3D Gaussian Splatting: 0.9, 0.999, 1e-15.
    fn default() -> Self {
        Self {
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-15,
        }
    }
}

/// Learning rate of one parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum LearningRate {
    /// One rate for the whole tensor.
    Uniform(f64),
    /// One rate per column.
    PerColumn(Vec<f64>),
}

impl LearningRate {
    /// `first` for columns [0, `num_first`), `rest` for those behind, `columns` in all.
    ///
    /// Spherical harmonics [N, 48] use it: three DC columns at 2.5e-3, the others at a twentieth.
    #[must_use]
    pub fn first_and_rest(first: f64, num_first: usize, rest: f64, columns: usize) -> Self {
        Self::PerColumn(
            (0..columns)
                .map(|column| if column < num_first { first } else { rest })
                .collect(),
        )
    }

    /// A row-aligned stretch of rates, at least a few hundred long so that inner loops are not short.
    fn tile<T: Real>(&self, columns: usize) -> Vec<T> {
        let rows = 512_usize.div_ceil(columns.max(1));
        match self {
            Self::Uniform(rate) => vec![T::of(*rate); rows * columns],
            Self::PerColumn(rates) => {
                assert_eq!(
                    rates.len(),
                    columns,
                    "one learning rate per column of the parameter"
                );
                let row: Vec<T> = rates.iter().map(|rate| T::of(*rate)).collect();
                row.repeat(rows)
            }
        }
    }
}

/// Adam's moments of one parameter [N, C] and the number of steps taken.
#[derive(Clone, Debug)]
pub struct AdamState {
    /// Running mean of the gradient, [N, C], on a device without autodiff.
    pub moment1: Tensor<2>,
    /// Running mean of the squared gradient, [N, C], on a device without autodiff.
    pub moment2: Tensor<2>,
    /// Steps taken; shared by all rows, also those added later (as in 3D Gaussian Splatting).
    pub steps: u32,
}

impl AdamState {
    /// Zero moments for `param`, [N, C].
    #[must_use]
    pub fn new(param: &Tensor<2>) -> Self {
        let zeros = Tensor::zeros(param.dims(), (&param.device().inner(), param.dtype()));
        Self {
            moment1: zeros.clone(),
            moment2: zeros,
            steps: 0,
        }
    }

    /// Follows an edit of the parameter's rows: kept rows keep their moments, new rows start at zero.
    pub fn gather(&mut self, edit: &RowEdit) {
        let device = self.moment1.device();
        let kept: Vec<f32> = edit
            .kind
            .iter()
            .map(|kind| f32::from(u8::from(*kind == RowKind::Kept)))
            .collect();
        let kept = Tensor::<2>::from_data(
            TensorData::new(kept, [edit.len(), 1]),
            (&device, self.moment1.dtype()),
        );
        self.moment1 = gather_rows(&self.moment1, edit) * kept.clone();
        self.moment2 = gather_rows(&self.moment2, edit) * kept;
    }

    /// Forgets the moments, as after an opacity reset. The step count stays.
    pub fn zero_moments(&mut self) {
        self.moment1 = self.moment1.zeros_like();
        self.moment2 = self.moment2.zeros_like();
    }
}

/// A gradient that is infinite or not a number.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("the gradient at row {row}, column {column} is {value}")]
pub struct NonFiniteGradient {
    /// Row of the parameter.
    pub row: usize,
    /// Column of the parameter.
    pub column: usize,
    /// The value found.
    pub value: f64,
}

/// A gradient, [N, C], if every entry is finite; to be asked before anything is stepped. It costs no copy where the buffer has
/// no other owner.
///
/// # Errors
/// Names the first entry that is not finite.
pub fn finite_gradient(grad: Tensor<2>) -> Result<Tensor<2>, NonFiniteGradient> {
    let [rows, columns] = grad.dims();
    let (device, dtype) = (grad.device(), grad.dtype());
    with_real!(dtype, T => {
        let grad = values::<T, 2>(grad);
        // Without a branch per value, so that it runs at memory speed.
        let finite = |block: &[T]| block.iter().fold(true, |ok, g| ok & g.finite());
        if grad.par_chunks(BLOCK).all(finite) {
            return Ok(Tensor::from_data(TensorData::new(grad, [rows, columns]), (&device, dtype)));
        }
        let at = grad.iter().position(|g| !g.finite()).unwrap_or(0);
        Err(NonFiniteGradient {
            row: at / columns,
            column: at % columns,
            value: grad[at].wide(),
        })
    })
}

/// One step of Adam on `param` [N, C], in place: afterwards it is a new leaf that requires its gradient if it was on
/// an autodiff device, a plain tensor otherwise.
///
/// `grad` [N, C] is what `param.grad_remove(..)` gives, and finite ([`finite_gradient`]). No graph is recorded. An element whose gradient is
/// zero and whose moments are zero does not move. Magnitudes above 1e15 count as 1e15. Without other handles to
/// `param` its buffer is reused.
///
/// # Panics
/// Panics if the shapes or dtypes of `param`, `grad` and `state` differ, or if the number of learning rates is
/// not the number of columns.
pub fn adam_step(
    param: &mut Tensor<2>,
    grad: Tensor<2>,
    state: &mut AdamState,
    rate: &LearningRate,
    options: &AdamOptions,
) {
    let shape = param.dims();
    assert_eq!(shape, grad.dims(), "a gradient has its parameter's shape");
    assert_eq!(
        shape,
        state.moment1.dims(),
        "the moments have their parameter's shape: row edits must reach the state too"
    );
    let autodiff = param.is_autodiff();
    let (device, dtype) = (param.device().inner(), param.dtype());
    with_real!(dtype, T => {
        let grad = values::<T, 2>(grad);
        // What stays behind must not hold the buffer, or it would be copied.
        let take = |tensor: &mut Tensor<2>| {
            let placeholder = Tensor::zeros([1, 1], (&device, dtype));
            values::<T, 2>(std::mem::replace(tensor, placeholder))
        };
        let mut m = take(&mut state.moment1);
        let mut v = take(&mut state.moment2);
        let mut p = take(param);
        let tile = rate.tile::<T>(shape[1]);
        state.steps += 1;
        update(&mut p, &grad, &mut m, &mut v, &tile, state.steps, options);
        let tensor = |values: Vec<T>| {
            Tensor::from_data(TensorData::new(values, shape), (&device, dtype))
        };
        state.moment1 = tensor(m);
        state.moment2 = tensor(v);
        *param = leaf(tensor(p), autodiff);
    });
}

/// The update on slices; `tile` holds the learning rates of whole rows and is repeated.
fn update<T: Real>(
    param: &mut [T],
    grad: &[T],
    moment1: &mut [T],
    moment2: &mut [T],
    tile: &[T],
    steps: u32,
    options: &AdamOptions,
) {
    if param.is_empty() {
        return;
    }
    let constants = Constants::new(steps, options);
    let block = (BLOCK / tile.len()).max(1) * tile.len();
    param
        .par_chunks_mut(block)
        .zip(grad.par_chunks(block))
        .zip(moment1.par_chunks_mut(block))
        .zip(moment2.par_chunks_mut(block))
        .for_each(|(((param, grad), moment1), moment2)| {
            vectorized(
                #[inline(always)]
                || {
                    for (((param, grad), moment1), moment2) in param
                        .chunks_mut(tile.len())
                        .zip(grad.chunks(tile.len()))
                        .zip(moment1.chunks_mut(tile.len()))
                        .zip(moment2.chunks_mut(tile.len()))
                    {
                        for ((((p, g), m), v), rate) in param
                            .iter_mut()
                            .zip(grad)
                            .zip(moment1)
                            .zip(moment2)
                            .zip(tile)
                        {
                            constants.step(p, *g, m, v, *rate);
                        }
                    }
                },
            );
        });
}

/// What all elements of a step share.
struct Constants<T> {
    /// 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t).
    corrections: [T; 2],
    decay: [T; 2],
    share: [T; 2],
    epsilon: T,
    limit: T,
    smallest: [T; 2],
}

impl<T: Real> Constants<T> {
    fn new(steps: u32, options: &AdamOptions) -> Self {
        let betas = [options.beta1, options.beta2];
        let [first, second] = betas.map(|beta| 1.0 - beta.powf(f64::from(steps)));
        Self {
            corrections: [T::of(1.0 / first), T::of(1.0 / second.sqrt())],
            decay: betas.map(T::of),
            share: betas.map(|beta| T::of(1.0 - beta)),
            epsilon: T::of(options.epsilon),
            limit: T::of(LARGEST_GRADIENT),
            smallest: [T::of(SMALLEST_FIRST), T::of(SMALLEST_SECOND)],
        }
    }

    #[inline(always)]
    fn step(&self, param: &mut T, grad: T, moment1: &mut T, moment2: &mut T, rate: T) {
        let zero = T::default();
        let g = if grad > self.limit { self.limit } else { grad };
        let g = if g < -self.limit { -self.limit } else { g };
        let m = self.decay[0] * *moment1 + self.share[0] * g;
        let v = self.decay[1] * *moment2 + self.share[1] * (g * g);
        let m = if m.magnitude() < self.smallest[0] {
            zero
        } else {
            m
        };
        let v = if v < self.smallest[1] { zero } else { v };
        *moment1 = m;
        *moment2 = v;
        let root = v.root() * self.corrections[1] + self.epsilon;
        *param = *param - rate * (m * self.corrections[0] / root);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gradient that changes sign and size over the steps, different in every element.
    fn gradient(step: usize, element: usize) -> f64 {
        let x = (step * 7 + element * 13) as f64;
        (x * 0.61).sin() * 10.0_f64.powi((element % 9) as i32 - 6)
    }

    /// Adam of one element, from the paper's algorithm 1.
    fn reference(start: f64, element: usize, steps: usize, rate: f64) -> f64 {
        let options = AdamOptions::default();
        let (mut p, mut m, mut v) = (start, 0.0, 0.0);
        for step in 1..=steps {
            let g = gradient(step, element);
            m = options.beta1 * m + (1.0 - options.beta1) * g;
            v = options.beta2 * v + (1.0 - options.beta2) * g * g;
            let m_hat = m / (1.0 - options.beta1.powi(step as i32));
            let v_hat = v / (1.0 - options.beta2.powi(step as i32));
            p -= rate * m_hat / (v_hat.sqrt() + options.epsilon);
        }
        p
    }

    fn follow<T: Real>(tolerance: f64) {
        let (rows, columns, steps) = (301, 7, 50);
        let rates: Vec<f64> = (0..columns).map(|c| 1e-3 * (c + 1) as f64).collect();
        let tile = LearningRate::PerColumn(rates.clone()).tile::<T>(columns);
        let start = |k: usize| k as f64 * 1e-3;
        let mut p: Vec<T> = (0..rows * columns).map(|k| T::of(start(k))).collect();
        let (mut m, mut v) = (vec![T::default(); p.len()], vec![T::default(); p.len()]);
        for step in 1..=steps {
            let g: Vec<T> = (0..p.len()).map(|k| T::of(gradient(step, k))).collect();
            update(
                &mut p,
                &g,
                &mut m,
                &mut v,
                &tile,
                step as u32,
                &AdamOptions::default(),
            );
        }
        for (k, p) in p.iter().enumerate() {
            let expected = reference(start(k), k, steps, rates[k % columns]);
            assert!(
                (p.wide() - expected).abs() < tolerance,
                "element {k}: {} instead of {expected}",
                p.wide()
            );
        }
    }

    #[test]
    fn fifty_steps_follow_the_scalar_reference() {
        follow::<f64>(1e-12);
        follow::<f32>(1e-5);
    }

    fn one_step(p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], step: u32) {
        let tile = LearningRate::Uniform(0.1).tile::<f32>(1);
        update(p, g, m, v, &tile, step, &AdamOptions::default());
    }

    #[test]
    fn an_unseen_element_does_not_move_and_a_seen_one_glides() {
        let (mut p, mut m, mut v) = ([1.0, 1.0], [0.0; 2], [0.0; 2]);
        one_step(&mut p, &[0.0, 1e-3], &mut m, &mut v, 1);
        assert_eq!((p[0], m[0], v[0]), (1.0, 0.0, 0.0));
        assert!((p[1] - 0.9).abs() < 1e-6, "the first step is the rate");
        let before = p[1];
        one_step(&mut p, &[0.0, 0.0], &mut m, &mut v, 2);
        assert_eq!(p[0], 1.0);
        assert!(p[1] < before, "momentum goes on");
    }

    #[test]
    fn gradients_at_the_ends_of_f32_stay_finite() {
        let (mut p, mut m, mut v) = ([0.0; 4], [0.0; 4], [0.0; 4]);
        for step in 1..=2000 {
            one_step(&mut p, &[3e38, -3e38, 1e-30, 1e-42], &mut m, &mut v, step);
        }
        assert!(
            p.iter().chain(&m).chain(&v).all(|x| x.is_finite()),
            "{p:?} {m:?} {v:?}"
        );
        assert!((p[0] + 200.0).abs() < 1.0, "a step each time: {}", p[0]);
        assert!(
            p[2].abs() < 1.0,
            "vanishing gradients hardly move: {}",
            p[2]
        );
        // The second moment decays again.
        let before = v[0];
        for step in 2001..=2100 {
            one_step(&mut p, &[1.0; 4], &mut m, &mut v, step);
        }
        assert!(v[0] < 0.95 * before);
    }

    #[test]
    fn old_momentum_ends_at_zero() {
        let (mut p, mut m, mut v) = ([0.0], [0.0], [0.0]);
        one_step(&mut p, &[1e-3], &mut m, &mut v, 1);
        for step in 2..=100_000 {
            one_step(&mut p, &[0.0], &mut m, &mut v, step);
        }
        assert_eq!((m[0], v[0]), (0.0, 0.0), "no denormal numbers are left");
    }
}
