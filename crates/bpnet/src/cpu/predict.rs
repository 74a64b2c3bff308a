//! BP-Net behind the scene features: three dense layers with ReLU, the two heads, softmax and sigmoid, in one
//! pass over tiles of pixels that stay in the cache.
//!
//! Nothing of a hidden layer is kept: the backward pass computes a tile's layers again, which costs less than
//! writing and reading them.

use std::ops::Range;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use tracing::trace_span;

use super::conv_backward::sum_parts;
use super::product::{OuterProducts, Packed, Product, padded_columns};
use super::{Real, dot, reduce, zeros};

/// Channels of the hidden layers.
pub(crate) const HIDDEN: usize = 64;
/// Channels of the scene features.
pub(crate) const FEATURES: usize = 32;
/// Channels of the encoding of one axis.
pub(crate) const AXIS: usize = 8;

/// Pixels of a tile.
const TILE: usize = 48;
/// Pieces of an image that gradients of parameters are summed over.
const BANDS: usize = 16;
/// Tiles that one task of the forward pass works on.
const TASK: usize = 16;

/// Sizes of a prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PredictSize {
    pub(crate) height: usize,
    pub(crate) width: usize,
    /// Entries K² of a blur kernel.
    pub(crate) entries: usize,
    /// Whether the features are joined to the outputs of the first two layers.
    pub(crate) shortcut: bool,
}

impl PredictSize {
    /// Values of a pixel of the output: its kernel and its intensity.
    pub(crate) fn outputs(self) -> usize {
        self.entries + 1
    }

    fn pixels(self) -> usize {
        self.height * self.width
    }

    /// Values that each of the three layers takes in.
    fn inputs(self) -> [usize; 3] {
        let joined = HIDDEN + if self.shortcut { FEATURES } else { 0 };
        [2 * AXIS + FEATURES, joined, joined]
    }
}

/// Weight `[in, out]` and bias `[out]`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Dense<'a, T> {
    pub(crate) weight: &'a [T],
    pub(crate) bias: &'a [T],
}

/// The network and what it sees.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Predictor<'a, T> {
    pub(crate) size: PredictSize,
    /// Encoding of the columns, `[W, 8]`, and of the rows, `[H, 8]`.
    pub(crate) columns: &'a [T],
    pub(crate) rows: &'a [T],
    /// `[H * W, 32]`.
    pub(crate) features: &'a [T],
    /// Inputs in the order encoding, features; then hidden, features.
    pub(crate) base: [Dense<'a, T>; 3],
    pub(crate) kernel: Dense<'a, T>,
    pub(crate) intensity: Dense<'a, T>,
}

/// Gradients of the features and of every layer, in the order of [`Predictor`]'s fields.
pub(crate) struct PredictGradients<T> {
    pub(crate) features: Option<Vec<T>>,
    /// Weight and bias.
    pub(crate) layers: [(Vec<T>, Vec<T>); 5],
}

/// Blur kernel (softmax over K² entries) and intensity (sigmoid) of every pixel, `[H * W, K² + 1]`.
pub(crate) fn predict<T: Real>(net: &Predictor<'_, T>) -> Vec<T> {
    let _span = trace_span!("predict").entered();
    pulp::Arch::new().dispatch(Forward(net))
}

/// Backward of [`predict`], which returned `output`.
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

/// The layers' weights as products want them: base and joined heads.
struct Weights<T>([Packed<T>; 4]);

impl<T: Real> Weights<T> {
    #[inline(always)]
    fn new<S: Simd>(net: &Predictor<'_, T>) -> Self {
        let inputs = net.size.inputs();
        let base = |l: usize| {
            let Dense { weight, bias } = net.base[l];
            Packed::new::<S>(
                [inputs[l], HIDDEN],
                |row, output| weight[row * HIDDEN + output],
                Some(bias),
            )
        };
        let head_bias = [net.kernel.bias, net.intensity.bias].concat();
        let heads = Packed::new::<S>(
            [HIDDEN, net.size.outputs()],
            |row, output| head_weight(net, row, output),
            Some(&head_bias),
        );
        Self([base(0), base(1), base(2), heads])
    }

    /// Their transposes: of the first layer without the rows of the encoding, of the heads with rows of zeros
    /// up to `columns`.
    #[inline(always)]
    fn transposed<S: Simd>(net: &Predictor<'_, T>, columns: usize) -> Self {
        let inputs = net.size.inputs();
        let base = |l: usize, first: usize| {
            let weight = net.base[l].weight;
            Packed::new::<S>(
                [HIDDEN, inputs[l] - first],
                |row, output| weight[(first + output) * HIDDEN + row],
                None,
            )
        };
        let outputs = net.size.outputs();
        let heads = Packed::new::<S>(
            [columns, HIDDEN],
            |row, output| {
                if row < outputs {
                    head_weight(net, output, row)
                } else {
                    T::ZERO
                }
            },
            None,
        );
        Self([base(0, 2 * AXIS), base(1, 0), base(2, 0), heads])
    }
}

#[inline(always)]
fn head_weight<T: Real>(net: &Predictor<'_, T>, row: usize, output: usize) -> T {
    let entries = net.size.entries;
    if output < entries {
        net.kernel.weight[row * entries + output]
    } else {
        net.intensity.weight[row]
    }
}

/// What the layers take in for the pixels of a tile, and the last hidden layer.
struct Hidden<T> {
    inputs: [Vec<T>; 3],
    last: Vec<T>,
}

impl<T: Real> Hidden<T> {
    fn new(size: PredictSize) -> Self {
        Self {
            inputs: size.inputs().map(|inputs| vec![T::ZERO; TILE * inputs]),
            last: vec![T::ZERO; TILE * HIDDEN],
        }
    }

    /// Computes the hidden layers of some pixels.
    #[inline(always)]
    fn fill<S: Simd>(
        &mut self,
        simd: S,
        net: &Predictor<'_, T>,
        weights: &Weights<T>,
        pixels: Range<usize>,
    ) {
        let size = net.size;
        let count = pixels.len();
        let [first, second, third] = &mut self.inputs;
        let features = |pixel: usize| &net.features[pixel * FEATURES..][..FEATURES];
        for (input, pixel) in first
            .chunks_exact_mut(2 * AXIS + FEATURES)
            .zip(pixels.clone())
        {
            let (y, x) = (pixel / size.width, pixel % size.width);
            input[..AXIS].copy_from_slice(&net.columns[x * AXIS..][..AXIS]);
            input[AXIS..2 * AXIS].copy_from_slice(&net.rows[y * AXIS..][..AXIS]);
            input[2 * AXIS..].copy_from_slice(features(pixel));
        }
        if size.shortcut {
            for joined in [&mut *second, &mut *third] {
                for (input, pixel) in joined
                    .chunks_exact_mut(HIDDEN + FEATURES)
                    .zip(pixels.clone())
                {
                    input[HIDDEN..].copy_from_slice(features(pixel));
                }
            }
        }
        let [encoded, joined, _] = size.inputs();
        let dense =
            |layer: usize, input: &[T], step: usize, output: &mut [T], output_step: usize| {
                simd.vectorize(Product {
                    input,
                    window_row: step,
                    row_stride: 0,
                    step,
                    weights: &weights.0[layer],
                    relu: true,
                    output: &mut output[..count * output_step],
                    output_step,
                });
            };
        dense(0, first, encoded, second, joined);
        dense(1, second, joined, third, joined);
        dense(2, third, joined, &mut self.last, HIDDEN);
    }
}

struct Forward<'a, T>(&'a Predictor<'a, T>);

impl<T: Real> WithSimd for Forward<'_, T> {
    type Output = Vec<T>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<T> {
        let net = self.0;
        let outputs = net.size.outputs();
        let weights = Weights::new::<S>(net);
        let mut output = zeros(net.size.pixels() * outputs);
        output
            .par_chunks_mut(TASK * TILE * outputs)
            .enumerate()
            .for_each_init(
                || Hidden::new(net.size),
                |hidden, (task, output)| {
                    simd.vectorize(ForwardTask {
                        net,
                        weights: &weights,
                        first: task * TASK * TILE,
                        hidden,
                        output,
                    });
                },
            );
        output
    }
}

struct ForwardTask<'a, T> {
    net: &'a Predictor<'a, T>,
    weights: &'a Weights<T>,
    first: usize,
    hidden: &'a mut Hidden<T>,
    output: &'a mut [T],
}

impl<T: Real> WithSimd for ForwardTask<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let outputs = self.net.size.outputs();
        for (tile, output) in self.output.chunks_mut(TILE * outputs).enumerate() {
            let first = self.first + tile * TILE;
            let pixels = first..first + output.len() / outputs;
            self.hidden.fill(simd, self.net, self.weights, pixels);
            simd.vectorize(Product {
                input: &self.hidden.last,
                window_row: HIDDEN,
                row_stride: 0,
                step: HIDDEN,
                weights: &self.weights.0[3],
                relu: false,
                output: &mut *output,
                output_step: outputs,
            });
            for row in output.chunks_exact_mut(outputs) {
                let (kernel, intensity) = row.split_at_mut(outputs - 1);
                softmax(kernel);
                intensity[0] = sigmoid(intensity[0]);
            }
        }
    }
}

/// Softmax of a row, in place.
#[inline(always)]
fn softmax<T: Real>(row: &mut [T]) {
    let largest = reduce(row, row[0], |a, b| if b > a { b } else { a });
    for x in &mut *row {
        *x = (*x - largest).exp_not_positive();
    }
    let factor = T::ONE / reduce(row, T::ZERO, |a, b| a + b);
    for x in row {
        *x = *x * factor;
    }
}

#[inline(always)]
fn sigmoid<T: Real>(x: T) -> T {
    let positive = x > T::ZERO;
    let e = (if positive { T::ZERO - x } else { x }).exp_not_positive();
    (if positive { T::ONE } else { e }) / (T::ONE + e)
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
        let mut features = zeros(if self.features_wanted {
            size.pixels() * FEATURES
        } else {
            0
        });
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
        let mut upper = vec![T::ZERO; TILE * HIDDEN];
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

    /// The network in plain loops.
    fn naive(net: &Predictor<'_, f64>) -> Vec<f64> {
        let PredictSize {
            width,
            entries,
            shortcut,
            ..
        } = net.size;
        let dense = |input: &[f64], layer: Dense<'_, f64>, outputs: usize| -> Vec<f64> {
            assert_eq!(layer.weight.len(), input.len() * outputs, "the layer fits");
            let product = |o: usize| -> f64 {
                input
                    .iter()
                    .enumerate()
                    .map(|(i, v)| v * layer.weight[i * outputs + o])
                    .sum()
            };
            (0..outputs).map(|o| layer.bias[o] + product(o)).collect()
        };
        let mut output = Vec::new();
        for pixel in 0..net.size.pixels() {
            let (y, x) = (pixel / width, pixel % width);
            let features = &net.features[pixel * FEATURES..][..FEATURES];
            let mut hidden = [
                &net.columns[x * AXIS..][..AXIS],
                &net.rows[y * AXIS..][..AXIS],
            ]
            .concat();
            for (l, layer) in net.base.into_iter().enumerate() {
                if l == 0 || shortcut {
                    hidden.extend_from_slice(features);
                }
                hidden = dense(&hidden, layer, HIDDEN);
                hidden.iter_mut().for_each(|v| *v = v.max(0.0));
            }
            let logits = dense(&hidden, net.kernel, entries);
            let largest = logits.iter().fold(f64::MIN, |m, &v| m.max(v));
            let total: f64 = logits.iter().map(|v| (v - largest).exp()).sum();
            output.extend(logits.iter().map(|v| (v - largest).exp() / total));
            output.push(1.0 / (1.0 + (-dense(&hidden, net.intensity, 1)[0]).exp()));
        }
        output
    }

    /// Buffers of a network with values without a pattern.
    fn buffers(size: PredictSize) -> Vec<Vec<f64>> {
        let [a, b, c] = size.inputs();
        let lengths = [
            size.width * AXIS,
            size.height * AXIS,
            size.pixels() * FEATURES,
            a * HIDDEN,
            HIDDEN,
            b * HIDDEN,
            HIDDEN,
            c * HIDDEN,
            HIDDEN,
            HIDDEN * size.entries,
            size.entries,
            HIDDEN,
            1,
        ];
        lengths
            .iter()
            .enumerate()
            .map(|(i, &n)| values(n, i).iter().map(|v| 0.4 * v).collect())
            .collect()
    }

    fn network<T>(size: PredictSize, b: &[Vec<T>]) -> Predictor<'_, T> {
        let dense = |i: usize| Dense {
            weight: &b[i],
            bias: &b[i + 1],
        };
        Predictor {
            size,
            columns: &b[0],
            rows: &b[1],
            features: &b[2],
            base: [dense(3), dense(5), dense(7)],
            kernel: dense(9),
            intensity: dense(11),
        }
    }

    /// One pixel, less than a tile, more than a task, widths that fill no vector.
    fn sizes() -> Vec<PredictSize> {
        [
            (1, 1, 1, true),
            (3, 5, 9, false),
            (7, 13, 25, true),
            (29, 31, 81, true),
        ]
        .map(|(height, width, entries, shortcut)| PredictSize {
            height,
            width,
            entries,
            shortcut,
        })
        .to_vec()
    }

    #[test]
    fn it_is_the_network_in_plain_loops() {
        for size in sizes() {
            let wide = buffers(size);
            let narrow: Vec<Vec<f32>> = wide
                .iter()
                .map(|b| b.iter().map(|&v| v as f32).collect())
                .collect();
            let expected = naive(&network(size, &wide));
            let output = predict(&network(size, &wide));
            let single = predict(&network(size, &narrow));
            assert_eq!(output.len(), expected.len(), "{size:?}");
            for ((a, b), c) in expected.iter().zip(output).zip(single) {
                assert!((a - b).abs() < 1e-13, "{size:?}: {a} and {b}");
                assert!(
                    (a - f64::from(c)).abs() < 2e-5 * (a + 0.01),
                    "{size:?}: {a} and {c}"
                );
            }
        }
    }

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

    #[test]
    fn softmax_sums_to_one_at_any_logits() {
        for channels in [1, 9, 81, 225] {
            let logits: Vec<f64> = values(channels, 2).iter().map(|v| v * 500.0).collect();
            let mut narrow: Vec<f32> = logits.iter().map(|&v| v as f32).collect();
            let mut wide = logits.clone();
            softmax(&mut wide);
            softmax(&mut narrow);
            let largest = logits.iter().fold(f64::MIN, |m, &v| m.max(v));
            let total: f64 = logits.iter().map(|v| (v - largest).exp()).sum();
            for (y, x) in wide.iter().zip(&logits) {
                assert!((y - (x - largest).exp() / total).abs() < 1e-14, "{y}");
            }
            let total: f64 = narrow.iter().map(|&y| f64::from(y)).sum();
            assert!((total - 1.0).abs() < 1e-6, "a row sums to {total}");
        }
    }

    #[test]
    fn the_sigmoid_holds_at_its_ends() {
        for x in [-1e4, -700.0, -80.0, -3.0, 0.0, 0.5, 40.0, 1e4_f64] {
            let exact = 1.0 / (1.0 + (-x).exp());
            assert!((sigmoid(x) - exact).abs() <= 1e-15 * exact, "sigmoid({x})");
            let single = f64::from(sigmoid(x as f32));
            assert!(
                (single - exact).abs() <= 3e-7 * exact + 1e-37,
                "sigmoid({x}) in f32"
            );
        }
        assert!(sigmoid(f32::NAN).is_nan(), "not a number stays one");
    }
}
