//! What BP-Net has behind the scene features beside its products ([`super::product`]): the encoding, the joined heads, softmax
//! and sigmoid, and the way back through those. The formulas are in [`crate::cpu::predict`].

use cubecl::prelude::*;

use crate::cpu::predict::{AXIS, HIDDEN};

/// Numbers of a pixel's encoding.
pub(crate) const ENCODING: usize = 2 * AXIS;

/// Encoding of every pixel, `[H * W, 16]`, from those of the columns and, behind them, of the rows.
#[cube(launch)]
pub(crate) fn encoding_kernel(axes: &[f32], encoding: &mut [f32], width: usize) {
    let at = ABSOLUTE_POS;
    if at < encoding.len() {
        let (pixel, channel) = (at / ENCODING, at % ENCODING);
        let mut from = pixel % width * AXIS + channel;
        if channel >= AXIS {
            from = (width + pixel / width) * AXIS + channel - AXIS;
        }
        encoding[at] = axes[from];
    }
}

/// Weight `[64, K² + 1]` and bias of both heads, side by side.
#[cube(launch)]
pub(crate) fn heads_kernel(
    kernel_weight: &[f32],
    kernel_bias: &[f32],
    intensity_weight: &[f32],
    intensity_bias: &[f32],
    weight: &mut [f32],
    bias: &mut [f32],
    #[comptime] entries: usize,
) {
    let outputs = comptime!(entries + 1);
    let at = ABSOLUTE_POS;
    if at < comptime!((HIDDEN + 1) * (entries + 1)) {
        let (row, column) = (at / outputs, at % outputs);
        if row < HIDDEN {
            if column < entries {
                weight[at] = kernel_weight[row * entries + column];
            } else {
                weight[at] = intensity_weight[row];
            }
        } else if column < entries {
            bias[column] = kernel_bias[column];
        } else {
            bias[column] = intensity_bias[0];
        }
    }
}

/// Softmax of a pixel's first `entries` logits and sigmoid of the last one, in place: a unit for every pixel.
#[cube(launch)]
pub(crate) fn field_kernel(logits: &mut [f32], #[comptime] entries: usize) {
    let outputs = comptime!(entries + 1);
    let first = ABSOLUTE_POS * outputs;
    if first < logits.len() {
        let mut largest = logits[first];
        for k in 1..entries {
            largest = largest.max(logits[first + k]);
        }
        let mut total = 0.0f32;
        for k in 0..entries {
            let value = (logits[first + k] - largest).exp();
            logits[first + k] = value;
            total += value;
        }
        let factor = 1.0 / total;
        for k in 0..entries {
            logits[first + k] *= factor;
        }
        let x = logits[first + entries];
        let positive = x > 0.0;
        let e = (-x.abs()).exp();
        logits[first + entries] = select(positive, 1.0, e) / (1.0 + e);
    }
}

/// Gradient of the logits from kernels and intensities and their gradients: a unit for every pixel.
#[cube(launch)]
pub(crate) fn logits_kernel(
    field: &[f32],
    gradient: &[f32],
    v_logits: &mut [f32],
    #[comptime] entries: usize,
) {
    let outputs = comptime!(entries + 1);
    let first = ABSOLUTE_POS * outputs;
    if first < v_logits.len() {
        let mut level = 0.0f32;
        for k in 0..entries {
            level += field[first + k] * gradient[first + k];
        }
        for k in 0..entries {
            v_logits[first + k] = field[first + k] * (gradient[first + k] - level);
        }
        let at = first + entries;
        v_logits[at] = field[at] * (1.0 - field[at]) * gradient[at];
    }
}
