//! Structural similarity (Wang et al., 2004) and its gradient, on slices.
//!
//! With G the Gaussian window and * convolution: m = G * a, n = G * b, p = G * a², q = G * b², r = G * ab;
//! SSIM = (2 m n + C1) (2 (r - m n) + C2) / ((m² + n² + C1) (p - m² + q - n² + C2)).
//! The window is symmetric, so the gradient of Σ SSIM by a is G * ∂m + 2 a (G * ∂p) + b (G * ∂r), with ∂ the partial
//! derivatives of one pixel's SSIM by its statistics.

use host::{Real, vectorized};
use rayon::prelude::*;

/// Pixels between the window's centre and its edge.
pub(crate) const WINDOW_EDGE: usize = 5;
pub(crate) const TAPS: usize = 2 * WINDOW_EDGE + 1;
const SIGMA: f64 = 1.5;
pub(crate) const C1: f64 = 1e-4;
pub(crate) const C2: f64 = 9e-4;

/// What is kept of every pixel and channel: SSIM and its derivatives by m, p and r.
const LANES: usize = 4;

/// Samples of a pixel.
pub(crate) const CHANNELS: usize = 3;

/// Mean absolute difference and mean SSIM of two pictures [H, W, 3], each times its weight; and the gradient by `a`, if
/// wanted.
pub(crate) fn image_loss<T: Real>(
    a: &[T],
    b: &[T],
    [height, width]: [usize; 2],
    [l1_weight, ssim_weight]: [f64; 2],
    wanted: bool,
) -> (f64, Option<Vec<T>>) {
    let count = (height * width * CHANNELS) as f64;
    let pixels = lanes(a, b, width, height);
    let mut value = ssim_weight * sum_first_lane(&pixels, width) / count;
    if l1_weight != 0.0 {
        value += l1_weight * sum_of_differences(a, b, width) / count;
    }
    let scales = [l1_weight, ssim_weight].map(|w| T::of(w / count));
    let gradient = wanted.then(|| gradient(a, b, &pixels, width, height, scales));
    (value, gradient)
}

/// SSIM of every pixel and channel, [H, W, 3], with zeros outside the picture.
pub(crate) fn ssim_map<T: Real>(a: &[T], b: &[T], width: usize, height: usize) -> Vec<T> {
    let row = width * CHANNELS;
    lanes(a, b, width, height)
        .chunks_exact(LANES * row)
        .flat_map(|lanes| &lanes[..row])
        .copied()
        .collect()
}

/// The normalised window along one axis.
pub(crate) fn window<T: Real>() -> [T; TAPS] {
    let weight = |k: usize| {
        let x = k as f64 - WINDOW_EDGE as f64;
        (-x * x / (2.0 * SIGMA * SIGMA)).exp()
    };
    let sum: f64 = (0..TAPS).map(weight).sum();
    std::array::from_fn(|k| T::of(weight(k) / sum))
}

/// The taps of the window whose rows lie in the picture when it is centred on `y`, with these rows.
fn rows_under(y: usize, height: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..TAPS).filter_map(move |tap| {
        let row = (y + tap).checked_sub(WINDOW_EDGE)?;
        (row < height).then_some((tap, row))
    })
}

/// Convolves a row that has zeros of the window's half-width on either side.
#[inline(always)]
fn along_row<T: Real>(padded: &[T], weights: &[T; TAPS], out: &mut [T]) {
    let length = out.len();
    out.fill(T::ZERO);
    for (tap, weight) in weights.iter().enumerate() {
        for (o, v) in out.iter_mut().zip(&padded[tap * CHANNELS..][..length]) {
            *o += *weight * *v;
        }
    }
}

/// SSIM, ∂m, ∂p and ∂r, [H, 4, W * 3].
fn lanes<T: Real>(a: &[T], b: &[T], width: usize, height: usize) -> Vec<T> {
    let row = width * CHANNELS;
    let pad = WINDOW_EDGE * CHANNELS;
    let weights = window::<T>();
    let mut out = vec![T::ZERO; height * LANES * row];
    if row == 0 {
        return out;
    }
    out.par_chunks_exact_mut(LANES * row)
        .enumerate()
        .for_each_init(
            || (vec![T::ZERO; 5 * (row + 2 * pad)], vec![T::ZERO; 5 * row]),
            |(padded, statistics), (y, out)| {
                vectorized(
                    #[inline(always)]
                    || {
                        padded.fill(T::ZERO);
                        {
                            let mut parts = padded.chunks_exact_mut(row + 2 * pad);
                            let [m, n, p, q, r] = std::array::from_fn(|_| {
                                &mut parts.next().expect("five statistics")[pad..pad + row]
                            });
                            for (tap, source) in rows_under(y, height) {
                                let weight = weights[tap];
                                let (a, b) = (&a[source * row..][..row], &b[source * row..][..row]);
                                for ((((((a, b), m), n), p), q), r) in a
                                    .iter()
                                    .zip(b)
                                    .zip(&mut *m)
                                    .zip(&mut *n)
                                    .zip(&mut *p)
                                    .zip(&mut *q)
                                    .zip(&mut *r)
                                {
                                    let (wa, wb) = (weight * *a, weight * *b);
                                    *m += wa;
                                    *n += wb;
                                    *p += wa * *a;
                                    *q += wb * *b;
                                    *r += wa * *b;
                                }
                            }
                        }
                        for (padded, out) in padded
                            .chunks_exact(row + 2 * pad)
                            .zip(statistics.chunks_exact_mut(row))
                        {
                            along_row(padded, &weights, out);
                        }
                        let mut parts = statistics.chunks_exact(row);
                        let [m, n, p, q, r] =
                            std::array::from_fn(|_| parts.next().expect("five statistics"));
                        let mut parts = out.chunks_exact_mut(row);
                        let [s, dm, dp, dr] =
                            std::array::from_fn(|_| parts.next().expect("four lanes"));
                        for k in 0..row {
                            let similarity = Similarity::new(m[k], n[k], p[k], q[k], r[k]);
                            s[k] = similarity.value;
                            dm[k] = similarity.by_m;
                            dp[k] = similarity.by_p;
                            dr[k] = similarity.by_r;
                        }
                    },
                );
            },
        );
    out
}

/// SSIM of one pixel and channel, with its derivatives by m, p and r.
struct Similarity<T> {
    value: T,
    by_m: T,
    by_p: T,
    by_r: T,
}

impl<T: Real> Similarity<T> {
    #[inline(always)]
    fn new(m: T, n: T, p: T, q: T, r: T) -> Self {
        let two = T::of(2.0);
        let positive = |v: T| if v > T::ZERO { v } else { T::ZERO };
        // Variances are not negative, but rounding can make them so where a picture is bright and flat.
        let variances = positive(p - m * m) + positive(q - n * n);
        let means = two * m * n + T::of(C1);
        let covariance = two * (r - m * n) + T::of(C2);
        let below_means = T::of(1.0) / (m * m + n * n + T::of(C1));
        let below_variances = T::of(1.0) / (variances + T::of(C2));
        let below = below_means * below_variances;
        let value = means * covariance * below;
        Self {
            value,
            by_m: two * n * (covariance - means) * below
                - two * m * value * (below_means - below_variances),
            by_p: -value * below_variances,
            by_r: two * means * below,
        }
    }
}

/// The gradient by `a` of the sums of |a - b| and of SSIM, each times its scale, [H, W, 3].
fn gradient<T: Real>(
    a: &[T],
    b: &[T],
    pixels: &[T],
    width: usize,
    height: usize,
    [l1_scale, ssim_scale]: [T; 2],
) -> Vec<T> {
    let row = width * CHANNELS;
    let pad = WINDOW_EDGE * CHANNELS;
    let weights = window::<T>();
    let mut out = vec![T::ZERO; a.len()];
    if row == 0 {
        return out;
    }
    out.par_chunks_exact_mut(row).enumerate().for_each_init(
        || (vec![T::ZERO; 3 * (row + 2 * pad)], vec![T::ZERO; 3 * row]),
        |(padded, blurred), (y, out)| {
            vectorized(
                #[inline(always)]
                || {
                    padded.fill(T::ZERO);
                    for (tap, source) in rows_under(y, height) {
                        let partials = &pixels[source * LANES * row..][row..LANES * row];
                        for (padded, partial) in padded
                            .chunks_exact_mut(row + 2 * pad)
                            .zip(partials.chunks_exact(row))
                        {
                            for (o, v) in padded[pad..].iter_mut().zip(partial) {
                                *o += weights[tap] * *v;
                            }
                        }
                    }
                    for (padded, out) in padded
                        .chunks_exact(row + 2 * pad)
                        .zip(blurred.chunks_exact_mut(row))
                    {
                        along_row(padded, &weights, out);
                    }
                    let (dm, rest) = blurred.split_at(row);
                    let (dp, dr) = rest.split_at(row);
                    let (a, b) = (&a[y * row..][..row], &b[y * row..][..row]);
                    for k in 0..row {
                        let ssim = dm[k] + T::of(2.0) * a[k] * dp[k] + b[k] * dr[k];
                        let difference = a[k] - b[k];
                        let sign = if difference > T::ZERO {
                            l1_scale
                        } else if difference < T::ZERO {
                            -l1_scale
                        } else {
                            T::ZERO
                        };
                        out[k] = ssim_scale * ssim + sign;
                    }
                },
            );
        },
    );
    out
}

/// Row by row, so that the order of the sum does not depend on threads.
fn sum_first_lane<T: Real>(pixels: &[T], width: usize) -> f64 {
    let row = width * CHANNELS;
    let rows: Vec<f64> = pixels
        .par_chunks_exact((LANES * row).max(1))
        .map(|lanes| lanes[..row].iter().map(|v| v.to_f64()).sum())
        .collect();
    rows.into_iter().sum()
}

/// Σ |a - b|, row by row as well.
fn sum_of_differences<T: Real>(a: &[T], b: &[T], width: usize) -> f64 {
    let row = (width * CHANNELS).max(1);
    let rows: Vec<f64> = a
        .par_chunks_exact(row)
        .zip(b.par_chunks_exact(row))
        .map(|(a, b)| a.iter().zip(b).map(|(a, b)| (*a - *b).abs().to_f64()).sum())
        .collect();
    rows.into_iter().sum()
}
