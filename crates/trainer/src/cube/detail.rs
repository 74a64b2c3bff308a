//! What stands out of a picture's surroundings, and its gradient, as [`crate::cpu::detail`] has them.

use cubecl::prelude::*;

use super::reduce::{BLOCK, EACH, TEAM, total};
use crate::cpu::detail::STEPS;
use crate::cpu::ssim::CHANNELS;

/// What the sample at `at` of a - b has beyond the mean of those `step` pixels away; 0 at the edges.
#[cube]
fn standing_out(a: &[f32], b: &[f32], at: usize, width: usize, #[comptime] step: usize) -> f32 {
    let pixel = at / CHANNELS;
    let (x, y) = (pixel % width, pixel / width);
    let height = a.len() / CHANNELS / width;
    let mut out = 0.0f32;
    if x >= step && x + step < width && y >= step && y + step < height {
        let (across, down) = (step * CHANNELS, step * CHANNELS * width);
        let above = a[at - down] - b[at - down];
        let below = a[at + down] - b[at + down];
        let left = a[at - across] - b[at - across];
        let right = a[at + across] - b[at + across];
        out = a[at] - b[at] - (above + below + left + right) * 0.25;
    }
    out
}

#[cube]
fn sign(v: f32) -> f32 {
    let mut sign = 0.0f32;
    if v > 0.0 {
        sign = 1.0f32;
    }
    if v < 0.0 {
        sign = -1.0f32;
    }
    sign
}

/// Sums of [`BLOCK`] samples' magnitudes, each scale's times its weight; with `wanted`, also what each sample's sign adds to its
/// own gradient, [2, H, W, 3].
#[cube(launch)]
pub(crate) fn detail_kernel(
    a: &[f32],
    b: &[f32],
    signs: &mut [f32],
    terms: &mut [f32],
    width: u32,
    first: f32,
    second: f32,
    #[comptime] wanted: bool,
) {
    let mut shared = Shared::<[f32]>::new_slice(TEAM);
    let mut sum = 0.0f32;
    let mut at = CUBE_POS * BLOCK + UNIT_POS as usize;
    for _ in 0..EACH {
        if at < a.len() {
            let near = standing_out(a, b, at, width as usize, comptime!(STEPS[0]));
            let far = standing_out(a, b, at, width as usize, comptime!(STEPS[1]));
            sum += near.abs() * first + far.abs() * second;
            if wanted {
                signs[at] = sign(near) * first;
                signs[a.len() + at] = sign(far) * second;
            }
        }
        at += TEAM;
    }
    let sum = total(&mut shared, sum);
    if UNIT_POS == 0 && CUBE_POS < terms.len() {
        terms[CUBE_POS] = sum;
    }
}

/// What the signs from `from` on of those `step` pixels around a sample add to its gradient.
#[cube]
fn gathered(
    signs: &[f32],
    from: usize,
    at: usize,
    count: usize,
    width: usize,
    #[comptime] step: usize,
) -> f32 {
    let x = at / CHANNELS % width;
    let (across, down) = (step * CHANNELS, step * CHANNELS * width);
    let mut around = 0.0f32;
    if x >= step {
        around += signs[from + at - across];
    }
    if x + step < width {
        around += signs[from + at + across];
    }
    if at >= down {
        around += signs[from + at - down];
    }
    if at + down < count {
        around += signs[from + at + down];
    }
    signs[from + at] - around * 0.25
}

/// The gradient of every sample, from [`detail_kernel`]'s signs.
#[cube(launch)]
pub(crate) fn gather_kernel(signs: &[f32], gradient: &mut [f32], width: u32) {
    let (at, count) = (ABSOLUTE_POS, gradient.len());
    if at < count {
        let near = gathered(signs, 0, at, count, width as usize, comptime!(STEPS[0]));
        let far = gathered(signs, count, at, count, width as usize, comptime!(STEPS[1]));
        gradient[at] = near + far;
    }
}
