//! Bilinear enlargement of a field of values, and its transpose.
//!
//! A pixel of the larger picture takes from the four of the smaller one whose centres are nearest to
//! its own; beyond the outermost centres their values go on.

use rayon::prelude::*;
use tracing::trace_span;

use host::{Real, filled, vectorized};

/// Sizes of an enlargement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct UpsampleSize {
    /// Height and width of the smaller picture.
    pub(crate) from: [usize; 2],
    /// Height and width of the larger picture.
    pub(crate) to: [usize; 2],
    pub(crate) channels: usize,
}

/// Where a pixel of the larger axis takes from: two neighbours and the share of the second.
fn taps(from: usize, to: usize) -> Vec<(usize, usize, f64)> {
    (0..to)
        .map(|i| {
            let place = (i as f64 + 0.5) * from as f64 / to as f64 - 0.5;
            let place = place.clamp(0.0, (from - 1) as f64);
            let first = place.floor() as usize;
            (first, (first + 1).min(from - 1), place - first as f64)
        })
        .collect()
}

impl UpsampleSize {
    /// Taps of the rows and of the columns.
    fn taps(self) -> [Vec<(usize, usize, f64)>; 2] {
        [0, 1].map(|axis| taps(self.from[axis], self.to[axis]))
    }
}

/// `input` `[h, w, C]` as `[H, W, C]`.
pub(crate) fn upsample<T: Real>(input: &[T], size: UpsampleSize) -> Vec<T> {
    let _span = trace_span!("upsample").entered();
    let [rows, columns] = size.taps();
    let (line, channels) = (size.from[1] * size.channels, size.channels);
    let mut output = filled(T::ZERO, size.to[0] * size.to[1] * channels);
    output
        .par_chunks_mut((size.to[1] * channels).max(1))
        .zip(rows)
        .for_each_init(
            || vec![T::ZERO; line],
            |mixed, (output, (above, below, share))| {
                vectorized(
                    #[inline(always)]
                    || {
                        let [above, below] = [above, below].map(|y| &input[y * line..][..line]);
                        mix(above, below, share, mixed);
                        for (output, &(left, right, share)) in
                            output.chunks_exact_mut(channels).zip(&columns)
                        {
                            let [left, right] =
                                [left, right].map(|x| &mixed[x * channels..][..channels]);
                            mix(left, right, share, output);
                        }
                    },
                );
            },
        );
    output
}

#[inline(always)]
fn mix<T: Real>(a: &[T], b: &[T], share: f64, out: &mut [T]) {
    let share = T::of(share);
    for (out, (&a, &b)) in out.iter_mut().zip(a.iter().zip(b)) {
        *out = a + share * (b - a);
    }
}

/// The gradient of the input from that of the output.
pub(crate) fn upsample_backward<T: Real>(gradient: &[T], size: UpsampleSize) -> Vec<T> {
    let _span = trace_span!("upsample backward").entered();
    let [rows, columns] = size.taps();
    let (channels, width) = (size.channels, size.to[1]);
    let mut output = filled(T::ZERO, size.from[0] * size.from[1] * channels);
    output
        .par_chunks_mut((size.from[1] * channels).max(1))
        .enumerate()
        .for_each(|(y, output)| {
            for (row, &(above, below, share)) in rows.iter().enumerate() {
                let mut weight = 0.0;
                if above == y {
                    weight += 1.0 - share;
                }
                if below == y {
                    weight += share;
                }
                if weight == 0.0 {
                    continue;
                }
                let gradient = &gradient[row * width * channels..][..width * channels];
                vectorized(
                    #[inline(always)]
                    || {
                        for (gradient, &(left, right, share)) in
                            gradient.chunks_exact(channels).zip(&columns)
                        {
                            for (x, share) in [(left, 1.0 - share), (right, share)] {
                                let share = T::of(weight * share);
                                let output = &mut output[x * channels..][..channels];
                                for (sum, &g) in output.iter_mut().zip(gradient) {
                                    *sum += share * g;
                                }
                            }
                        }
                    },
                );
            }
        });
    output
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::conv::tests::values;

    /// Even and odd sides, single rows and columns, a picture smaller than a block.
    fn sizes() -> [UpsampleSize; 5] {
        [
            ([2, 3], [4, 6]),
            ([3, 4], [5, 7]),
            ([1, 4], [1, 8]),
            ([5, 1], [10, 1]),
            ([1, 1], [2, 1]),
        ]
        .map(|(from, to)| UpsampleSize {
            from,
            to,
            channels: 3,
        })
    }

    #[test]
    fn a_linear_ramp_stays_one_between_the_outermost_centres() {
        let size = UpsampleSize {
            from: [4, 5],
            to: [8, 10],
            channels: 1,
        };
        let value = |y: f64, x: f64| 3.0 * y - 2.0 * x + 1.0;
        // Centres of the smaller pixels in pixels of the larger picture.
        let small: Vec<f64> = (0..20)
            .map(|i| value(2.0 * (i / 5) as f64 + 1.0, 2.0 * (i % 5) as f64 + 1.0))
            .collect();
        let large = upsample(&small, size);
        for (y, x) in (1..7).flat_map(|y| (1..9).map(move |x| (y, x))) {
            let expected = value(y as f64 + 0.5, x as f64 + 0.5);
            assert!((large[y * 10 + x] - expected).abs() < 1e-12, "at {y}, {x}");
        }
        assert_eq!(large[0], small[0], "it goes on beyond the first centre");
    }

    #[test]
    fn the_backward_is_the_adjoint() {
        for size in sizes() {
            let small = values(size.from[0] * size.from[1] * 3, 1);
            let large = values(size.to[0] * size.to[1] * 3, 2);
            let dot = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
            let forward = dot(&upsample(&small, size), &large);
            let backward = dot(&small, &upsample_backward(&large, size));
            assert!(
                (forward - backward).abs() < 1e-12,
                "{size:?}: {forward}, {backward}"
            );
        }
    }

    #[test]
    fn a_constant_stays_one() {
        for size in sizes() {
            let small = vec![0.3_f32; size.from[0] * size.from[1] * 3];
            assert!(upsample(&small, size).iter().all(|v| *v == 0.3), "{size:?}");
        }
    }
}
