//! What a rendered depth is compared with, as [`crate::cpu::depth`] has it: pixels that count are found, an even sample of them
//! gathered in their order, scale and shift fitted to it by one cube, and the targets written.

use cubecl::prelude::*;

use super::reduce::{TEAM, total3};
use crate::cpu::depth::{FEWEST, LARGEST_SCALE, OPAQUE, ROUNDS, SAMPLE, TOLERANCE};
use host::cube::finite::is_finite;
use host::cube::sums::sum_before;
use host::cube::vec3::vec3;

/// Pixels that each unit looks at.
const EACH: usize = 4;

/// Pixels of a cube.
pub(crate) const BLOCK: usize = TEAM * EACH;

/// Numbers of a fit: scale, shift and one over the number of pixels that count.
pub(crate) const FIT: usize = 3;

const LEAST_ALPHA: f32 = OPAQUE as f32;
const RESIDUAL: f32 = TOLERANCE as f32;
const HIGHEST: f32 = LARGEST_SCALE as f32;
const LOWEST: f32 = (1.0 / LARGEST_SCALE) as f32;

#[cube]
fn counts(alpha: f32, given: f32) -> bool {
    alpha > LEAST_ALPHA && given > 0.0 && is_finite(given)
}

#[cube]
fn disparity(depth: f32, nearest: f32, scene_size: f32) -> f32 {
    scene_size / select(depth > nearest, depth, nearest)
}

/// How many of a unit's pixels count.
#[cube]
fn count(alpha: &[f32], given: &[f32], first: usize) -> u32 {
    let mut own = 0u32;
    for k in 0..EACH {
        let at = first + k;
        if at < alpha.len() && counts(alpha[at], given[at]) {
            own += 1;
        }
    }
    own
}

/// How many pixels of each [`BLOCK`] count.
#[cube(launch)]
pub(crate) fn counts_kernel(alpha: &[f32], given: &[f32], sums: &mut [u32]) {
    let mut shared = Shared::<[u32]>::new_slice(TEAM);
    let unit = UNIT_POS as usize;
    let own = count(alpha, given, CUBE_POS * BLOCK + unit * EACH);
    let sum = sum_before(&mut shared, own, TEAM) + own;
    if unit == TEAM - 1 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = sum;
    }
}

/// Every so manyeth pixel that counts goes into the sample.
#[cube]
fn stride(total: usize) -> usize {
    total.div_ceil(SAMPLE).max(1)
}

/// Given and rendered disparities of the sample, [`SAMPLE`, 2], and how many pixels count.
#[cube(launch)]
pub(crate) fn sample_kernel(
    depth: &[f32],
    alpha: &[f32],
    given: &[f32],
    sums: &[u32],
    pairs: &mut [f32],
    total: &mut [u32],
    nearest: f32,
    scene_size: f32,
) {
    let unit = UNIT_POS as usize;
    // Of all blocks, and of those before this one.
    let mut all = 0u32;
    let mut earlier = 0u32;
    let mut at = unit;
    while at < sums.len() {
        all += sums[at];
        if at < CUBE_POS {
            earlier += sums[at];
        }
        at += TEAM;
    }
    let mut shared_all = Shared::<[u32]>::new_slice(TEAM);
    let mut shared_earlier = Shared::<[u32]>::new_slice(TEAM);
    let mut shared_own = Shared::<[u32]>::new_slice(TEAM);
    sum_before(&mut shared_all, all, TEAM);
    sum_before(&mut shared_earlier, earlier, TEAM);
    let first = CUBE_POS * BLOCK + unit * EACH;
    let own = sum_before(&mut shared_own, count(alpha, given, first), TEAM);
    let all = shared_all[TEAM - 1];
    let stride = stride(all as usize);
    let mut rank = (shared_earlier[TEAM - 1] + own) as usize;
    for k in 0..EACH {
        let at = first + k;
        if at < alpha.len() && counts(alpha[at], given[at]) {
            let place = rank / stride;
            if place * stride == rank {
                pairs[2 * place] = disparity(given[at], nearest, scene_size);
                pairs[2 * place + 1] = disparity(depth[at] / alpha[at], nearest, scene_size);
            }
            rank += 1;
        }
    }
    if ABSOLUTE_POS == 0 {
        total[0] = all;
    }
}

/// Weight of a pair by the fit before.
#[cube]
fn weight(x: f32, y: f32, scale: f32, shift: f32) -> f32 {
    let residual = (y - scale * x - shift) / RESIDUAL;
    1.0 / (1.0 + residual * residual)
}

/// Scale and shift, by one cube: [`crate::cpu::depth::fit_disparity`] on a sample.
#[cube(launch)]
pub(crate) fn fit_kernel(pairs: &[f32], total: &[u32], fit: &mut [f32]) {
    let mut shared = Shared::<[f32]>::new_slice(3 * TEAM);
    let unit = UNIT_POS as usize;
    let all = total[0] as usize;
    let stride = stride(all);
    let count = all.div_ceil(stride);
    let mut scale = 1.0f32;
    let mut shift = 0.0f32;
    let mut good = all >= FEWEST;
    for _ in 0..ROUNDS {
        let mut sums = vec3(0.0, 0.0, 0.0);
        let mut at = unit;
        while at < count {
            let x = pairs[2 * at];
            let y = pairs[2 * at + 1];
            let w = weight(x, y, scale, shift);
            sums = vec3(sums.x + w, sums.y + w * x, sums.z + w * y);
            at += TEAM;
        }
        let sums = total3(&mut shared, sums);
        let mean_x = sums.y / sums.x;
        let mean_y = sums.z / sums.x;

        let mut spread = vec3(0.0, 0.0, 0.0);
        let mut at = unit;
        while at < count {
            let x = pairs[2 * at];
            let y = pairs[2 * at + 1];
            let w = weight(x, y, scale, shift);
            let x = x - mean_x;
            let y = y - mean_y;
            spread = vec3(
                spread.x + w * x * x,
                spread.y + w * x * y,
                spread.z + w * y * y,
            );
            at += TEAM;
        }
        let spread = total3(&mut shared, spread);
        // A relative spread under a thousandth of the disparity is rounding, not relief.
        let relief = spread.x > 1e-6 * sums.x * mean_x * mean_x
            && spread.z > 1e-6 * sums.x * mean_y * mean_y;
        let together = spread.y >= 0.5 * spread.x.sqrt() * spread.z.sqrt();
        let factor = (spread.z / spread.x).sqrt();
        let large = factor >= LOWEST;
        let small = factor <= HIGHEST;
        good = good && relief && together && large && small;
        if good {
            scale = factor;
            shift = mean_y - factor * mean_x;
        }
    }
    if ABSOLUTE_POS == 0 {
        fit[0] = select(good, scale, 1.0);
        fit[1] = select(good, shift, 0.0);
        fit[2] = 1.0 / (all as f32).max(1.0);
    }
}

/// 1 / alpha, the disparity wanted and the weight of every pixel, zero where one does not count.
#[cube(launch)]
pub(crate) fn targets_kernel(
    alpha: &[f32],
    given: &[f32],
    fit: &[f32],
    per_alpha: &mut [f32],
    wanted: &mut [f32],
    weights: &mut [f32],
    nearest: f32,
    scene_size: f32,
) {
    let pixel = ABSOLUTE_POS;
    if pixel < alpha.len() {
        let mut inverse = 0.0f32;
        let mut target = 0.0f32;
        let mut weight = 0.0f32;
        if counts(alpha[pixel], given[pixel]) {
            inverse = 1.0 / alpha[pixel];
            target = fit[0] * disparity(given[pixel], nearest, scene_size) + fit[1];
            weight = fit[2];
        }
        per_alpha[pixel] = inverse;
        wanted[pixel] = target;
        weights[pixel] = weight;
    }
}
