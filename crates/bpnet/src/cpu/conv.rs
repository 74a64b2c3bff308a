//! Convolution with a bias and, if wanted, ReLU. A 1x1 convolution is a dense layer.
//!
//! Pictures are `[H, W, C]`, weights `[k * k * in, out]` with rows in the order (ky, kx, in), borders
//! are zeros. A window's row is then k * in values in a row of memory, and the product needs no copy
//! of the windows: a tile of pixels x two vectors of output channels stays in registers while the
//! window's values are broadcast one by one.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::Real;

/// Pixels of a row without borders (dense layers), which one task works on.
const DENSE_ROW: usize = 252;

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
    /// A dense layer sees pixels in a row; their neighbourhood does not matter.
    pub(super) fn rows(self) -> Rows {
        let half = self.kernel / 2;
        if half == 0 {
            let pixels = self.height * self.width;
            Rows {
                count: pixels.div_ceil(DENSE_ROW),
                len: DENSE_ROW,
                stride: DENSE_ROW,
                pixels,
            }
        } else {
            Rows {
                count: self.height,
                len: self.width,
                stride: self.width + 2 * half,
                pixels: self.height * self.width,
            }
        }
    }

    pub(super) fn window_row(self) -> usize {
        self.kernel * self.inputs
    }
}

/// Rows of pixels: `len` of them (the last row may have fewer), `stride` apart with their borders.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rows {
    pub(super) count: usize,
    pub(super) len: usize,
    pub(super) stride: usize,
    pub(super) pixels: usize,
}

impl Rows {
    pub(super) fn len_of(self, row: usize) -> usize {
        self.len.min(self.pixels - row * self.len)
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
    let stride = (size.width + 2 * half) * channels;
    let mut values = vec![T::ZERO; (size.height + 2 * half) * stride];
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
        let Self {
            input,
            weight,
            bias,
            size,
            relu,
        } = self;
        let rows = size.rows();
        let mut output = vec![T::ZERO; rows.pixels * size.outputs];
        if output.is_empty() {
            return output;
        }
        // Blocks of two vectors of outputs, each with all rows of the weight; zeros fill the last.
        let block = 2 * T::lanes::<S>();
        let blocks = size.outputs.div_ceil(block);
        let taps = size.kernel * size.window_row();
        let mut packed = vec![T::ZERO; blocks * taps * block];
        let mut packed_bias = vec![T::ZERO; blocks * block];
        for (i, target) in packed.chunks_exact_mut(block).enumerate() {
            let (first, row) = (i / taps * block, i % taps);
            for (lane, value) in target.iter_mut().enumerate().take(size.outputs - first) {
                *value = weight(row, first + lane);
            }
        }
        if let Some(bias) = bias {
            packed_bias[..bias.len()].copy_from_slice(bias);
        }
        output
            .par_chunks_mut(rows.len * size.outputs)
            .enumerate()
            .for_each(|(row, output)| {
                let task = ForwardRow {
                    input: &input[row * rows.stride * size.inputs..],
                    packed: &packed,
                    bias: &packed_bias,
                    size,
                    stride: rows.stride,
                    relu,
                    output,
                };
                simd.vectorize(task);
            });
        output
    }
}

struct ForwardRow<'a, T> {
    /// From the window row of the first pixel on.
    input: &'a [T],
    packed: &'a [T],
    bias: &'a [T],
    size: ConvSize,
    stride: usize,
    relu: bool,
    output: &'a mut [T],
}

impl<T: Real> WithSimd for ForwardRow<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // 24 sums fit where there are 32 registers, 12 where there are 16.
        if T::lanes::<S>() * size_of::<T>() >= 64 {
            self.tiles::<S, 12>(simd);
        } else {
            self.tiles::<S, 6>(simd);
        }
    }
}

impl<T: Real> ForwardRow<'_, T> {
    #[inline(always)]
    fn tiles<S: Simd, const P: usize>(self, simd: S) {
        let Self {
            input,
            packed,
            bias,
            size,
            stride,
            relu,
            output,
        } = self;
        let block = 2 * T::lanes::<S>();
        let len = size.window_row();
        let taps = size.kernel * len;
        let last = output.len() / size.outputs - 1;
        let (packed, _) = T::as_vectors::<S>(packed);
        let (packed, _) = packed.as_chunks::<2>();
        let (bias, _) = T::as_vectors::<S>(bias);
        let (bias, _) = bias.as_chunks::<2>();
        for first in (0..=last).step_by(P) {
            for (index, (weights, &bias)) in packed.chunks_exact(taps).zip(bias).enumerate() {
                let mut sums = [bias; P];
                for (ky, weights) in weights.chunks_exact(len).enumerate() {
                    let windows: [&[T]; P] = std::array::from_fn(|p| {
                        let x = (first + p).min(last);
                        &input[(ky * stride + x) * size.inputs..][..len]
                    });
                    for j in 0..len {
                        let [w0, w1] = weights[j];
                        for p in 0..P {
                            let value = T::splat(simd, windows[p][j]);
                            sums[p][0] = T::mul_add(simd, value, w0, sums[p][0]);
                            sums[p][1] = T::mul_add(simd, value, w1, sums[p][1]);
                        }
                    }
                }
                let channels = block.min(size.outputs - index * block);
                for (p, sum) in sums.iter().enumerate().take(last + 1 - first) {
                    let values: &[T] = bytemuck::cast_slice(sum);
                    let start = (first + p) * size.outputs + index * block;
                    let target = &mut output[start..start + channels];
                    for (target, &value) in target.iter_mut().zip(values) {
                        // Not a number stays one.
                        *target = if relu && value < T::ZERO {
                            T::ZERO
                        } else {
                            value
                        };
                    }
                }
            }
        }
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
