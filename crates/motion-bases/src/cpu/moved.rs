//! Where Gaussians are at several moments: bases blended by softmax weights, a rotation made of the blend, a mean moved.

use host::{Real, filled, vectorized};
use rayon::prelude::*;
use tracing::trace_span;

use super::frame::{Frame, Vectors};
use super::lanes::{LANES, Lanes};
use super::vec3::dot;

/// Gaussians that one task works on.
pub(crate) const PIECE: usize = 16 * LANES;
/// Numbers of a basis at a moment: a 6D vector and a translation.
pub(crate) const BASIS: usize = 9;

/// What moves, and how.
pub(crate) struct Inputs<'a, T> {
    /// Logits, [F, B].
    pub(crate) coefficients: &'a [T],
    /// [B, T, 9].
    pub(crate) bases: &'a [T],
    /// [F, 3].
    pub(crate) means: &'a [T],
}

impl<T: Real> Inputs<'_, T> {
    /// Number of Gaussians F, which is not 0.
    pub(crate) fn rows(&self) -> usize {
        self.means.len() / 3
    }

    /// Number of bases B.
    pub(crate) fn num_bases(&self) -> usize {
        self.coefficients.len() / self.rows()
    }

    /// Number of moments T.
    pub(crate) fn moments(&self) -> usize {
        self.bases.len() / (BASIS * self.num_bases())
    }

    /// All bases at a moment.
    #[inline(always)]
    pub(crate) fn bases_at(&self, moment: usize) -> impl Iterator<Item = &[T; BASIS]> {
        let (bases, _) = self.bases.as_chunks::<BASIS>();
        bases.iter().skip(moment).step_by(self.moments())
    }

    /// The softmax weights of up to [`LANES`] Gaussians from `first` on, one entry per basis. Lanes behind the last Gaussian
    /// have some weights too.
    #[inline(always)]
    pub(crate) fn weights(&self, first: usize, weights: &mut [Lanes<T>]) {
        let bases = weights.len();
        let logits = self.coefficients[first * bases..].chunks_exact(bases);
        weights.fill(Lanes::ZERO);
        for (lane, logits) in logits.take(LANES).enumerate() {
            for (weight, logit) in weights.iter_mut().zip(logits) {
                weight[lane] = *logit;
            }
        }
        let mut largest = weights[0];
        for weight in &*weights {
            largest = largest.max(*weight);
        }
        let mut total = Lanes::ZERO;
        for weight in &mut *weights {
            *weight = (*weight - largest).map(T::exp_not_positive);
            total += *weight;
        }
        for weight in weights {
            *weight = *weight / total;
        }
    }

    /// The weights of a piece from `first` on, [G, B] for its G groups.
    #[inline(always)]
    pub(crate) fn piece_weights(&self, first: usize) -> Vec<Lanes<T>> {
        let (groups, bases) = (self.piece_groups(first), self.num_bases());
        let mut weights = vec![Lanes::ZERO; groups * bases];
        for (group, weights) in weights.chunks_exact_mut(bases).enumerate() {
            self.weights(first + group * LANES, weights);
        }
        weights
    }

    /// How many groups of [`LANES`] there are in a piece from `first` on.
    #[inline(always)]
    pub(crate) fn piece_groups(&self, first: usize) -> usize {
        PIECE.min(self.rows() - first).div_ceil(LANES)
    }

    /// The bases at a moment, blended.
    #[inline(always)]
    pub(crate) fn blended(&self, moment: usize, weights: &[Lanes<T>]) -> [Lanes<T>; BASIS] {
        let mut blend = [Lanes::ZERO; BASIS];
        for (weight, basis) in weights.iter().zip(self.bases_at(moment)) {
            for (blend, value) in blend.iter_mut().zip(basis) {
                *blend += *weight * *value;
            }
        }
        blend
    }
}

/// The rotations of a blend.
#[inline(always)]
pub(crate) fn frame<T: Real>(blend: &[Lanes<T>; BASIS]) -> Frame<T> {
    Frame::of([blend[0], blend[1], blend[2], blend[3], blend[4], blend[5]])
}

/// Rows of C numbers side by side; lanes without a row are 0.
#[inline(always)]
pub(crate) fn gathered<T: Real, const C: usize>(rows: &[T]) -> [Lanes<T>; C] {
    let mut lanes = [Lanes::ZERO; C];
    for (lane, row) in rows.as_chunks::<C>().0.iter().take(LANES).enumerate() {
        for (lanes, value) in lanes.iter_mut().zip(row) {
            lanes[lane] = *value;
        }
    }
    lanes
}

/// The inverse of [`gathered`], for as many rows as there are.
#[inline(always)]
pub(crate) fn scatter<T: Real, const C: usize>(lanes: &[Lanes<T>; C], rows: &mut [T]) {
    for (lane, row) in rows.as_chunks_mut::<C>().0.iter_mut().enumerate() {
        for (value, lanes) in row.iter_mut().zip(lanes) {
            *value = lanes[lane];
        }
    }
}

/// Means [T, F, 3], and behind them rotations [T, F, 3, 3]. There is a Gaussian, a basis and a moment.
pub(crate) fn moved<T: Real>(inputs: &Inputs<'_, T>) -> Vec<T> {
    let _span = trace_span!("motion").entered();
    let (rows, bases) = (inputs.rows(), inputs.num_bases());
    let mut weights = vec![Lanes::ZERO; rows.div_ceil(LANES) * bases];
    weights
        .par_chunks_mut(bases * (PIECE / LANES))
        .enumerate()
        .for_each(|(piece, weights)| {
            vectorized(
                #[inline(always)]
                || {
                    for (group, weights) in weights.chunks_exact_mut(bases).enumerate() {
                        inputs.weights(piece * PIECE + group * LANES, weights);
                    }
                },
            );
        });
    let mut output = filled(T::ZERO, inputs.moments() * rows * 12);
    let (means, rotations) = output.split_at_mut(inputs.moments() * rows * 3);
    means
        .par_chunks_mut(rows * 3)
        .zip(rotations.par_chunks_mut(rows * 9))
        .enumerate()
        .for_each(|(moment, (means, rotations))| {
            means
                .par_chunks_mut(PIECE * 3)
                .zip(rotations.par_chunks_mut(PIECE * 9))
                .zip(weights.par_chunks(bases * (PIECE / LANES)))
                .zip(inputs.means.par_chunks(PIECE * 3))
                .for_each(|(((means, rotations), weights), canonical)| {
                    vectorized(
                        #[inline(always)]
                        || {
                            means
                                .chunks_mut(LANES * 3)
                                .zip(rotations.chunks_mut(LANES * 9))
                                .zip(weights.chunks_exact(bases))
                                .zip(canonical.chunks(LANES * 3))
                                .for_each(
                                    #[inline(always)]
                                    |(((means, rotations), weights), canonical)| {
                                        let blend = inputs.blended(moment, weights);
                                        let (moved, turned) = move_lanes(&blend, canonical);
                                        scatter(&moved, means);
                                        scatter(&turned, rotations);
                                    },
                                );
                        },
                    );
                });
        });
    output
}

/// Moved means and rotations of the Gaussians side by side.
#[inline(always)]
pub(crate) fn move_lanes<T: Real>(
    blend: &[Lanes<T>; BASIS],
    canonical: &[T],
) -> (Vectors<T>, [Lanes<T>; 9]) {
    let mean = gathered::<T, 3>(canonical);
    let [x, y, z] = frame(blend).rows();
    let moved = [
        dot(x, mean) + blend[6],
        dot(y, mean) + blend[7],
        dot(z, mean) + blend[8],
    ];
    let turned = [x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]];
    (moved, turned)
}
