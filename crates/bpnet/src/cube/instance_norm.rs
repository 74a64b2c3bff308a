//! Instance norm over the columns of a matrix `[pixels, C]`; the formulas are in [`crate::cpu::instance_norm`].
//!
//! Sums over the pixels go in two stages: a unit for each channel of a piece of rows, then a cube for each channel. Their order
//! is fixed by the sizes alone.

use cubecl::prelude::*;
use host::cube::sums::add_units;

use crate::cpu::instance_norm::EPSILON;

const SMALL: f32 = EPSILON as f32;

/// Rows of a piece.
pub(crate) const ROWS: usize = 256;
/// Units that add up the pieces of a channel.
pub(crate) const TEAM: usize = 128;

/// What a channel's sum is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Summand {
    /// x; the result is its mean.
    Value,
    /// The squared distance of x to the other's entry for the channel; the result is 1 / sqrt(mean + 1e-5).
    Deviation,
    /// x times the other's value at the same place; the result is its mean.
    Product,
}

/// Sums of pieces of [`ROWS`] rows, `[pieces, C]`.
#[cube(launch)]
pub(crate) fn pieces_kernel(
    values: &[f32],
    other: &[f32],
    pieces: &mut [f32],
    channels: usize,
    #[comptime] summand: Summand,
) {
    let unit = ABSOLUTE_POS;
    if unit < pieces.len() {
        let channel = unit % channels;
        let rows = values.len() / channels;
        let first = unit / channels * ROWS;
        let last = (first + ROWS).min(rows);
        let mut sum = 0.0f32;
        for row in first..last {
            let at = row * channels + channel;
            if comptime!(summand == Summand::Value) {
                sum += values[at];
            } else if comptime!(summand == Summand::Deviation) {
                // From the deviations, not from the squares, which would cancel.
                let deviation = values[at] - other[channel];
                sum += deviation * deviation;
            } else {
                sum += values[at] * other[at];
            }
        }
        pieces[unit] = sum;
    }
}

/// What comes of the sums over `rows` rows, `[C]`: a cube of [`TEAM`] units for each channel.
#[cube(launch)]
pub(crate) fn channels_kernel(
    pieces: &[f32],
    result: &mut [f32],
    rows: usize,
    #[comptime] summand: Summand,
) {
    let channels = result.len();
    let number = pieces.len() / channels;
    let channel = CUBE_POS;
    let unit = UNIT_POS as usize;
    let mut sum = 0.0f32;
    let mut piece = unit;
    while piece < number {
        // A cube too many adds up the first channel for nobody.
        sum += pieces[piece * channels + channel % channels];
        piece += TEAM;
    }
    let mut shared = Shared::<[f32]>::new_slice(TEAM);
    shared[unit] = sum;
    add_units(&mut shared, TEAM, 1usize);
    if unit == 0 && channel < channels {
        let mean = shared[0] / rows as f32;
        if comptime!(summand == Summand::Deviation) {
            result[channel] = 1.0 / (mean + SMALL).sqrt();
        } else {
            result[channel] = mean;
        }
    }
}

/// y = (x - mean) scale.
#[cube(launch)]
pub(crate) fn normalize_kernel(input: &[f32], mean: &[f32], scale: &[f32], output: &mut [f32]) {
    let at = ABSOLUTE_POS;
    if at < output.len() {
        let channel = at % mean.len();
        output[at] = (input[at] - mean[channel]) * scale[channel];
    }
}

/// dx = scale (g - mean(g) - y mean(g y)).
#[cube(launch)]
pub(crate) fn normalize_backward_kernel(
    output: &[f32],
    scale: &[f32],
    gradient: &[f32],
    plain: &[f32],
    weighted: &[f32],
    v_input: &mut [f32],
) {
    let at = ABSOLUTE_POS;
    if at < v_input.len() {
        let channel = at % scale.len();
        let rest = gradient[at] - plain[channel] - output[at] * weighted[channel];
        v_input[at] = scale[channel] * rest;
    }
}
