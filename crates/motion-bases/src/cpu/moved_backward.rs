//! The way back of [`super::moved`].

use host::{Real, vectorized};
use rayon::prelude::*;
use tracing::trace_span;

use super::frame::Vectors;
use super::lanes::{LANES, Lanes};
use super::moved::{BASIS, Inputs, PIECE, frame, gathered, scatter};
use super::vec3::{scaled, sum};

/// Gradients of one piece's Gaussians, and what it adds to those of the bases.
pub(crate) struct Piece<T> {
    pub(crate) coefficients: Vec<T>,
    means: Vec<T>,
    /// [T, B, 9].
    bases: Vec<T>,
}

/// Gradients of coefficients, bases and means, from that of the output of [`super::moved::moved`].
pub(crate) fn moved_backward<T: Real>(inputs: &Inputs<'_, T>, gradient: &[T]) -> [Vec<T>; 3] {
    let _span = trace_span!("motion backward").entered();
    let (rows, moments) = (inputs.rows(), inputs.moments());
    let (of_means, of_rotations) = gradient.split_at(moments * rows * 3);
    let pieces = (0..rows.div_ceil(PIECE)).into_par_iter().map(|piece| {
        let first = piece * PIECE;
        vectorized(
            #[inline(always)]
            || {
                let weights = inputs.piece_weights(first);
                piece_backward(
                    inputs,
                    (first, &weights),
                    #[inline(always)]
                    |moment, group| {
                        let start = first + group * LANES;
                        let range = moment * rows + start..moment * rows + rows.min(start + LANES);
                        let moved = gathered::<T, 3>(&of_means[range.start * 3..range.end * 3]);
                        let turned =
                            gathered::<T, 9>(&of_rotations[range.start * 9..range.end * 9]);
                        (moved, turned)
                    },
                )
            },
        )
    });
    joined(inputs, pieces.collect())
}

/// Gradients of coefficients, bases and means, from those of all pieces in their order.
pub(crate) fn joined<T: Real>(inputs: &Inputs<'_, T>, pieces: Vec<Piece<T>>) -> [Vec<T>; 3] {
    let (rows, bases, moments) = (inputs.rows(), inputs.num_bases(), inputs.moments());
    let mut coefficients = Vec::with_capacity(rows * bases);
    let mut means = Vec::with_capacity(rows * 3);
    let mut basis_gradient = vec![T::ZERO; bases * moments * BASIS];
    for piece in pieces {
        coefficients.extend(piece.coefficients);
        means.extend(piece.means);
        for (i, part) in piece.bases.chunks_exact(BASIS).enumerate() {
            let (moment, basis) = (i / bases, i % bases);
            let at = (basis * moments + moment) * BASIS;
            for (total, value) in basis_gradient[at..at + BASIS].iter_mut().zip(part) {
                *total += *value;
            }
        }
    }
    [coefficients, basis_gradient, means]
}

/// The way back of the piece from `first` on, whose softmax weights are given, and of which `gradient` has at a moment and for a group of [`LANES`] that of the
/// moved means and of the rotations.
#[inline(always)]
pub(crate) fn piece_backward<T: Real>(
    inputs: &Inputs<'_, T>,
    (first, weights): (usize, &[Lanes<T>]),
    gradient: impl Fn(usize, usize) -> (Vectors<T>, [Lanes<T>; 9]),
) -> Piece<T> {
    let (rows, bases, moments) = (inputs.rows(), inputs.num_bases(), inputs.moments());
    let count = PIECE.min(rows - first);
    let groups = inputs.piece_groups(first);
    let mut weight_gradients = vec![Lanes::ZERO; groups * bases];
    let mut mean_gradients = vec![[Lanes::ZERO; 3]; groups];
    let mut bases_gradient = Vec::with_capacity(moments * bases * BASIS);
    let mut part = vec![[Lanes::ZERO; BASIS]; bases];
    for moment in 0..moments {
        part.fill([Lanes::ZERO; BASIS]);
        for group in 0..groups {
            let start = first + group * LANES;
            let (moved, turned) = gradient(moment, group);
            let mean = gathered::<T, 3>(&inputs.means[start * 3..]);
            let these = group * bases..(group + 1) * bases;
            let weights = &weights[these.clone()];
            let blend = inputs.blended(moment, weights);
            let blend_gradient =
                lanes_backward(&blend, &mean, (&moved, &turned), &mut mean_gradients[group]);
            let weight_gradients = &mut weight_gradients[these];
            for (basis, values) in inputs.bases_at(moment).enumerate() {
                for c in 0..BASIS {
                    weight_gradients[basis] += blend_gradient[c] * values[c];
                    part[basis][c] += weights[basis] * blend_gradient[c];
                }
            }
        }
        let sums = part.as_flattened().iter();
        bases_gradient.extend(sums.map(|lanes| lanes.total()));
    }
    let mut coefficients = vec![T::ZERO; count * bases];
    for ((rows, weights), gradients) in coefficients
        .chunks_mut(LANES * bases)
        .zip(weights.chunks_exact(bases))
        .zip(weight_gradients.chunks_exact(bases))
    {
        softmax_backward(weights, gradients, rows);
    }
    let mut means = vec![T::ZERO; count * 3];
    for (rows, gradient) in means.chunks_mut(LANES * 3).zip(&mean_gradients) {
        scatter(gradient, rows);
    }
    Piece {
        coefficients,
        means,
        bases: bases_gradient,
    }
}

/// The gradient of a blend; that of the canonical means is added.
#[inline(always)]
fn lanes_backward<T: Real>(
    blend: &[Lanes<T>; BASIS],
    mean: &Vectors<T>,
    (moved, turned): (&Vectors<T>, &[Lanes<T>; 9]),
    mean_gradient: &mut Vectors<T>,
) -> [Lanes<T>; BASIS] {
    let frame = frame(blend);
    let [x, y, z] = frame.rows();
    let canonical = sum(
        sum(scaled(x, moved[0]), scaled(y, moved[1])),
        scaled(z, moved[2]),
    );
    for (gradient, canonical) in mean_gradient.iter_mut().zip(canonical) {
        *gradient += canonical;
    }
    let [t0, t1, t2, t3, t4, t5, t6, t7, t8] = *turned;
    let [g0, g1, g2, g3, g4, g5] = frame.backward([
        sum([t0, t1, t2], scaled(*mean, moved[0])),
        sum([t3, t4, t5], scaled(*mean, moved[1])),
        sum([t6, t7, t8], scaled(*mean, moved[2])),
    ]);
    [g0, g1, g2, g3, g4, g5, moved[0], moved[1], moved[2]]
}

/// Adds to the gradients of logits, as rows, what those of their softmax weights make of them.
#[inline(always)]
pub(crate) fn softmax_backward<T: Real>(
    weights: &[Lanes<T>],
    gradients: &[Lanes<T>],
    rows: &mut [T],
) {
    let mut mean = Lanes::ZERO;
    for (weight, gradient) in weights.iter().zip(gradients) {
        mean += *weight * *gradient;
    }
    for (lane, row) in rows.chunks_exact_mut(weights.len()).enumerate() {
        for (b, value) in row.iter_mut().enumerate() {
            *value += weights[b][lane] * (gradients[b][lane] - mean[lane]);
        }
    }
}
