//! What stands out of a picture's surroundings, and its gradient: the terms of [`crate::losses::detail_loss`].

use std::ops::Range;

use host::{Real, filled, vectorized};
use rayon::prelude::*;

use super::ssim::CHANNELS;

/// Distances of the neighbours that a pixel is compared with, px.
pub(crate) const STEPS: [usize; 2] = [1, 2];

/// Rows of a task.
const ROWS: usize = 8;
/// Numbers that are added up side by side.
const LANES: usize = 16;

/// How much a sample of each scale weighs in a picture of this size; 0 where the picture is too small for the scale.
pub(crate) fn weights([height, width]: [usize; 2]) -> [f64; 2] {
    STEPS.map(|step| {
        let inside = |pixels: usize| pixels.saturating_sub(2 * step);
        let samples = inside(height) * inside(width) * CHANNELS;
        if samples == 0 {
            0.0
        } else {
            1.0 / samples as f64
        }
    })
}

/// Mean magnitude, summed over the scales, of what the difference of two pictures [H, W, 3] has beyond the mean of its four
/// neighbours; and its gradient by the first, if it is wanted.
pub(crate) fn detail_loss<T: Real>(
    a: &[T],
    b: &[T],
    size: [usize; 2],
    wanted: bool,
) -> (f64, Option<Vec<T>>) {
    if a.is_empty() {
        return (0.0, wanted.then(Vec::new));
    }
    let [height, width] = size;
    let row = width * CHANNELS;
    let task = ROWS * row;
    let mut residual = filled(T::ZERO, a.len());
    residual
        .par_chunks_mut(task)
        .zip(a.par_chunks(task).zip(b.par_chunks(task)))
        .for_each(|(residual, (a, b))| {
            vectorized(
                #[inline(always)]
                || {
                    for ((v, a), b) in residual.iter_mut().zip(a).zip(b) {
                        *v = *a - *b;
                    }
                },
            );
        });
    let mut value = 0.0;
    let mut gradient = wanted.then(|| filled(T::ZERO, a.len()));
    for (step, weight) in STEPS.into_iter().zip(weights(size)) {
        if weight == 0.0 {
            continue;
        }
        let across = CHANNELS * step..row - CHANNELS * step;
        let mut standing_out = filled(T::ZERO, a.len());
        let sums: Vec<f64> = standing_out
            .par_chunks_mut(task)
            .enumerate()
            .map(|(block, rows)| {
                vectorized(
                    #[inline(always)]
                    || {
                        let mut sum = 0.0;
                        for (k, out) in rows.chunks_exact_mut(row).enumerate() {
                            let y = block * ROWS + k;
                            if y >= step && y + step < height {
                                let at = |y: usize| &residual[y * row..(y + 1) * row];
                                let around = [at(y - step), at(y), at(y + step)];
                                sum += stand_out(around, out, across.clone()).to_f64();
                            }
                        }
                        sum
                    },
                )
            })
            .collect();
        value += weight * sums.iter().sum::<f64>();
        let Some(gradient) = &mut gradient else {
            continue;
        };
        let weight = T::of(weight);
        gradient
            .par_chunks_mut(task)
            .enumerate()
            .for_each(|(block, rows)| {
                vectorized(
                    #[inline(always)]
                    || {
                        for (k, out) in rows.chunks_exact_mut(row).enumerate() {
                            let y = block * ROWS + k;
                            let at = |y: usize| &standing_out[y * row..(y + 1) * row];
                            let (own, shift) = (at(y), CHANNELS * step);
                            add_signs(out, own, weight);
                            // What a sample is compared with has a quarter of its sign, the other way round.
                            let pull = weight * T::of(-0.25);
                            add_signs(&mut out[shift..], own, pull);
                            add_signs(out, &own[shift..], pull);
                            if y >= step {
                                add_signs(out, at(y - step), pull);
                            }
                            if y + step < height {
                                add_signs(out, at(y + step), pull);
                            }
                        }
                    },
                );
            });
    }
    (value, gradient)
}

/// Writes what a row has beyond the mean of its neighbours in itself and in the rows `above` and `below`, and adds up its
/// magnitudes.
#[inline(always)]
fn stand_out<T: Real>([above, own, below]: [&[T]; 3], out: &mut [T], across: Range<usize>) -> T {
    let shift = across.start;
    let (left, right) = (&own[..across.len()], &own[2 * shift..]);
    let vertical = above[across.clone()].iter().zip(&below[across.clone()]);
    let horizontal = left.iter().zip(right);
    let out = &mut out[across.clone()];
    for (((out, own), (above, below)), (left, right)) in out
        .iter_mut()
        .zip(&own[across])
        .zip(vertical)
        .zip(horizontal)
    {
        *out = *own - (*above + *below + *left + *right) * T::of(0.25);
    }
    let (lanes, rest) = out.as_chunks::<LANES>();
    let mut sums = [T::ZERO; LANES];
    for lanes in lanes {
        for (sum, v) in sums.iter_mut().zip(lanes) {
            *sum += v.abs();
        }
    }
    let all = sums.into_iter().chain(rest.iter().map(|v| v.abs()));
    all.fold(T::ZERO, |sum, v| sum + v)
}

/// Adds `weight` with the sign of each value, for as long as there are both.
#[inline(always)]
fn add_signs<T: Real>(out: &mut [T], values: &[T], weight: T) {
    for (out, v) in out.iter_mut().zip(values) {
        let up = if *v > T::ZERO { weight } else { T::ZERO };
        let down = if *v < T::ZERO { weight } else { T::ZERO };
        *out += up - down;
    }
}
