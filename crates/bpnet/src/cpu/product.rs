//! Products of rows of pixels with a matrix, and with each other: what convolutions and dense layers
//! are made of. A tile of the result stays in registers: pixels x two vectors of output channels.

use pulp::{Simd, WithSimd};

use host::Real;

/// A weight matrix `[taps, outputs]` and its bias, in blocks of two vectors of outputs, each with all
/// taps; zeros fill the last block.
pub(super) struct Packed<T> {
    values: Vec<T>,
    bias: Vec<T>,
    taps: usize,
    outputs: usize,
}

impl<T: Real> Packed<T> {
    #[inline(always)]
    pub(super) fn new<S: Simd>(
        [taps, outputs]: [usize; 2],
        weight: impl Fn(usize, usize) -> T,
        bias: Option<&[T]>,
    ) -> Self {
        let block = 2 * T::lanes::<S>();
        let blocks = outputs.div_ceil(block);
        let mut values = vec![T::ZERO; blocks * taps * block];
        for (i, target) in values.chunks_exact_mut(block).enumerate() {
            let (first, row) = (i / taps * block, i % taps);
            for (lane, value) in target.iter_mut().enumerate().take(outputs - first) {
                *value = weight(row, first + lane);
            }
        }
        let mut padded_bias = vec![T::ZERO; blocks * block];
        if let Some(bias) = bias {
            padded_bias[..outputs].copy_from_slice(bias);
        }
        Self {
            values,
            bias: padded_bias,
            taps,
            outputs,
        }
    }
}

/// A row of pixels times a weight matrix, plus a bias, then ReLU if wanted.
pub(super) struct Product<'a, T> {
    /// From the first pixel's window on.
    pub(super) input: &'a [T],
    /// Values in a row of a window, one after the other.
    pub(super) window_row: usize,
    /// From one row of a window to the next.
    pub(super) row_stride: usize,
    /// From one pixel to the next.
    pub(super) step: usize,
    pub(super) weights: &'a Packed<T>,
    pub(super) relu: bool,
    /// From the first pixel's outputs on, whole steps.
    pub(super) output: &'a mut [T],
    /// From the outputs of one pixel to those of the next.
    pub(super) output_step: usize,
}

impl<T: Real> WithSimd for Product<'_, T> {
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

impl<T: Real> Product<'_, T> {
    #[inline(always)]
    fn tiles<S: Simd, const P: usize>(self, simd: S) {
        let Self {
            input,
            window_row,
            row_stride,
            step,
            weights,
            relu,
            output,
            output_step,
        } = self;
        let (taps, outputs) = (weights.taps, weights.outputs);
        let block = 2 * T::lanes::<S>();
        let last = output.len() / output_step - 1;
        let packed = T::vectors::<S>(&weights.values);
        let (packed, _) = packed.as_chunks::<2>();
        let bias = T::vectors::<S>(&weights.bias);
        let (bias, _) = bias.as_chunks::<2>();
        for first in (0..=last).step_by(P) {
            for (index, (weights, &bias)) in packed.chunks_exact(taps).zip(bias).enumerate() {
                let mut sums = [bias; P];
                for (ky, weights) in weights.chunks_exact(window_row).enumerate() {
                    let windows: [&[T]; P] = std::array::from_fn(|p| {
                        let x = (first + p).min(last);
                        &input[ky * row_stride + x * step..][..window_row]
                    });
                    for j in 0..window_row {
                        let [w0, w1] = weights[j];
                        for p in 0..P {
                            let value = T::splat(simd, windows[p][j]);
                            sums[p][0] = T::mul_add(simd, value, w0, sums[p][0]);
                            sums[p][1] = T::mul_add(simd, value, w1, sums[p][1]);
                        }
                    }
                }
                let channels = block.min(outputs - index * block);
                for (p, sum) in sums.iter().enumerate().take(last + 1 - first) {
                    let values: &[T] = bytemuck::cast_slice(sum);
                    let start = (first + p) * output_step + index * block;
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

/// Adds the outer products of pixels' values and their gradients to a matrix.
pub(super) struct OuterProducts<'a, T> {
    /// From the first pixel's values on.
    pub(super) values: &'a [T],
    /// Values of a pixel, one after the other.
    pub(super) len: usize,
    /// From one pixel to the next.
    pub(super) step: usize,
    /// `[pixels, columns]`.
    pub(super) gradient: &'a [T],
    /// A multiple of two vectors ([`padded_columns`]).
    pub(super) columns: usize,
    /// `[len, columns]`.
    pub(super) sum: &'a mut [T],
}

/// Output channels, rounded up to what [`OuterProducts`] works on.
#[inline(always)]
pub(super) fn padded_columns<T: Real, S: Simd>(outputs: usize) -> usize {
    outputs.next_multiple_of(2 * T::lanes::<S>())
}

impl<T: Real> WithSimd for OuterProducts<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        for column in (0..self.columns).step_by(2 * T::lanes::<S>()) {
            let mut j = 0;
            while j + 12 <= self.len {
                self.accumulate::<S, 12>(simd, j, column);
                j += 12;
            }
            while j + 4 <= self.len {
                self.accumulate::<S, 4>(simd, j, column);
                j += 4;
            }
            while j < self.len {
                self.accumulate::<S, 1>(simd, j, column);
                j += 1;
            }
        }
    }
}

impl<T: Real> OuterProducts<'_, T> {
    /// J values and two vectors of gradient, over all pixels.
    #[inline(always)]
    fn accumulate<S: Simd, const J: usize>(&mut self, simd: S, j: usize, column: usize) {
        let lanes = T::lanes::<S>();
        let (step, columns) = (self.step, self.columns);
        let mut sums = [[T::splat(simd, T::ZERO); 2]; J];
        let pixels = self.gradient.len() / columns;
        // Checked once here, so that the loop has no way out that would force the sums into memory.
        let values = &self.values[j..][..(pixels - 1) * step + J];
        for pixel in 0..pixels {
            let gradient = &self.gradient[pixel * columns + column..][..2 * lanes];
            let gradient = T::vectors::<S>(gradient);
            let (g0, g1) = (gradient[0], gradient[1]);
            let values = &values[pixel * step..][..J];
            for j in 0..J {
                let value = T::splat(simd, values[j]);
                sums[j][0] = T::mul_add(simd, value, g0, sums[j][0]);
                sums[j][1] = T::mul_add(simd, value, g1, sums[j][1]);
            }
        }
        // Copied out one by one, so that no index that varies forces the sums into memory.
        let stored: [[T::Vector<S>; 2]; J] = std::array::from_fn(|j| sums[j]);
        for (k, sum) in stored.iter().enumerate() {
            let values: &[T] = bytemuck::cast_slice(sum);
            for (target, &value) in self.sum[(j + k) * columns + column..]
                .iter_mut()
                .zip(values)
            {
                *target += value;
            }
        }
    }
}
