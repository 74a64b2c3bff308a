//! Instance norm over the columns of a matrix `[pixels, C]`.

use rayon::prelude::*;
use tracing::trace_span;

use host::{Real, filled, vectorized};

/// Rows that one task works on.
const ROWS: usize = 512;

/// Added to the variance before its root.
pub(crate) const EPSILON: f64 = 1e-5;

/// Each channel with zero mean and unit (biased) variance: `y = (x - mean) / sqrt(variance + 1e-5)`.
/// Returns y and the reciprocals of the roots.
pub(crate) fn instance_norm<T: Real>(input: &[T], channels: usize) -> (Vec<T>, Vec<T>) {
    let _span = trace_span!("instance norm").entered();
    let count = T::of((input.len() / channels) as f64);
    let mut mean: Vec<T> = column_sums(
        input.len(),
        channels,
        channels,
        #[inline(always)]
        |range, sums| {
            for row in input[range].chunks_exact(channels) {
                for (sum, &x) in sums.iter_mut().zip(row) {
                    *sum += x;
                }
            }
        },
    );
    for mean in &mut mean {
        *mean = *mean / count;
    }
    // From the deviations, not from the squares, which would cancel.
    let mut scale: Vec<T> = column_sums(
        input.len(),
        channels,
        channels,
        #[inline(always)]
        |range, sums| {
            for row in input[range].chunks_exact(channels) {
                for (sum, (&x, &mean)) in sums.iter_mut().zip(row.iter().zip(&mean)) {
                    *sum += (x - mean) * (x - mean);
                }
            }
        },
    );
    for scale in &mut scale {
        *scale = T::ONE / T::sqrt(*scale / count + T::of(EPSILON));
    }
    let mut output = filled(T::ZERO, input.len());
    for_rows(
        &mut output,
        channels,
        #[inline(always)]
        |start, rows| {
            let input = &input[start..start + rows.len()];
            for (target, row) in rows
                .chunks_exact_mut(channels)
                .zip(input.chunks_exact(channels))
            {
                for (c, target) in target.iter_mut().enumerate() {
                    *target = (row[c] - mean[c]) * scale[c];
                }
            }
        },
    );
    (output, scale)
}

/// Gradient of the input: `dx = scale (g - mean(g) - y mean(g y))`.
pub(crate) fn instance_norm_backward<T: Real>(output: &[T], scale: &[T], gradient: &[T]) -> Vec<T> {
    let _span = trace_span!("instance norm backward").entered();
    let channels = scale.len();
    let count = T::of((output.len() / channels) as f64);
    let mut means: Vec<T> = column_sums(
        output.len(),
        channels,
        2 * channels,
        #[inline(always)]
        |range, sums| {
            let (plain, weighted) = sums.split_at_mut(channels);
            for (y, g) in output[range.clone()]
                .chunks_exact(channels)
                .zip(gradient[range].chunks_exact(channels))
            {
                for c in 0..channels {
                    plain[c] += g[c];
                    weighted[c] += g[c] * y[c];
                }
            }
        },
    );
    for mean in &mut means {
        *mean = *mean / count;
    }
    let (plain, weighted) = means.split_at(channels);
    let mut input_gradient = filled(T::ZERO, output.len());
    for_rows(
        &mut input_gradient,
        channels,
        #[inline(always)]
        |start, rows| {
            let end = start + rows.len();
            for (target, (y, g)) in rows.chunks_exact_mut(channels).zip(
                output[start..end]
                    .chunks_exact(channels)
                    .zip(gradient[start..end].chunks_exact(channels)),
            ) {
                for c in 0..channels {
                    target[c] = scale[c] * (g[c] - plain[c] - y[c] * weighted[c]);
                }
            }
        },
    );
    input_gradient
}

/// Calls `fill` with pieces of whole rows, in parallel, and the index of their first element.
fn for_rows<T: Real>(values: &mut [T], channels: usize, fill: impl Fn(usize, &mut [T]) + Sync) {
    let piece = ROWS * channels;
    values
        .par_chunks_mut(piece)
        .enumerate()
        .for_each(|(i, rows)| {
            vectorized(
                #[inline(always)]
                || fill(i * piece, rows),
            );
        });
}

/// Sums over the rows of a matrix of `len` elements: `add` adds the rows of a range of elements to
/// `sums` sums. Pieces are added in their order.
fn column_sums<T: Real>(
    len: usize,
    channels: usize,
    sums: usize,
    add: impl Fn(std::ops::Range<usize>, &mut [T]) + Sync,
) -> Vec<T> {
    let piece = ROWS * channels;
    let parts: Vec<Vec<T>> = (0..len.div_ceil(piece))
        .into_par_iter()
        .map(|i| {
            let mut part = vec![T::ZERO; sums];
            vectorized(
                #[inline(always)]
                || add(i * piece..((i + 1) * piece).min(len), &mut part),
            );
            part
        })
        .collect();
    let mut total = vec![T::ZERO; sums];
    for part in parts {
        for (total, value) in total.iter_mut().zip(part) {
            *total += value;
        }
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(count: usize, seed: usize) -> Vec<f64> {
        (0..count)
            .map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f64 / 5003.0 - 1.0)
            .collect()
    }

    #[test]
    fn channels_have_zero_mean_and_unit_variance() {
        let (pixels, channels) = (1500, 3);
        let input: Vec<f64> = values(pixels * channels, 1)
            .into_iter()
            .enumerate()
            .map(|(i, v)| 1e3 * (i % channels) as f64 + v * [1.0, 5.0, 0.01][i % channels])
            .collect();
        let (output, scale) = instance_norm(&input, channels);
        for c in 0..channels {
            let channel: Vec<f64> = output.iter().skip(c).step_by(channels).copied().collect();
            let mean = channel.iter().sum::<f64>() / pixels as f64;
            let variance = channel.iter().map(|y| y * y).sum::<f64>() / pixels as f64;
            // The epsilon under the root takes a part of a small variance.
            let expected = 1.0 - 1e-5 * scale[c] * scale[c];
            assert!(mean.abs() < 1e-8, "channel {c}: mean {mean}");
            assert!(
                (variance - expected).abs() < 1e-6,
                "channel {c}: variance {variance}"
            );
        }
    }

    #[test]
    fn a_constant_channel_becomes_zero() {
        let (output, _) = instance_norm(&[3.0_f32; 40], 2);
        assert_eq!(output, [0.0; 40]);
    }
}
