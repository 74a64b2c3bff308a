//! The backward of [`predict`](super::predict::predict).

use std::ops::Range;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use tracing::trace_span;

use super::conv_backward::sum_parts;
use super::dot;
use super::predict::{FEATURES, HIDDEN, Hidden, Predictor, TILE, Weights};
use super::product::{OuterProducts, Product, padded_columns};
use host::{Real, filled};

/// Pieces of an image that gradients of parameters are summed over.
const BANDS: usize = 16;

/// Gradients of the features and of every layer, in the order of [`Predictor`]'s fields.
pub(crate) struct PredictGradients<T> {
    pub(crate) features: Option<Vec<T>>,
    /// Weight and bias.
    pub(crate) layers: [(Vec<T>, Vec<T>); 5],
}

/// Backward of [`predict`](super::predict::predict), which returned `output`.
pub(crate) fn predict_backward<T: Real>(
    net: &Predictor<'_, T>,
    output: &[T],
    gradient: &[T],
    features_wanted: bool,
) -> PredictGradients<T> {
    let _span = trace_span!("predict backward").entered();
    pulp::Arch::new().dispatch(Backward {
        net,
        output,
        gradient,
        features_wanted,
    })
}

struct Backward<'a, T> {
    net: &'a Predictor<'a, T>,
    output: &'a [T],
    gradient: &'a [T],
    features_wanted: bool,
}

impl<T: Real> WithSimd for Backward<'_, T> {
    type Output = PredictGradients<T>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> PredictGradients<T> {
        let size = self.net.size;
        let columns = padded_columns::<T, S>(size.outputs());
        let weights = Weights::new::<S>(self.net);
        let transposed = Weights::transposed::<S>(self.net, columns);
        let [encoded, joined, _] = size.inputs();
        // Rows of the parts: a layer's inputs and its bias.
        let rows = [encoded + 1, joined + 1, joined + 1, HIDDEN + 1];
        let widths = [HIDDEN, HIDDEN, HIDDEN, columns];
        let tiles = size.pixels().div_ceil(TILE);
        let per_band = tiles.div_ceil(BANDS).max(1) * TILE;
        let mut features = filled(
            T::ZERO,
            if self.features_wanted {
                size.pixels() * FEATURES
            } else {
                0
            },
        );
        let bands = size.pixels().div_ceil(per_band);
        let mut pieces: Vec<&mut [T]> = if self.features_wanted {
            features.chunks_mut(per_band * FEATURES).collect()
        } else {
            (0..bands).map(|_| Default::default()).collect()
        };
        let bands: Vec<[Vec<T>; 4]> = pieces
            .par_iter_mut()
            .enumerate()
            .map(|(band, features)| {
                let mut parts = [0, 1, 2, 3].map(|l| vec![T::ZERO; rows[l] * widths[l]]);
                let first = band * per_band;
                simd.vectorize(BackwardBand {
                    whole: &self,
                    weights: &weights,
                    transposed: &transposed,
                    columns,
                    pixels: first..(first + per_band).min(size.pixels()),
                    features,
                    parts: &mut parts,
                });
                parts
            })
            .collect();
        let mut parts: [Vec<Vec<T>>; 4] = Default::default();
        for band in bands {
            for (parts, part) in parts.iter_mut().zip(band) {
                parts.push(part);
            }
        }
        let layer = |l: usize, outputs: usize| {
            let mut weight = sum_parts(&parts[l], rows[l], widths[l], outputs);
            let bias = weight.split_off((rows[l] - 1) * outputs);
            (weight, bias)
        };
        let (heads, mut kernel_bias) = layer(3, size.outputs());
        let (mut kernel, mut intensity) = (Vec::new(), Vec::new());
        for row in heads.chunks_exact(size.outputs()) {
            let (k, m) = row.split_at(size.entries);
            kernel.extend_from_slice(k);
            intensity.extend_from_slice(m);
        }
        let intensity_bias = kernel_bias.split_off(size.entries);
        PredictGradients {
            features: self.features_wanted.then_some(features),
            layers: [
                layer(0, HIDDEN),
                layer(1, HIDDEN),
                layer(2, HIDDEN),
                (kernel, kernel_bias),
                (intensity, intensity_bias),
            ],
        }
    }
}

struct BackwardBand<'a, T> {
    whole: &'a Backward<'a, T>,
    weights: &'a Weights<T>,
    transposed: &'a Weights<T>,
    /// Of the heads' gradients.
    columns: usize,
    pixels: Range<usize>,
    /// The features' gradient, `[pixels, 32]`; empty where it is not wanted.
    features: &'a mut [T],
    /// `[in + 1, columns]` for every layer, the last row for the bias.
    parts: &'a mut [Vec<T>; 4],
}

impl<T: Real> WithSimd for BackwardBand<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            whole,
            weights,
            transposed,
            columns,
            pixels,
            features,
            parts,
        } = self;
        let size = whole.net.size;
        let outputs = size.outputs();
        let [encoded, joined, _] = size.inputs();
        let mut hidden = Hidden::new(size);
        let mut logits = vec![T::ZERO; TILE * columns];
        let mut upper = [T::ZERO; TILE * HIDDEN];
        let mut lower = vec![T::ZERO; TILE * joined];
        let product = |layer: usize, input: &[T], step: usize, output: &mut [T], output_step| {
            simd.vectorize(Product {
                input,
                window_row: step,
                row_stride: 0,
                step,
                weights: &transposed.0[layer],
                relu: false,
                output,
                output_step,
            });
        };
        for first in pixels.clone().step_by(TILE) {
            let count = TILE.min(pixels.end - first);
            hidden.fill(simd, whole.net, weights, first..first + count);
            let range = first * outputs..(first + count) * outputs;
            for (target, (y, g)) in logits.chunks_exact_mut(columns).zip(
                whole.output[range.clone()]
                    .chunks_exact(outputs)
                    .zip(whole.gradient[range].chunks_exact(outputs)),
            ) {
                heads_gradient(y, g, target);
            }
            let logits = &logits[..count * columns];
            let upper = &mut upper[..count * HIDDEN];
            add_products(simd, &hidden.last, HIDDEN, logits, columns, &mut parts[3]);
            product(3, logits, columns, upper, HIDDEN);
            mask(upper, &hidden.last, HIDDEN);
            let mut own = features
                .get_mut((first - pixels.start) * FEATURES..)
                .filter(|rest| !rest.is_empty())
                .map(|rest| &mut rest[..count * FEATURES]);
            for layer in [2, 1] {
                let lower = &mut lower[..count * joined];
                let input = &hidden.inputs[layer];
                add_products(simd, input, joined, upper, HIDDEN, &mut parts[layer]);
                product(layer, upper, HIDDEN, lower, joined);
                if let Some(own) = own.as_deref_mut().filter(|_| size.shortcut) {
                    for (own, row) in own
                        .chunks_exact_mut(FEATURES)
                        .zip(lower.chunks_exact(joined))
                    {
                        for (sum, &value) in own.iter_mut().zip(&row[HIDDEN..]) {
                            *sum += value;
                        }
                    }
                }
                for (target, row) in upper
                    .chunks_exact_mut(HIDDEN)
                    .zip(lower.chunks_exact(joined))
                {
                    target.copy_from_slice(&row[..HIDDEN]);
                }
                mask(upper, input, joined);
            }
            add_products(
                simd,
                &hidden.inputs[0],
                encoded,
                upper,
                HIDDEN,
                &mut parts[0],
            );
            if let Some(own) = own {
                let lower = &mut lower[..count * FEATURES];
                product(0, upper, HIDDEN, lower, FEATURES);
                for (sum, &value) in own.iter_mut().zip(&*lower) {
                    *sum += value;
                }
            }
        }
    }
}

/// Gradient of a pixel's logits from its kernel and intensity and their gradients; what is behind stays zero.
#[inline(always)]
fn heads_gradient<T: Real>(y: &[T], g: &[T], target: &mut [T]) {
    let entries = y.len() - 1;
    let level = dot(&y[..entries], &g[..entries]);
    for (target, (&y, &g)) in target.iter_mut().zip(y.iter().zip(g)).take(entries) {
        *target = y * (g - level);
    }
    let m = y[entries];
    target[entries] = m * (T::ONE - m) * g[entries];
}

/// Adds a tile's outer products, and its gradients to the row of the bias.
#[inline(always)]
fn add_products<T: Real, S: Simd>(
    simd: S,
    values: &[T],
    len: usize,
    gradient: &[T],
    columns: usize,
    part: &mut [T],
) {
    let (weight, bias) = part.split_at_mut(len * columns);
    simd.vectorize(OuterProducts {
        values,
        len,
        step: len,
        gradient,
        columns,
        sum: weight,
    });
    for row in gradient.chunks_exact(columns) {
        for (sum, &value) in bias.iter_mut().zip(row) {
            *sum += value;
        }
    }
}

/// Stops gradients `[pixels, 64]` where ReLU cut; `values` lie `step` apart.
#[inline(always)]
fn mask<T: Real>(gradient: &mut [T], values: &[T], step: usize) {
    for (gradient, values) in gradient
        .chunks_exact_mut(HIDDEN)
        .zip(values.chunks_exact(step))
    {
        for (g, &value) in gradient.iter_mut().zip(values) {
            *g = if value > T::ZERO { *g } else { T::ZERO };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::conv::tests::values;
    use crate::cpu::predict::predict;
    use crate::cpu::predict::tests::{buffers, naive, network, sizes};

    #[test]
    fn its_gradients_are_those_of_differences() {
        for size in sizes() {
            let start = buffers(size);
            let weights = values(size.pixels() * size.outputs(), 40);
            let loss = |b: &[Vec<f64>]| -> f64 {
                naive(&network(size, b))
                    .iter()
                    .zip(&weights)
                    .map(|(y, w)| y * w)
                    .sum()
            };
            let net = network(size, &start);
            let output = predict(&net);
            let gradients = predict_backward(&net, &output, &weights, true);
            let mut all = vec![gradients.features.expect("it was wanted")];
            for (weight, bias) in gradients.layers {
                all.extend([weight, bias]);
            }
            for (i, gradient) in all.iter().enumerate() {
                let at = i + 2;
                assert_eq!(gradient.len(), start[at].len(), "{size:?}: buffer {at}");
                let direction = values(gradient.len(), 50 + i);
                let moved = |step: f64| {
                    let mut b = start.clone();
                    b[at]
                        .iter_mut()
                        .zip(&direction)
                        .for_each(|(v, d)| *v += step * d);
                    loss(&b)
                };
                let step = 1e-6;
                let numeric = (moved(step) - moved(-step)) / (2.0 * step);
                let exact: f64 = gradient.iter().zip(&direction).map(|(g, d)| g * d).sum();
                let scale: f64 = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
                assert!(
                    (numeric - exact).abs() < 1e-6 * scale + 1e-8,
                    "{size:?}: buffer {at}: {exact:e}, by differences {numeric:e}"
                );
            }
        }
    }
}
