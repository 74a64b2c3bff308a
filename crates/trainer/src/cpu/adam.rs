//! The update of Adam (Kingma and Ba, 2015, algorithm 1).

use super::BLOCK;
use host::{Real, vectorized};
use rayon::prelude::*;

/// Decays of the two moments, as in 3D Gaussian Splatting.
pub(crate) const BETAS: [f64; 2] = [0.9, 0.999];

/// Added to the root of the second moment.
pub(crate) const EPSILON: f64 = 1e-15;

/// Gradients beyond this magnitude count as this much. Its square stays far inside f32: an infinite
/// second moment would never decay, and the element would stand still for ever.
pub(crate) const LARGEST_GRADIENT: f64 = 1e15;

/// First moments below this magnitude are zero: they move nothing, and would decay into denormal
/// numbers, which are slow, and stay there.
pub(crate) const SMALLEST_FIRST: f64 = 1e-30;

/// Second moments below this are zero: their root vanishes beside epsilon.
pub(crate) const SMALLEST_SECOND: f64 = 1e-37;

/// Rows that step, and how often they have then done so.
#[derive(Clone, Debug)]
pub(crate) enum SteppedRows {
    /// All, so often.
    All(u32),
    /// These rows, each with its own count.
    Drawn(Vec<(usize, u32)>),
}

/// What a step is told beside the tensors.
#[derive(Clone, Debug)]
pub(crate) struct AdamUpdate {
    /// Learning rate of each column.
    pub(crate) rates: Vec<f64>,
    /// So many rows, the first, have other rates, of each column; where all rows step together.
    pub(crate) lead: Option<(usize, Vec<f64>)>,
    pub(crate) rows: SteppedRows,
}

/// One step on a parameter and its moments, all [N, C].
pub(crate) fn adam<T: Real>(
    param: &mut [T],
    grad: &[T],
    [moment1, moment2]: [&mut [T]; 2],
    update: &AdamUpdate,
) {
    let columns = update.rates.len();
    if param.is_empty() {
        return;
    }
    let typed = |rates: &[f64]| rates.iter().map(|rate| T::of(*rate)).collect::<Vec<T>>();
    let rates = typed(&update.rates);
    match &update.rows {
        SteppedRows::All(steps) => {
            let constants = Constants::new(*steps);
            let (rows, lead) = update.lead.clone().unwrap_or_default();
            let at = rows * columns;
            let [(p, param), (m, moment1), (v, moment2)] =
                [param, moment1, moment2].map(|values| values.split_at_mut(at));
            let (g, grad) = grad.split_at(at);
            constants.step_all(p, g, [m, v], &typed(&lead));
            constants.step_all(param, grad, [moment1, moment2], &rates);
        }
        SteppedRows::Drawn(rows) => {
            for (row, steps) in rows {
                let at = row * columns..(row + 1) * columns;
                let moments = [&mut moment1[at.clone()], &mut moment2[at.clone()]];
                let constants = Constants::new(*steps);
                constants.step_rows(&mut param[at.clone()], &grad[at], moments, &rates);
            }
        }
    }
}

/// 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) after so many steps.
pub(crate) fn corrections(steps: u32) -> [f64; 2] {
    let [first, second] = BETAS.map(|beta| 1.0 - beta.powf(f64::from(steps)));
    [1.0 / first, 1.0 / second.sqrt()]
}

/// What all elements of a step share.
struct Constants<T> {
    corrections: [T; 2],
    decay: [T; 2],
    share: [T; 2],
    epsilon: T,
    limit: T,
    smallest: [T; 2],
}

impl<T: Real> Constants<T> {
    fn new(steps: u32) -> Self {
        Self {
            corrections: corrections(steps).map(T::of),
            decay: BETAS.map(T::of),
            share: BETAS.map(|beta| T::of(1.0 - beta)),
            epsilon: T::of(EPSILON),
            limit: T::of(LARGEST_GRADIENT),
            smallest: [T::of(SMALLEST_FIRST), T::of(SMALLEST_SECOND)],
        }
    }

    /// Steps all of some rows on all threads, with a learning rate for each column.
    fn step_all(
        &self,
        param: &mut [T],
        grad: &[T],
        [moment1, moment2]: [&mut [T]; 2],
        rates: &[T],
    ) {
        if param.is_empty() {
            return;
        }
        // Whole rows, at least a few hundred values long so that inner loops are not short.
        let tile = rates.repeat(512_usize.div_ceil(rates.len()));
        let block = (BLOCK / tile.len()).max(1) * tile.len();
        param
            .par_chunks_mut(block)
            .zip(grad.par_chunks(block))
            .zip(moment1.par_chunks_mut(block))
            .zip(moment2.par_chunks_mut(block))
            .for_each(|(((param, grad), moment1), moment2)| {
                self.step_rows(param, grad, [moment1, moment2], &tile);
            });
    }

    /// Steps whole rows; `tile` holds the learning rates of some of them and is repeated.
    fn step_rows(
        &self,
        param: &mut [T],
        grad: &[T],
        [moment1, moment2]: [&mut [T]; 2],
        tile: &[T],
    ) {
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
                        self.step(p, *g, m, v, *rate);
                    }
                }
            },
        );
    }

    #[inline(always)]
    fn step(&self, param: &mut T, grad: T, moment1: &mut T, moment2: &mut T, rate: T) {
        let zero = T::ZERO;
        let g = if grad > self.limit { self.limit } else { grad };
        let g = if g < -self.limit { -self.limit } else { g };
        let m = self.decay[0] * *moment1 + self.share[0] * g;
        let v = self.decay[1] * *moment2 + self.share[1] * (g * g);
        let m = if m.abs() < self.smallest[0] { zero } else { m };
        let v = if v < self.smallest[1] { zero } else { v };
        *moment1 = m;
        *moment2 = v;
        let root = v.sqrt() * self.corrections[1] + self.epsilon;
        *param -= rate * (m * self.corrections[0] / root);
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
        let (mut p, mut m, mut v) = (start, 0.0, 0.0);
        for step in 1..=steps {
            let g = gradient(step, element);
            m = BETAS[0] * m + (1.0 - BETAS[0]) * g;
            v = BETAS[1] * v + (1.0 - BETAS[1]) * g * g;
            let m_hat = m / (1.0 - BETAS[0].powi(step as i32));
            let v_hat = v / (1.0 - BETAS[1].powi(step as i32));
            p -= rate * m_hat / (v_hat.sqrt() + EPSILON);
        }
        p
    }

    fn follow<T: Real>(tolerance: f64) {
        let (rows, columns, steps, first) = (301, 7, 50, 57);
        let rates: Vec<f64> = (0..columns).map(|c| 1e-3 * (c + 1) as f64).collect();
        let of_first: Vec<f64> = rates.iter().map(|rate| 0.3 * rate).collect();
        let update = |step| AdamUpdate {
            rates: rates.clone(),
            lead: Some((first, of_first.clone())),
            rows: SteppedRows::All(step),
        };
        let start = |k: usize| k as f64 * 1e-3;
        let mut p: Vec<T> = (0..rows * columns).map(|k| T::of(start(k))).collect();
        let (mut m, mut v) = (vec![T::ZERO; p.len()], vec![T::ZERO; p.len()]);
        for step in 1..=steps {
            let g: Vec<T> = (0..p.len()).map(|k| T::of(gradient(step, k))).collect();
            adam(&mut p, &g, [&mut m, &mut v], &update(step as u32));
        }
        for (k, p) in p.iter().enumerate() {
            let rates = if k < first * columns {
                &of_first
            } else {
                &rates
            };
            let expected = reference(start(k), k, steps, rates[k % columns]);
            assert!(
                (p.to_f64() - expected).abs() < tolerance,
                "element {k}: {} instead of {expected}",
                p.to_f64()
            );
        }
    }

    #[test]
    fn fifty_steps_follow_the_scalar_reference() {
        follow::<f64>(1e-12);
        follow::<f32>(1e-5);
    }

    fn one_step(p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], step: u32) {
        let update = AdamUpdate {
            rates: vec![0.1],
            lead: None,
            rows: SteppedRows::All(step),
        };
        adam(p, g, [m, v], &update);
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
