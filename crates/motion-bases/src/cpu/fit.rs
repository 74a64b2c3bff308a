//! The first fit's loss and, in one go, its gradient. [`crate::fit_loss`] says what its terms are.

use host::{Real, vectorized};
use rayon::prelude::*;
use tracing::trace_span;

use super::frame::Vectors;
use super::lanes::{LANES, Lanes};
use super::moved::{BASIS, Inputs, PIECE, move_lanes};
use super::moved_backward::{Piece, joined, piece_backward, softmax_backward};
use super::vec3::{Vec3, difference, dot, scaled, sum};
use crate::fit::{ACCELERATION_WEIGHT, ALONG_RAY_WEIGHT, HIDDEN_WEIGHT, SPARSITY_WEIGHT, TRIM};
use crate::fit_data::{FitStep, Group, Hidden, MIN_DEPTH};
use crate::rotation::MAX_ENTRY;
use crate::smoothness::{REST, TRANSLATION_WEIGHT};
use crate::statistics::quantile;

/// What is fitted.
pub(crate) struct Fitted<'a, T> {
    /// [B, N * 6].
    pub(crate) rots: &'a [T],
    /// [B, N * 3].
    pub(crate) transls: &'a [T],
    /// Logits, [P, B].
    pub(crate) coefficients: &'a [T],
    /// [P, 3].
    pub(crate) means: &'a [T],
}

/// A loss, and its gradient.
pub(crate) struct Slope<T> {
    pub(crate) loss: T,
    /// In the order of [`Fitted`].
    pub(crate) gradients: [Vec<T>; 4],
}

/// Where the tracks of a piece are, over the extent; lanes behind the last track are 0.
struct Path<T> {
    /// [G, B], for G groups of [`LANES`] tracks.
    weights: Vec<Lanes<T>>,
    /// [G, N].
    positions: Vec<Vectors<T>>,
}

/// How much terms weigh, per entry where they are means.
struct Weights<T> {
    acceleration: T,
    along_ray: T,
    hidden: T,
    /// Errors of hidden entries that are larger do not count.
    limit: f64,
}

/// Loss and gradient of a step.
pub(crate) fn fit<T: Real>(fitted: &Fitted<'_, T>, step: &FitStep) -> Slope<T> {
    let _span = trace_span!("first fit").entered();
    let (problem, group) = (&step.problem, step.group());
    let frames = problem.num_frames;
    let bases = fitted.coefficients.len() / problem.num_tracks;
    let over_extent = T::of(1.0 / problem.extent);
    let rows = || group.rows();
    let coefficients = rows().flat_map(|row| &fitted.coefficients[row * bases..(row + 1) * bases]);
    let means = rows().flat_map(|row| &fitted.means[row * 3..(row + 1) * 3]);
    let coefficients: Vec<T> = coefficients.copied().collect();
    let means: Vec<T> = means.map(|mean| *mean * over_extent).collect();
    let of_frames = side_by_side(fitted, over_extent);
    let inputs = Inputs {
        coefficients: &coefficients,
        bases: &of_frames,
        means: &means,
    };

    let pieces = 0..group.len.div_ceil(PIECE);
    let paths: Vec<Path<T>> = pieces
        .into_par_iter()
        .map(|piece| {
            vectorized(
                #[inline(always)]
                || path(&inputs, piece * PIECE),
            )
        })
        .collect();
    let (limit, total) = trimmed(step, group, &paths);
    let inner = (frames.saturating_sub(2) * group.len).max(1) as f64;
    let weights = Weights {
        acceleration: T::of(ACCELERATION_WEIGHT * step.smooth / inner),
        along_ray: T::of(ALONG_RAY_WEIGHT / inner),
        hidden: T::of(0.5 * HIDDEN_WEIGHT / total),
        limit,
    };
    let sparsity = T::of(SPARSITY_WEIGHT / group.len as f64);
    let slopes: Vec<(T, Piece<T>)> = paths
        .par_iter()
        .enumerate()
        .map(|(piece, path)| {
            vectorized(
                #[inline(always)]
                || piece_slope(step, &inputs, (piece, path), &weights, sparsity),
            )
        })
        .collect();
    let (losses, slopes): (Vec<T>, Vec<Piece<T>>) = slopes.into_iter().unzip();
    let loss = losses.into_iter().fold(T::ZERO, |sum, loss| sum + loss);
    let [of_coefficients, of_bases, of_means] = joined(&inputs, slopes);

    let mut gradients = apart(fitted, &of_bases, over_extent);
    let acceleration = bases_acceleration(fitted, step, over_extent, &mut gradients);
    let [of_rots, of_transls] = gradients;
    let mut all_coefficients = vec![T::ZERO; fitted.coefficients.len()];
    let mut all_means = vec![T::ZERO; fitted.means.len()];
    for (k, row) in rows().enumerate() {
        all_coefficients[row * bases..(row + 1) * bases]
            .copy_from_slice(&of_coefficients[k * bases..(k + 1) * bases]);
        for c in 0..3 {
            all_means[3 * row + c] = of_means[3 * k + c] * over_extent;
        }
    }
    Slope {
        // Sparsity is 1 less a mean of squares, which the pieces have.
        loss: loss + acceleration + T::of(SPARSITY_WEIGHT),
        gradients: [of_rots, of_transls, all_coefficients, all_means],
    }
}

/// The bases as [`Inputs`] has them, over the extent, clamped so that a product cannot overflow.
fn side_by_side<T: Real>(fitted: &Fitted<'_, T>, over_extent: T) -> Vec<T> {
    let most = T::of(MAX_ENTRY);
    let (rots, _) = fitted.rots.as_chunks::<6>();
    let (transls, _) = fitted.transls.as_chunks::<3>();
    let both = rots.iter().zip(transls);
    both.flat_map(|(rot, transl)| {
        let rot = rot.iter().map(move |v| v.max(-most).min(most));
        rot.chain(transl.iter().map(move |v| *v * over_extent))
    })
    .collect()
}

/// The inverse of [`side_by_side`], for gradients.
fn apart<T: Real>(fitted: &Fitted<'_, T>, gradient: &[T], over_extent: T) -> [Vec<T>; 2] {
    let most = T::of(MAX_ENTRY);
    let (gradients, _) = gradient.as_chunks::<BASIS>();
    let of_rots = gradients.iter().flat_map(|g| &g[..6]).zip(fitted.rots);
    let of_rots = of_rots.map(|(g, v)| if v.abs() > most { T::ZERO } else { *g });
    let of_transls = gradients.iter().flat_map(|g| &g[6..]);
    [
        of_rots.collect(),
        of_transls.map(|g| *g * over_extent).collect(),
    ]
}

#[inline(always)]
fn path<T: Real>(inputs: &Inputs<'_, T>, first: usize) -> Path<T> {
    let (bases, frames) = (inputs.num_bases(), inputs.moments());
    let weights = inputs.piece_weights(first);
    let mut positions = Vec::with_capacity(inputs.piece_groups(first) * frames);
    for (group, weights) in weights.chunks_exact(bases).enumerate() {
        let start = first + group * LANES;
        let count = LANES.min(inputs.rows() - start);
        for frame in 0..frames {
            let blend = inputs.blended(frame, weights);
            let (mut moved, _) = move_lanes(&blend, &inputs.means[3 * start..]);
            // What stands still at the origin adds nothing to any term.
            moved
                .iter_mut()
                .for_each(|lanes| lanes.0[count..].fill(T::ZERO));
            positions.push(moved);
        }
    }
    Path { weights, positions }
}

/// The error above which hidden entries do not count, and the sum of the weights of those that do.
fn trimmed<T: Real>(step: &FitStep, group: &Group, paths: &[Path<T>]) -> (f64, f64) {
    let frames = step.problem.num_frames;
    let errors: Vec<f64> = group
        .hidden
        .iter()
        .map(|hidden| {
            let path = &paths[hidden.row / PIECE];
            let (at, lane) = hidden.place(frames);
            let projected = Projected::new(step, hidden, lane_of(&path.positions[at], lane));
            projected.error().to_f64()
        })
        .collect();
    let limit = quantile(&mut errors.clone(), TRIM);
    let counted = group.hidden.iter().zip(&errors);
    let counted = counted.filter(|(_, error)| **error <= limit);
    let total: f64 = counted.map(|(hidden, _)| hidden.weight).sum();
    (limit, total + 1e-8)
}

/// Where a hidden track is in the picture, in units of fx, as the bases have it.
struct Projected<T> {
    rows: [Vec3<T>; 3],
    pixel: [T; 2],
    inverse_depth: T,
    is_behind: bool,
    /// From where it is said to be.
    off: [T; 2],
}

impl<T: Real> Projected<T> {
    #[inline(always)]
    fn new(step: &FitStep, hidden: &Hidden, position: Vec3<T>) -> Self {
        let rows = step.problem.projections[hidden.frame].map(|row| row.map(T::of));
        let at = |[x, y, z, w]: [T; 4]| dot([x, y, z], position) + w;
        let least = T::of(MIN_DEPTH);
        let depth = at(rows[2]);
        let inverse_depth = T::ONE / depth.max(least);
        let pixel = [at(rows[0]) * inverse_depth, at(rows[1]) * inverse_depth];
        Self {
            rows: rows.map(|[x, y, z, _]| [x, y, z]),
            pixel,
            inverse_depth,
            is_behind: depth < least,
            off: [0, 1].map(|k| pixel[k] - T::of(hidden.pixel[k])),
        }
    }

    #[inline(always)]
    fn error(&self) -> T {
        (self.off[0].abs() + self.off[1].abs()) * T::of(0.5)
    }

    /// The gradient of the position, where that of each coordinate's distance is `weight`.
    #[inline(always)]
    fn backward(&self, weight: T) -> Vec3<T> {
        let of_pixel = self.off.map(|off| sign(off) * weight * self.inverse_depth);
        let across = of_pixel[0] * self.pixel[0] + of_pixel[1] * self.pixel[1];
        let of_depth = if self.is_behind { T::ZERO } else { -across };
        sum(
            scaled(self.rows[2], of_depth),
            sum(
                scaled(self.rows[0], of_pixel[0]),
                scaled(self.rows[1], of_pixel[1]),
            ),
        )
    }
}

/// What a piece adds to the loss, and its gradients.
#[inline(always)]
fn piece_slope<T: Real>(
    step: &FitStep,
    inputs: &Inputs<'_, T>,
    (piece, path): (usize, &Path<T>),
    weights: &Weights<T>,
    sparsity: T,
) -> (T, Piece<T>) {
    let (problem, group) = (&step.problem, step.group());
    let (frames, bases, first) = (problem.num_frames, inputs.num_bases(), piece * PIECE);
    let mut gradient = vec![[Lanes::ZERO; 3]; path.positions.len()];
    let mut loss = Lanes::ZERO;
    for ((positions, gradient), tracks) in path
        .positions
        .chunks_exact(frames)
        .zip(gradient.chunks_exact_mut(frames))
        .zip(group.tracks.chunks_exact(frames).skip(first / LANES))
    {
        to_tracks(tracks, positions, gradient, &mut loss);
        for inner in 1..frames.saturating_sub(1) {
            let center = problem.centers[inner].to_array().map(T::of);
            let around = inner - 1..inner + 2;
            let (positions, gradient) = (&positions[around.clone()], &mut gradient[around]);
            bend(positions, gradient, (center, weights), &mut loss);
        }
    }
    for hidden in group.hidden_in(first..first + PIECE) {
        let (at, lane) = hidden.place(frames);
        let projected = Projected::new(step, hidden, lane_of(&path.positions[at], lane));
        let error = projected.error();
        if error.to_f64() > weights.limit {
            continue;
        }
        let weight = weights.hidden * T::of(hidden.weight);
        loss[lane] += error * weight * T::of(2.0);
        for (gradient, v) in gradient[at].iter_mut().zip(projected.backward(weight)) {
            gradient[lane] += v;
        }
    }
    let still = [Lanes::ZERO; 9];
    let mut slope = piece_backward(
        inputs,
        (first, &path.weights),
        #[inline(always)]
        |frame, group| (gradient[group * frames + frame], still),
    );
    for (rows, weights) in slope
        .coefficients
        .chunks_mut(LANES * bases)
        .zip(path.weights.chunks_exact(bases))
    {
        let squares = weights.iter().map(|weight| *weight * *weight);
        let squares = squares.fold(Lanes::ZERO, |sum, square| sum + square);
        let count = rows.len() / bases;
        for square in &squares.0[..count] {
            loss[0] += -*square * sparsity;
        }
        let falling = weights
            .iter()
            .map(|weight| *weight * -(sparsity + sparsity));
        softmax_backward(weights, &falling.collect::<Vec<_>>(), rows);
    }
    (loss.total(), slope)
}

/// L1 to where the tracks are visible.
#[inline(always)]
fn to_tracks<T: Real>(
    tracks: &[[[f64; LANES]; 4]],
    positions: &[Vectors<T>],
    gradient: &mut [Vectors<T>],
    loss: &mut Lanes<T>,
) {
    for ((track, position), gradient) in tracks.iter().zip(positions).zip(gradient) {
        let [x, y, z, seen] = track.map(|lanes| Lanes(lanes.map(T::of)));
        for (k, track) in [x, y, z].into_iter().enumerate() {
            let off = position[k] - track;
            *loss += off.map(T::abs) * seen;
            gradient[k] += off.map(sign) * seen;
        }
    }
}

/// Acceleration in a frame, and motion along its rays, from positions there and in the two frames around it.
#[inline(always)]
fn bend<T: Real>(
    positions: &[Vectors<T>],
    gradient: &mut [Vectors<T>],
    (center, weights): (Vec3<T>, &Weights<T>),
    loss: &mut Lanes<T>,
) {
    let (rest, zero) = (T::of(REST), Lanes::ZERO);
    let [before, here, behind] = [positions[0], positions[1], positions[2]];
    let (into, out) = (difference(here, before), difference(behind, here));
    let acceleration = difference(out, into);
    let length = dot(acceleration, acceleration);
    let length = length.max(Lanes::all(rest * rest)).sqrt();
    let pull = Lanes::all(weights.acceleration) / length;
    let pull = scaled(acceleration, (-length).below(-rest, pull, zero));

    let ray = difference(here, center.map(Lanes::all));
    let square = dot(ray, ray);
    let inverse = Lanes::all(T::ONE) / square.max(Lanes::all(rest * rest));
    let (along_in, along_out) = (dot(into, ray), dot(out, ray));
    let share = (along_in * along_in + along_out * along_out) * inverse;
    let twice = inverse * (weights.along_ray + weights.along_ray);
    let (of_in, of_out) = (twice * along_in, twice * along_out);
    let far = (-square).below(-(rest * rest), twice * share, zero);
    let of_ray = difference(
        sum(scaled(into, of_in), scaled(out, of_out)),
        scaled(ray, far),
    );

    *loss += (length - rest) * weights.acceleration + share * weights.along_ray;
    let turned = sum(of_ray, scaled(ray, of_in - of_out));
    for k in 0..3 {
        gradient[0][k] += pull[k] - of_in * ray[k];
        gradient[1][k] += turned[k] - (pull[k] + pull[k]);
        gradient[2][k] += pull[k] + of_out * ray[k];
    }
}

/// [`crate::bases_acceleration`] with its weight; its gradient is added.
fn bases_acceleration<T: Real>(
    fitted: &Fitted<'_, T>,
    step: &FitStep,
    over_extent: T,
    [of_rots, of_transls]: &mut [Vec<T>; 2],
) -> T {
    let frames = step.problem.num_frames;
    if frames < 3 {
        return T::ZERO;
    }
    let bases = fitted.rots.len() / (6 * frames);
    let weight = step.smooth / (bases * (frames - 2)) as f64;
    mean_acceleration::<T, 6>(fitted.rots, of_rots, frames, (T::ONE, T::of(weight)))
        + mean_acceleration::<T, 3>(
            fitted.transls,
            of_transls,
            frames,
            (over_extent, T::of(weight * TRANSLATION_WEIGHT)),
        )
}

/// The sum of the lengths of second differences over time of `values` [B, N, W] by `scale`, by `weight`.
fn mean_acceleration<T: Real, const W: usize>(
    values: &[T],
    gradient: &mut [T],
    frames: usize,
    (scale, weight): (T, T),
) -> T {
    let rest = T::of(REST);
    let mut loss = T::ZERO;
    let values = values.as_chunks::<W>().0.chunks_exact(frames);
    let gradients = gradient.as_chunks_mut::<W>().0.chunks_exact_mut(frames);
    for (values, gradient) in values.zip(gradients) {
        for t in 1..frames - 1 {
            let mut acceleration = [T::ZERO; W];
            let mut square = T::ZERO;
            for c in 0..W {
                let here = values[t][c];
                acceleration[c] = (here + here - values[t - 1][c] - values[t + 1][c]) * scale;
                square += acceleration[c] * acceleration[c];
            }
            if square > rest * rest {
                let length = square.sqrt();
                loss += (length - rest) * weight;
                for c in 0..W {
                    let pull = acceleration[c] * (weight * scale / length);
                    gradient[t][c] += pull + pull;
                    gradient[t - 1][c] += -pull;
                    gradient[t + 1][c] += -pull;
                }
            }
        }
    }
    loss
}

#[inline(always)]
fn lane_of<T: Real>(vectors: &Vectors<T>, lane: usize) -> Vec3<T> {
    [vectors[0][lane], vectors[1][lane], vectors[2][lane]]
}

/// -1, 0 or 1.
#[inline(always)]
fn sign<T: Real>(value: T) -> T {
    if value > T::ZERO {
        T::ONE
    } else if value < T::ZERO {
        -T::ONE
    } else {
        T::ZERO
    }
}
