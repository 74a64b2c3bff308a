//! The backward of [`conv`](super::conv::conv).
//!
//! The gradient of the input is the same product as the forward pass, with the window mirrored. That of
//! the weights is a sum of outer products over the pixels.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use tracing::trace_span;

use super::conv::{ConvSize, Forward, padded};
use super::product::{OuterProducts, padded_columns};
use host::{Real, filled};

/// Pieces of an image that the gradient of the weights is summed over.
const BANDS: usize = 16;
/// Pixels that the gradient of the weights takes at a time, so that they stay in the cache.
const PIXELS: usize = 64;
/// Pixels that one task masks.
const MASK_ROWS: usize = 256;

/// Gradients of a convolution's inputs, where they were wanted.
pub(crate) struct ConvGradients<T> {
    pub(crate) input: Option<Vec<T>>,
    pub(crate) weight_and_bias: Option<(Vec<T>, Vec<T>)>,
}

/// Backward of [`conv`]; `output` is what it returned, where it ended in ReLU.
pub(crate) fn conv_backward<T: Real>(
    input: &[T],
    weight: &[T],
    output: Option<&[T]>,
    gradient: &[T],
    size: ConvSize,
    [input_wanted, weight_wanted]: [bool; 2],
) -> ConvGradients<T> {
    let masked: Option<Vec<T>> = output.map(|output| {
        let _span = trace_span!("relu backward").entered();
        let mut masked = filled(T::ZERO, gradient.len());
        let rows = MASK_ROWS * size.outputs;
        masked
            .par_chunks_mut(rows)
            .zip(gradient.par_chunks(rows).zip(output.par_chunks(rows)))
            .for_each(|(masked, (gradient, output))| {
                for (m, (&g, &o)) in masked.iter_mut().zip(gradient.iter().zip(output)) {
                    *m = if o > T::ZERO { g } else { T::ZERO };
                }
            });
        masked
    });
    let gradient = masked.as_deref().unwrap_or(gradient);
    let input_gradient = input_wanted.then(|| {
        let _span = trace_span!("conv input gradient").entered();
        let mirrored = ConvSize {
            inputs: size.outputs,
            outputs: size.inputs,
            ..size
        };
        let taps = size.kernel * size.kernel;
        pulp::Arch::new().dispatch(Forward {
            input: &padded(gradient, size.outputs, size),
            weight: |row: usize, output: usize| {
                let (tap, channel) = (row / size.outputs, row % size.outputs);
                weight[((taps - 1 - tap) * size.inputs + output) * size.outputs + channel]
            },
            bias: None,
            size: mirrored,
            relu: false,
        })
    });
    let weight_and_bias = weight_wanted.then(|| {
        let _span = trace_span!("conv weight gradient").entered();
        pulp::Arch::new().dispatch(WeightGradient {
            input: &padded(input, size.inputs, size),
            gradient,
            size,
        })
    });
    ConvGradients {
        input: input_gradient,
        weight_and_bias,
    }
}

/// Gradients of weight and bias.
struct WeightGradient<'a, T> {
    /// With borders.
    input: &'a [T],
    gradient: &'a [T],
    size: ConvSize,
}

impl<T: Real> WithSimd for WeightGradient<'_, T> {
    type Output = (Vec<T>, Vec<T>);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> (Vec<T>, Vec<T>) {
        let size = self.size;
        let taps = size.kernel * size.window_row();
        let columns = padded_columns::<T, S>(size.outputs);
        let per_band = size.height.div_ceil(BANDS).max(1);
        let parts: Vec<Vec<T>> = (0..size.height.div_ceil(per_band))
            .into_par_iter()
            .map(|band| {
                let mut part = vec![T::ZERO; (taps + 1) * columns];
                simd.vectorize(WeightGradientBand {
                    whole: &self,
                    rows: band * per_band..((band + 1) * per_band).min(size.height),
                    columns,
                    part: &mut part,
                });
                part
            })
            .collect();
        let mut sum = sum_parts(&parts, taps + 1, columns, size.outputs);
        let bias = sum.split_off(taps * size.outputs);
        (sum, bias)
    }
}

/// Sum of matrices `[rows, columns]` in their order, without the columns from `outputs` on.
pub(super) fn sum_parts<T: Real>(
    parts: &[Vec<T>],
    rows: usize,
    columns: usize,
    outputs: usize,
) -> Vec<T> {
    let mut sum = vec![T::ZERO; rows * outputs];
    sum.par_chunks_mut(outputs)
        .enumerate()
        .for_each(|(row, sum)| {
            for part in parts {
                for (sum, &value) in sum.iter_mut().zip(&part[row * columns..]) {
                    *sum += value;
                }
            }
        });
    sum
}

struct WeightGradientBand<'a, 'b, T> {
    whole: &'a WeightGradient<'b, T>,
    rows: std::ops::Range<usize>,
    columns: usize,
    /// `[taps + 1, columns]`, the last row for the bias.
    part: &'a mut [T],
}

impl<T: Real> WithSimd for WeightGradientBand<'_, '_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            whole,
            rows,
            columns,
            part,
        } = self;
        let WeightGradient {
            input,
            gradient,
            size,
        } = *whole;
        let len = size.window_row();
        let taps = size.kernel * len;
        let mut tile = vec![T::ZERO; PIXELS * columns];
        for row in rows {
            for first in (0..size.width).step_by(PIXELS) {
                let pixels = PIXELS.min(size.width - first);
                let start = (row * size.width + first) * size.outputs;
                let source = &gradient[start..start + pixels * size.outputs];
                for (target, source) in tile
                    .chunks_exact_mut(columns)
                    .zip(source.chunks_exact(size.outputs))
                {
                    target[..size.outputs].copy_from_slice(source);
                    for (sum, &value) in part[taps * columns..].iter_mut().zip(source) {
                        *sum += value;
                    }
                }
                for ky in 0..size.kernel {
                    simd.vectorize(OuterProducts {
                        values: &input[((row + ky) * size.padded_width() + first) * size.inputs..],
                        len,
                        step: size.inputs,
                        gradient: &tile[..pixels * columns],
                        columns,
                        sum: &mut part[ky * len * columns..][..len * columns],
                    });
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::conv::conv;
    use crate::cpu::conv::tests::{naive, sizes, values};

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    #[test]
    fn the_backward_is_the_adjoint() {
        for size in sizes() {
            let pixels = size.height * size.width;
            let taps = size.kernel * size.kernel * size.inputs;
            let input = values(pixels * size.inputs, 1);
            let weight = values(taps * size.outputs, 2);
            let gradient = values(pixels * size.outputs, 4);
            let zero = vec![0.0; size.outputs];
            let gradients = conv_backward(&input, &weight, None, &gradient, size, [true, true]);
            let (weight_gradient, bias_gradient) =
                gradients.weight_and_bias.expect("it was wanted");
            let input_gradient = gradients.input.expect("it was wanted");
            // Linear in each of input, weight and bias: <g, conv(direction)> = <gradient, direction>.
            for seed in 5..8 {
                let near = |a: f64, b: f64| (a - b).abs() < 1e-9 * (1.0 + a.abs());
                let direction = values(input.len(), seed);
                let change = dot(&gradient, &naive(&direction, &weight, &zero, size));
                assert!(
                    near(change, dot(&input_gradient, &direction)),
                    "input, {size:?}"
                );
                let direction = values(weight.len(), seed);
                let change = dot(&gradient, &naive(&input, &direction, &zero, size));
                assert!(
                    near(change, dot(&weight_gradient, &direction)),
                    "weight, {size:?}"
                );
                let direction = values(size.outputs, seed);
                let change = dot(
                    &gradient,
                    &naive(&input, &vec![0.0; weight.len()], &direction, size),
                );
                assert!(
                    near(change, dot(&bias_gradient, &direction)),
                    "bias, {size:?}"
                );
            }
        }
    }

    #[test]
    fn relu_stops_gradients_where_it_cut() {
        let size = ConvSize {
            height: 1,
            width: 2,
            inputs: 1,
            outputs: 1,
            kernel: 1,
        };
        let output = conv(&[2.0, -2.0], &[3.0], &[0.5], size, true);
        assert_eq!(output, [6.5, 0.0]);
        let gradients = conv_backward(
            &[2.0, -2.0],
            &[3.0],
            Some(&output),
            &[1.0, 1.0],
            size,
            [true, true],
        );
        assert_eq!(gradients.input, Some(vec![3.0, 0.0]));
        assert_eq!(gradients.weight_and_bias, Some((vec![2.0], vec![1.0])));
        assert!(
            conv(
                &[f32::NAN],
                &[1.0],
                &[0.0],
                ConvSize { width: 1, ..size },
                true
            )[0]
            .is_nan()
        );
    }
}
