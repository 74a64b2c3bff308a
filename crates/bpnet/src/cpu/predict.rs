//! BP-Net behind the scene features: three dense layers with ReLU, the two heads, softmax and sigmoid, in one
//! pass over tiles of pixels that stay in the cache.
//!
//! Nothing of a hidden layer is kept: the backward pass (`predict_backward`) computes a tile's layers again, which
//! costs less than writing and reading them.

use std::ops::Range;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use tracing::trace_span;

use super::product::{Packed, Product};
use super::reduce;
use host::{Real, filled};

/// Channels of the hidden layers.
pub(crate) const HIDDEN: usize = 64;
/// Channels of the scene features.
pub(crate) const FEATURES: usize = 32;
/// Channels of the encoding of one axis.
pub(crate) const AXIS: usize = 8;

/// Pixels of a tile.
pub(super) const TILE: usize = 48;
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

    pub(super) fn pixels(self) -> usize {
        self.height * self.width
    }

    /// Values that each of the three layers takes in.
    pub(super) fn inputs(self) -> [usize; 3] {
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

/// Blur kernel (softmax over K² entries) and intensity (sigmoid) of every pixel, `[H * W, K² + 1]`.
pub(crate) fn predict<T: Real>(net: &Predictor<'_, T>) -> Vec<T> {
    let _span = trace_span!("predict").entered();
    pulp::Arch::new().dispatch(Forward(net))
}

/// The layers' weights as products want them: base and joined heads.
pub(super) struct Weights<T>(pub(super) [Packed<T>; 4]);

impl<T: Real> Weights<T> {
    #[inline(always)]
    pub(super) fn new<S: Simd>(net: &Predictor<'_, T>) -> Self {
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
    pub(super) fn transposed<S: Simd>(net: &Predictor<'_, T>, columns: usize) -> Self {
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
pub(super) struct Hidden<T> {
    pub(super) inputs: [Vec<T>; 3],
    pub(super) last: Vec<T>,
}

impl<T: Real> Hidden<T> {
    pub(super) fn new(size: PredictSize) -> Self {
        Self {
            inputs: size.inputs().map(|inputs| vec![T::ZERO; TILE * inputs]),
            last: vec![T::ZERO; TILE * HIDDEN],
        }
    }

    /// Computes the hidden layers of some pixels.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(
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
        let mut output = filled(T::ZERO, net.size.pixels() * outputs);
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

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::cpu::conv::tests::values;

    /// The network in plain loops.
    pub(in crate::cpu) fn naive(net: &Predictor<'_, f64>) -> Vec<f64> {
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
    pub(in crate::cpu) fn buffers(size: PredictSize) -> Vec<Vec<f64>> {
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

    pub(in crate::cpu) fn network<T>(size: PredictSize, b: &[Vec<T>]) -> Predictor<'_, T> {
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
    pub(in crate::cpu) fn sizes() -> Vec<PredictSize> {
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
