//! The way back of [`super::moved`].

use host::{Real, vectorized};
use rayon::prelude::*;
use tracing::trace_span;

use super::moved::{BASIS, Inputs, LANES, Lanes, PIECE, frame, gathered, scatter};
use super::vec3::{Vec3, scaled, sum};

/// Gradients of one piece's Gaussians, and what it adds to those of the bases.
struct Piece<T> {
    coefficients: Vec<T>,
    means: Vec<T>,
    /// [T, B, 9].
    bases: Vec<T>,
}

/// Gradients of coefficients, bases and means, from that of the output of [`super::moved::moved`].
pub(crate) fn moved_backward<T: Real>(inputs: &Inputs<'_, T>, gradient: &[T]) -> [Vec<T>; 3] {
    let _span = trace_span!("motion backward").entered();
    let (rows, bases, moments) = (inputs.rows(), inputs.num_bases(), inputs.moments());
    let pieces: Vec<Piece<T>> = (0..rows.div_ceil(PIECE))
        .into_par_iter()
        .map(|piece| {
            vectorized(
                #[inline(always)]
                || piece_backward(inputs, gradient, piece * PIECE),
            )
        })
        .collect();
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

#[inline(always)]
fn piece_backward<T: Real>(inputs: &Inputs<'_, T>, gradient: &[T], first: usize) -> Piece<T> {
    let (rows, bases, moments) = (inputs.rows(), inputs.num_bases(), inputs.moments());
    let count = PIECE.min(rows - first);
    let groups = count.div_ceil(LANES);
    let (of_means, of_rotations) = gradient.split_at(moments * rows * 3);
    let mut weights = vec![[T::ZERO; LANES]; groups * bases];
    for (group, weights) in weights.chunks_exact_mut(bases).enumerate() {
        inputs.weights(first + group * LANES, weights);
    }
    let mut weight_gradients = vec![[T::ZERO; LANES]; groups * bases];
    let mut mean_gradients = vec![[[T::ZERO; LANES]; 3]; groups];
    let mut bases_gradient = Vec::with_capacity(moments * bases * BASIS);
    let mut part = vec![[[T::ZERO; LANES]; BASIS]; bases];
    for moment in 0..moments {
        part.fill([[T::ZERO; LANES]; BASIS]);
        for group in 0..groups {
            let start = first + group * LANES;
            let range = moment * rows + start..moment * rows + rows.min(start + LANES);
            let of = range.start * 3..range.end * 3;
            let moved = gathered::<T, 3>(&of_means[of]);
            let turned = gathered::<T, 9>(&of_rotations[range.start * 9..range.end * 9]);
            let mean = gathered::<T, 3>(&inputs.means[start * 3..]);
            let these = group * bases..(group + 1) * bases;
            let weights = &weights[these.clone()];
            let blend = inputs.blended(moment, weights);
            let blend_gradient =
                lanes_backward(&blend, &mean, (&moved, &turned), &mut mean_gradients[group]);
            let weight_gradients = &mut weight_gradients[these];
            for (basis, values) in inputs.bases_at(moment).enumerate() {
                for c in 0..BASIS {
                    for lane in 0..LANES {
                        let gradient = blend_gradient[c][lane];
                        weight_gradients[basis][lane] += values[c] * gradient;
                        part[basis][c][lane] += weights[basis][lane] * gradient;
                    }
                }
            }
        }
        let sums = part.as_flattened().iter();
        bases_gradient.extend(sums.map(|lanes| lanes.iter().fold(T::ZERO, |a, b| a + *b)));
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
    mean: &[Lanes<T>; 3],
    (moved, turned): (&[Lanes<T>; 3], &[Lanes<T>; 9]),
    mean_gradient: &mut [Lanes<T>; 3],
) -> [Lanes<T>; BASIS] {
    let mut gradient = [[T::ZERO; LANES]; BASIS];
    for lane in 0..LANES {
        let frame = frame(blend, lane);
        let of = |v: &[Lanes<T>; 3]| -> Vec3<T> { [v[0][lane], v[1][lane], v[2][lane]] };
        let (mean, moved) = (of(mean), of(moved));
        let rows = frame.rows();
        let mut canonical = scaled(rows[0], moved[0]);
        canonical = sum(canonical, scaled(rows[1], moved[1]));
        canonical = sum(canonical, scaled(rows[2], moved[2]));
        let turned = [0, 1, 2].map(|i| {
            let given = [0, 1, 2].map(|j| turned[3 * i + j][lane]);
            sum(given, scaled(mean, moved[i]))
        });
        let six = frame.backward(turned);
        for c in 0..6 {
            gradient[c][lane] = six[c];
        }
        for c in 0..3 {
            gradient[6 + c][lane] = moved[c];
            mean_gradient[c][lane] += canonical[c];
        }
    }
    gradient
}

/// The gradients of logits, as rows, from those of their softmax weights.
#[inline(always)]
fn softmax_backward<T: Real>(weights: &[Lanes<T>], gradients: &[Lanes<T>], rows: &mut [T]) {
    let mut mean = [T::ZERO; LANES];
    for (weight, gradient) in weights.iter().zip(gradients) {
        for lane in 0..LANES {
            mean[lane] += weight[lane] * gradient[lane];
        }
    }
    for (lane, row) in rows.chunks_exact_mut(weights.len()).enumerate() {
        for (b, value) in row.iter_mut().enumerate() {
            *value = weights[b][lane] * (gradients[b][lane] - mean[lane]);
        }
    }
}
