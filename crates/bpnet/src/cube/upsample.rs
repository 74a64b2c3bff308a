//! Bilinear enlargement, and its transpose as a gather.
//!
//! A pixel i of n takes from the place `(i + 1/2) m / n - 1/2` among m: as fractions of whole numbers over 2n, shares are exact
//! to the last bit whatever the size.

use cubecl::prelude::*;

/// Two neighbours on an axis and the share of the second.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Taps {
    first: usize,
    second: usize,
    share: f32,
}

/// Where pixel `i` of the larger axis takes from.
#[cube]
fn taps(i: usize, from: usize, to: usize) -> Taps {
    let place = (2 * i + 1) * from;
    let whole = 2 * to;
    let shifted = select(place > to, place - place.min(to), 0);
    let first = (shifted / whole).min(from - 1);
    let second = (first + 1).min(from - 1);
    let share = (shifted - first * whole) as f32 / whole as f32;
    Taps {
        first,
        second,
        share: select(second == first, 0.0, share),
    }
}

/// The part of pixel `i` of the larger axis that comes from `own` of the smaller.
#[cube]
fn part(i: usize, own: usize, from: usize, to: usize) -> f32 {
    let t = taps(i, from, to);
    let mut weight = 0.0f32;
    if t.first == own {
        weight += 1.0 - t.share;
    }
    if t.second == own {
        weight += t.share;
    }
    weight
}

/// From `[h, w, C]` to `[H, W, C]`: a unit for every number.
#[cube(launch)]
pub(crate) fn upsample_kernel(
    input: &[f32],
    output: &mut [f32],
    from_height: usize,
    from_width: usize,
    to_height: usize,
    to_width: usize,
    channels: usize,
) {
    let at = ABSOLUTE_POS;
    if at < output.len() {
        let (pixel, channel) = (at / channels, at % channels);
        let rows = taps(pixel / to_width, from_height, to_height);
        let columns = taps(pixel % to_width, from_width, to_width);
        let above = rows.first * from_width;
        let below = rows.second * from_width;
        let left = mixed(
            input[(above + columns.first) * channels + channel],
            input[(below + columns.first) * channels + channel],
            rows.share,
        );
        let right = mixed(
            input[(above + columns.second) * channels + channel],
            input[(below + columns.second) * channels + channel],
            rows.share,
        );
        output[at] = mixed(left, right, columns.share);
    }
}

#[cube]
fn mixed(a: f32, b: f32, share: f32) -> f32 {
    a + share * (b - a)
}

/// The first pixel of the larger axis that can take from `own` of the smaller one.
#[cube]
fn start(own: usize, from: usize, to: usize) -> usize {
    // Its place is above own - 1: i > (own - 1/2) to / from - 1/2.
    let twice = (2 * own).max(1) - 1;
    let first = twice * to / (2 * from);
    select(own == 0, 0, first.max(1) - 1)
}

/// Behind the last one.
#[cube]
fn end(own: usize, from: usize, to: usize) -> usize {
    // Its place is below own + 1: i < (own + 3/2) to / from - 1/2.
    let last = ((2 * own + 3) * to / (2 * from) + 1).min(to);
    select(own + 1 == from, to, last)
}

/// Gradient of the input, gathered from the pixels that took from it.
#[cube(launch)]
pub(crate) fn upsample_backward_kernel(
    gradient: &[f32],
    v_input: &mut [f32],
    from_height: usize,
    from_width: usize,
    to_height: usize,
    to_width: usize,
    channels: usize,
) {
    let at = ABSOLUTE_POS;
    if at < v_input.len() {
        let (pixel, channel) = (at / channels, at % channels);
        let (own_y, own_x) = (pixel / from_width, pixel % from_width);
        let mut sum = 0.0f32;
        let left = start(own_x, from_width, to_width);
        let right = end(own_x, from_width, to_width);
        for y in start(own_y, from_height, to_height)..end(own_y, from_height, to_height) {
            let down = part(y, own_y, from_height, to_height);
            for x in left..right {
                let share = down * part(x, own_x, from_width, to_width);
                sum += share * gradient[(y * to_width + x) * channels + channel];
            }
        }
        v_input[at] = sum;
    }
}
