//! Convolution with a bias and, if wanted, ReLU.
//!
//! Pictures are `[H, W, C]`, weights `[k * k * in, out]` with rows in the order (ky, kx, in), borders
//! are zeros. A window's row is then k * in values in a row of memory, and the product needs no copy
//! of the windows: see [`Product`](super::product::Product).

use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use tracing::trace_span;

use super::product::{Packed, Product};
use host::{Real, filled};

/// Sizes of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ConvSize {
    pub(crate) height: usize,
    pub(crate) width: usize,
    /// Channels in.
    pub(crate) inputs: usize,
    /// Channels out.
    pub(crate) outputs: usize,
    /// Side of the window in pixels.
    pub(crate) kernel: usize,
}

impl ConvSize {
    /// Values of a window's row.
    pub(super) fn window_row(self) -> usize {
        self.kernel * self.inputs
    }

    /// Width of the picture with its borders.
    pub(super) fn padded_width(self) -> usize {
        self.width + self.kernel - 1
    }
}

/// Output `[H, W, out]` of a convolution of `input` `[H, W, in]`.
pub(crate) fn conv<T: Real>(
    input: &[T],
    weight: &[T],
    bias: &[T],
    size: ConvSize,
    relu: bool,
) -> Vec<T> {
    let _span = trace_span!("conv").entered();
    let padded = padded(input, size.inputs, size);
    pulp::Arch::new().dispatch(Forward {
        input: &padded,
        weight: |row: usize, output: usize| weight[row * size.outputs + output],
        bias: Some(bias),
        size,
        relu,
    })
}

/// The picture with a border of zeros, half a window wide; as it is where there is none.
pub(super) fn padded<T: Real>(
    picture: &[T],
    channels: usize,
    size: ConvSize,
) -> std::borrow::Cow<'_, [T]> {
    let half = size.kernel / 2;
    if half == 0 || picture.is_empty() {
        return picture.into();
    }
    let row = size.width * channels;
    let stride = size.padded_width() * channels;
    let mut values = filled(T::ZERO, (size.height + 2 * half) * stride);
    values[half * stride..]
        .par_chunks_mut(stride)
        .zip(picture.par_chunks(row))
        .for_each(|(target, source)| {
            target[half * channels..][..row].copy_from_slice(source);
        });
    values.into()
}

/// The product of a forward pass, or of the gradient of the input.
pub(super) struct Forward<'a, T, W> {
    /// With borders.
    pub(super) input: &'a [T],
    /// The weight at (row, output).
    pub(super) weight: W,
    pub(super) bias: Option<&'a [T]>,
    pub(super) size: ConvSize,
    pub(super) relu: bool,
}

impl<T: Real, W: Fn(usize, usize) -> T> WithSimd for Forward<'_, T, W> {
    type Output = Vec<T>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<T> {
        let size = self.size;
        let mut output = filled(T::ZERO, size.height * size.width * size.outputs);
        if output.is_empty() {
            return output;
        }
        let taps = size.kernel * size.window_row();
        let packed = Packed::new::<S>([taps, size.outputs], self.weight, self.bias);
        let stride = size.padded_width() * size.inputs;
        output
            .par_chunks_mut(size.width * size.outputs)
            .enumerate()
            .for_each(|(row, output)| {
                simd.vectorize(Product {
                    input: &self.input[row * stride..],
                    window_row: size.window_row(),
                    row_stride: stride,
                    step: size.inputs,
                    weights: &packed,
                    relu: self.relu,
                    output,
                    output_step: size.outputs,
                });
            });
        output
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Values without a pattern, in [-1, 1].
    pub(in crate::cpu) fn values(count: usize, seed: usize) -> Vec<f64> {
        (0..count)
            .map(|i| (((i * 7919 + seed * 104_729) % 10_007) as f64 / 5003.0 - 1.0).sin())
            .collect()
    }

    pub(in crate::cpu) fn naive(
        input: &[f64],
        weight: &[f64],
        bias: &[f64],
        size: ConvSize,
    ) -> Vec<f64> {
        let half = size.kernel as isize / 2;
        let mut output = Vec::new();
        for y in 0..size.height as isize {
            for x in 0..size.width as isize {
                for o in 0..size.outputs {
                    let mut sum = bias[o];
                    for tap in 0..size.kernel * size.kernel {
                        let sy = y + (tap / size.kernel) as isize - half;
                        let sx = x + (tap % size.kernel) as isize - half;
                        if sy < 0 || sy >= size.height as isize {
                            continue;
                        }
                        if sx < 0 || sx >= size.width as isize {
                            continue;
                        }
                        let pixel = sy as usize * size.width + sx as usize;
                        for c in 0..size.inputs {
                            sum += input[pixel * size.inputs + c]
                                * weight[(tap * size.inputs + c) * size.outputs + o];
                        }
                    }
                    output.push(sum);
                }
            }
        }
        output
    }

    fn narrow(values: &[f64]) -> Vec<f32> {
        values.iter().map(|&v| v as f32).collect()
    }

    /// (height, width, inputs, outputs, kernel): narrower than a window and than a tile of pixels,
    /// channels that fill no vector, more pixels than a task takes.
    const SIZES: [(usize, usize, usize, usize, usize); 9] = [
        (1, 1, 1, 1, 1),
        (1, 1, 5, 3, 5),
        (1, 7, 3, 4, 3),
        (9, 2, 2, 33, 5),
        (6, 13, 5, 64, 5),
        (20, 27, 7, 10, 3),
        (5, 101, 6, 9, 1),
        (4, 70, 17, 81, 3),
        (3, 200, 13, 82, 1),
    ];

    pub(in crate::cpu) fn sizes() -> impl Iterator<Item = ConvSize> {
        SIZES
            .into_iter()
            .map(|(height, width, inputs, outputs, kernel)| ConvSize {
                height,
                width,
                inputs,
                outputs,
                kernel,
            })
    }

    #[test]
    fn it_is_the_sum_over_the_window() {
        for size in sizes() {
            let pixels = size.height * size.width;
            let taps = size.kernel * size.kernel * size.inputs;
            let input = values(pixels * size.inputs, 1);
            let weight = values(taps * size.outputs, 2);
            let bias = values(size.outputs, 3);
            let expected = naive(&input, &weight, &bias, size);
            let output = conv(&input, &weight, &bias, size, false);
            let rectified = conv(&input, &weight, &bias, size, true);
            let single = conv(
                &narrow(&input),
                &narrow(&weight),
                &narrow(&bias),
                size,
                false,
            );
            let largest = expected.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
            for (i, &e) in expected.iter().enumerate() {
                assert!((output[i] - e).abs() < 1e-12 * largest, "{size:?} at {i}");
                assert!(
                    (rectified[i] - e.max(0.0)).abs() < 1e-12 * largest,
                    "{size:?} at {i}"
                );
                assert!(
                    (f64::from(single[i]) - e).abs() < 2e-6 * largest,
                    "{size:?} at {i}"
                );
            }
        }
    }
}
