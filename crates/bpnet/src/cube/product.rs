//! Products of rows of pixels with a matrix, and with each other, what convolutions and dense layers are made of; as
//! [`crate::cpu`] has them, without a table of windows: a pixel's window is read where it lies.
//!
//! A cube of 16 x 16 units computes a tile of the result, each unit up to 4 x 4 numbers of it, from strips of both factors in
//! shared memory.

use cubecl::prelude::*;

/// Units of a cube on a side, and how many of the numbers that a product runs over it takes at a time.
pub(crate) const SIDE: usize = 16;
/// Numbers of the result that a unit computes along a side, at most.
pub(crate) const MOST: usize = 4;

/// How a side of the result is cut into tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Tiles {
    pub(crate) count: usize,
    /// Numbers of a unit along this side.
    pub(crate) each: usize,
}

impl Tiles {
    /// As few as there can be, none much larger than needed.
    pub(crate) fn new(length: usize) -> Self {
        let count = length.div_ceil(SIDE * MOST);
        let each = length.div_ceil(SIDE * count.max(1));
        Self { count, each }
    }
}

/// What the rows of a pixel are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Rows {
    /// Side of the window.
    pub(crate) kernel: usize,
    /// Channels of a pixel in the first buffer.
    pub(crate) channels: usize,
    /// Channels joined to them from the second buffer; only where windows are one pixel.
    pub(crate) joined: usize,
}

impl Rows {
    /// Numbers of a row.
    pub(crate) fn taps(self) -> usize {
        self.kernel * self.kernel * self.channels + self.joined
    }
}

/// What becomes of a product's sums, beside a bias.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum End {
    /// They are the result.
    Plain,
    /// A bias is added.
    Bias,
    /// A bias is added, and ReLU applied.
    Relu,
    /// They count where the mask is positive.
    Masked,
    /// They are added to what is there.
    Added,
}

/// A product as its kernel is compiled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Plan {
    pub(crate) rows: Rows,
    pub(crate) outputs: usize,
    /// Whether the second factor is not `[taps, outputs]` but the weight of a layer whose way back this is: `[k * k, inputs,
    /// channels]`, windows mirrored, of whose middle axis the outputs are those from `first` on.
    pub(crate) mirrored: bool,
    pub(crate) inputs: usize,
    pub(crate) first: usize,
    pub(crate) end: End,
}

/// The value of pixel (y, x) at a tap, 0 beyond the borders.
#[cube]
fn tapped(
    values: &[f32],
    joined: &[f32],
    pixel: usize,
    tap: usize,
    height: usize,
    width: usize,
    #[comptime] rows: Rows,
) -> f32 {
    let mut value = 0.0f32;
    if comptime!(rows.kernel == 1 && rows.joined == 0) {
        value = values[pixel * comptime!(rows.channels) + tap];
    } else if comptime!(rows.kernel == 1) {
        let channels = comptime!(rows.channels);
        if tap < channels {
            value = values[pixel * channels + tap];
        } else {
            value = joined[pixel * comptime!(rows.joined) + tap - channels];
        }
    } else {
        let half = comptime!(rows.kernel / 2);
        let line = comptime!(rows.kernel * rows.channels);
        let y = pixel / width + tap / line;
        let x = pixel % width + tap % line / comptime!(rows.channels);
        if y >= half && x >= half && y < height + half && x < width + half {
            let channel = tap % comptime!(rows.channels);
            let at = (y - half) * width + x - half;
            value = values[at * comptime!(rows.channels) + channel];
        }
    }
    value
}

/// The second factor at (tap, output).
#[cube]
fn weighed(weight: &[f32], tap: usize, output: usize, #[comptime] plan: Plan) -> f32 {
    if comptime!(plan.mirrored) {
        let channels = comptime!(plan.rows.channels);
        let last = comptime!(plan.rows.kernel * plan.rows.kernel - 1);
        let row = (last - tap / channels) * comptime!(plan.inputs) + comptime!(plan.first) + output;
        weight[row * channels + tap % channels]
    } else {
        weight[tap * comptime!(plan.outputs) + output]
    }
}

/// Adds the products of two strips, `[SIDE, SIDE * each]` with a number behind every row, to a unit's sums.
#[cube]
fn accumulate(
    left: &Shared<[f32]>,
    right: &Shared<[f32]>,
    sums: &mut Array<f32>,
    #[comptime] down: usize,
    #[comptime] across: usize,
) {
    let unit = UNIT_POS as usize;
    let (row, column) = (unit / SIDE, unit % SIDE);
    for k in 0..SIDE {
        let mut values = Array::<f32>::new(down);
        #[unroll]
        for i in 0..down {
            values[i] = left[k * comptime!(SIDE * down + 1) + i * SIDE + row];
        }
        #[unroll]
        for j in 0..across {
            let value = right[k * comptime!(SIDE * across + 1) + j * SIDE + column];
            #[unroll]
            for i in 0..down {
                sums[comptime!(i * across + j)] += values[i] * value;
            }
        }
    }
}

/// Rows of pixels times a matrix, `[pixels, outputs]`: a cube for each tile.
#[cube(launch)]
pub(crate) fn product_kernel(
    values: &[f32],
    joined: &[f32],
    weight: &[f32],
    bias_or_mask: &[f32],
    output: &mut [f32],
    height: usize,
    width: usize,
    #[comptime] plan: Plan,
    #[comptime] across: Tiles,
) {
    let down = MOST;
    let taps = comptime!(plan.rows.taps());
    let outputs = comptime!(plan.outputs);
    let each = comptime!(across.each);
    let unit = UNIT_POS as usize;
    let pixels = height * width;
    let first = CUBE_POS / comptime!(across.count) * comptime!(SIDE * down);
    let first_output = CUBE_POS % comptime!(across.count) * comptime!(SIDE * each);
    let mut left = Shared::<[f32]>::new_slice(comptime!(SIDE * (SIDE * MOST + 1)));
    let mut right = Shared::<[f32]>::new_slice(comptime!(SIDE * (SIDE * each + 1)));
    let mut sums = Array::<f32>::new(comptime!(MOST * each));
    #[unroll]
    for i in 0..comptime!(down * each) {
        sums[i] = 0.0;
    }
    for strip in 0..comptime!(taps.div_ceil(SIDE)) {
        // Neighbours read neighbours: along the taps here, along the outputs below.
        let tap = strip * SIDE + unit % SIDE;
        #[unroll]
        for i in 0..down {
            let row = i * SIDE + unit / SIDE;
            let mut value = 0.0f32;
            if first + row < pixels && tap < taps {
                value = tapped(values, joined, first + row, tap, height, width, plan.rows);
            }
            left[unit % SIDE * comptime!(SIDE * down + 1) + row] = value;
        }
        #[unroll]
        for i in 0..each {
            let at = comptime!(i * SIDE * SIDE) + unit;
            let column = at % comptime!(SIDE * each);
            let row = at / comptime!(SIDE * each);
            let (tap, output) = (strip * SIDE + row, first_output + column);
            let mut value = 0.0f32;
            if tap < taps && output < outputs {
                value = weighed(weight, tap, output, plan);
            }
            right[row * comptime!(SIDE * each + 1) + column] = value;
        }
        sync_cube();
        accumulate(&left, &right, &mut sums, down, each);
        sync_cube();
    }
    #[unroll]
    for i in 0..down {
        #[unroll]
        for j in 0..each {
            let pixel = first + i * SIDE + unit / SIDE;
            let column = first_output + j * SIDE + unit % SIDE;
            if pixel < pixels && column < outputs {
                let at = pixel * outputs + column;
                let sum = sums[comptime!(i * each + j)];
                if comptime!(plan.end == End::Plain) {
                    output[at] = sum;
                } else if comptime!(plan.end == End::Bias) {
                    output[at] = sum + bias_or_mask[column];
                } else if comptime!(plan.end == End::Relu) {
                    let value = sum + bias_or_mask[column];
                    // Not a number stays one.
                    output[at] = select(value < 0.0, 0.0, value);
                } else if comptime!(plan.end == End::Masked) {
                    output[at] = select(bias_or_mask[at] > 0.0, sum, 0.0);
                } else {
                    output[at] += sum;
                }
            }
        }
    }
}

/// Pixels' rows times their gradients, summed over a part of the pixels, `[parts, taps + 1, outputs]`; the last row is for the
/// bias. A cube for each tile of each part.
#[cube(launch)]
pub(crate) fn outer_kernel(
    values: &[f32],
    joined: &[f32],
    gradient: &[f32],
    parts: &mut [f32],
    height: usize,
    width: usize,
    // A multiple of SIDE.
    per_part: usize,
    #[comptime] rows: Rows,
    #[comptime] outputs: usize,
    #[comptime] down: Tiles,
    #[comptime] across: Tiles,
) {
    let taps = comptime!(rows.taps());
    let tall = comptime!(down.each);
    let wide = comptime!(across.each);
    let unit = UNIT_POS as usize;
    let pixels = height * width;
    let tile = CUBE_POS % comptime!(down.count * across.count);
    let part = CUBE_POS / comptime!(down.count * across.count);
    let first_tap = tile / comptime!(across.count) * comptime!(SIDE * tall);
    let first_output = tile % comptime!(across.count) * comptime!(SIDE * wide);
    let start = part * per_part;
    let end = (start + per_part).min(pixels);
    let mut left = Shared::<[f32]>::new_slice(comptime!(SIDE * (SIDE * tall + 1)));
    let mut right = Shared::<[f32]>::new_slice(comptime!(SIDE * (SIDE * wide + 1)));
    let mut sums = Array::<f32>::new(comptime!(tall * wide));
    #[unroll]
    for i in 0..comptime!(tall * wide) {
        sums[i] = 0.0;
    }
    for strip in 0..per_part / SIDE {
        let first = start + strip * SIDE;
        #[unroll]
        for i in 0..tall {
            let at = comptime!(i * SIDE * SIDE) + unit;
            let column = at % comptime!(SIDE * tall);
            let row = at / comptime!(SIDE * tall);
            let (pixel, tap) = (first + row, first_tap + column);
            let mut value = 0.0f32;
            if pixel < end && tap < taps {
                value = tapped(values, joined, pixel, tap, height, width, rows);
            } else if pixel < end && tap == taps {
                value = 1.0;
            }
            left[row * comptime!(SIDE * tall + 1) + column] = value;
        }
        #[unroll]
        for i in 0..wide {
            let at = comptime!(i * SIDE * SIDE) + unit;
            let column = at % comptime!(SIDE * wide);
            let row = at / comptime!(SIDE * wide);
            let (pixel, output) = (first + row, first_output + column);
            let mut value = 0.0f32;
            if pixel < end && output < outputs {
                value = gradient[pixel * outputs + output];
            }
            right[row * comptime!(SIDE * wide + 1) + column] = value;
        }
        sync_cube();
        accumulate(&left, &right, &mut sums, tall, wide);
        sync_cube();
    }
    #[unroll]
    for i in 0..tall {
        #[unroll]
        for j in 0..wide {
            let tap = first_tap + i * SIDE + unit / SIDE;
            let column = first_output + j * SIDE + unit % SIDE;
            let at = (part * comptime!(taps + 1) + tap) * outputs + column;
            if tap <= taps && column < outputs && at < parts.len() {
                parts[at] = sums[comptime!(i * wide + j)];
            }
        }
    }
}

/// The sum of the parts in their order: a unit for every entry. Rows of `outputs` columns, of which the first `own` are one
/// layer's and the others another's; the last row is the bias of both.
#[cube(launch)]
pub(crate) fn sum_kernel(
    parts: &[f32],
    weight: &mut [f32],
    bias: &mut [f32],
    other_weight: &mut [f32],
    other_bias: &mut [f32],
    number: usize,
    #[comptime] taps: usize,
    #[comptime] outputs: usize,
    #[comptime] own: usize,
) {
    let entry = ABSOLUTE_POS;
    let entries = comptime!((taps + 1) * outputs);
    if entry < entries {
        let mut sum = 0.0f32;
        for part in 0..number {
            sum += parts[part * entries + entry];
        }
        let (row, column) = (entry / outputs, entry % outputs);
        if column < own {
            if row < taps {
                weight[row * own + column] = sum;
            } else {
                bias[column] = sum;
            }
        } else if row < taps {
            other_weight[row * comptime!(outputs - own) + column - own] = sum;
        } else {
            other_bias[column - own] = sum;
        }
    }
}
