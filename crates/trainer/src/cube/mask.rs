//! Which pixels the dynamic mask's loss keeps, as [`crate::cpu::mask`] has it.
//!
//! The quantile of each side's errors is found digit by digit of their bits, from histograms: errors are not negative, so that
//! their bits stand in the order of their values. Histograms are counted with integer atomics, which have no order to depend on.

use cubecl::prelude::*;
use host::cube::sums::sum_before;

use super::reduce::TEAM;
use crate::cpu::mask::{INSIDE, OUTSIDE};

/// Values of a digit, a unit for each.
const VALUES: usize = TEAM;

/// Bits of a digit.
const BITS: usize = 8;

/// Digits of a key.
pub(crate) const LEVELS: usize = 4;

/// Inside and outside.
const SIDES: usize = 2;

/// Numbers of all histograms, [levels, sides, values].
pub(crate) const BINS: usize = LEVELS * SIDES * VALUES;

/// Pixels that each unit counts.
const EACH: usize = 8;

/// Pixels of a cube.
pub(crate) const BLOCK: usize = TEAM * EACH;

const INSIDE_BIT: u32 = INSIDE as u32;
const OUTSIDE_BIT: u32 = OUTSIDE as u32;

/// Which sides occur within `band` pixels along the row: bits, [H, W]. Also clears the histograms.
#[cube(launch)]
pub(crate) fn rows_kernel(
    target: &[f32],
    along: &mut [u32],
    bins: &mut [u32],
    width: u32,
    band: u32,
) {
    let unit = ABSOLUTE_POS;
    if unit < bins.len() {
        bins[unit] = 0;
    }
    if unit < target.len() {
        let (width, band) = (width as usize, band as usize);
        let x = unit % width;
        let start = unit - x;
        let end = (x + band + 1).min(width);
        let mut at = x - x.min(band);
        let mut sides = 0u32;
        while at < end {
            sides |= select(target[start + at] > 0.5, INSIDE_BIT, OUTSIDE_BIT);
            at += 1;
        }
        along[unit] = sides;
    }
}

/// Which sides occur within `band` pixels of each pixel [H, W]; none for one that is not valid, if `masked`.
#[cube(launch)]
pub(crate) fn columns_kernel(
    along: &[u32],
    valid: &[u32],
    near: &mut [u32],
    width: u32,
    band: u32,
    #[comptime] masked: bool,
) {
    let unit = ABSOLUTE_POS;
    if unit < along.len() {
        let (width, band) = (width as usize, band as usize);
        let height = along.len() / width;
        let x = unit % width;
        let y = unit / width;
        let end = (y + band + 1).min(height);
        let mut at = y - y.min(band);
        let mut sides = 0u32;
        while at < end {
            sides |= along[at * width + x];
            at += 1;
        }
        if masked {
            let bit = (unit % 32) as u32;
            if (valid[unit / 32] >> bit) & 1 == 0 {
                sides = 0;
            }
        }
        near[unit] = sides;
    }
}

/// The bits of a pixel's error.
#[cube]
fn key(rendered: f32, target: f32) -> u32 {
    (rendered - target).abs().to_bits()
}

/// The highest digits of a side's quantile.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Prefix {
    digits: u32,
    /// Pixels with smaller digits.
    smaller: u32,
    /// And with the same.
    same: u32,
}

/// Finds so many digits from the histograms; all units of a cube together.
#[cube]
fn prefix(
    bins: &[Atomic<u32>],
    sums: &mut [u32],
    found: &mut [u32],
    #[comptime] side: usize,
    #[comptime] levels: usize,
) -> Prefix {
    let unit = UNIT_POS as usize;
    let mut digits = 0u32;
    let mut smaller = 0u32;
    let mut same = 0u32;
    let mut place = 0u32;
    #[unroll]
    for level in 0..levels {
        let own = bins[(level * SIDES + side) * VALUES + unit].load();
        let earlier = sum_before(sums, own, TEAM);
        if comptime!(level == 0) {
            // The 98 % quantile's place, 49 fiftieths of the last one, whatever the number.
            let last = sums[TEAM - 1].max(1) - 1;
            place = last / 50 * 49 + last % 50 * 49 / 50;
        }
        // Of no pixels none is found.
        if unit < 3 {
            found[unit] = 0;
        }
        sync_cube();
        if earlier <= place && place < earlier + own {
            found[0] = unit as u32;
            found[1] = earlier;
            found[2] = own;
        }
        sync_cube();
        digits = (digits << (BITS as u32)) | found[0];
        smaller += found[1];
        same = found[2];
        place -= found[1];
        sync_cube();
    }
    Prefix {
        digits,
        smaller,
        same,
    }
}

/// Counts the values of a digit of the errors of each side, of those that have the quantile's higher digits.
#[cube(launch)]
pub(crate) fn histogram_kernel(
    rendered: &[f32],
    target: &[f32],
    near: &[u32],
    bins: &[Atomic<u32>],
    #[comptime] level: usize,
) {
    let counters = Shared::<[Atomic<u32>]>::new_slice(SIDES * VALUES);
    let mut sums = Shared::<[u32]>::new_slice(TEAM);
    let mut found = Shared::<[u32]>::new_slice(3usize);
    let unit = UNIT_POS as usize;
    #[unroll]
    for side in 0..SIDES {
        counters[side * VALUES + unit].store(0u32);
    }
    sync_cube();
    let inside = prefix(bins, &mut sums, &mut found, 0usize, level);
    let outside = prefix(bins, &mut sums, &mut found, 1usize, level);
    let shift = comptime!((BITS * (LEVELS - 1 - level)) as u32);
    let mut at = CUBE_POS * BLOCK + unit;
    for _ in 0..EACH {
        if at < near.len() {
            let sides = near[at];
            if sides == INSIDE_BIT || sides == OUTSIDE_BIT {
                let key = key(rendered[at], target[at]);
                let higher = select(sides == INSIDE_BIT, inside.digits, outside.digits);
                let mut counted = true;
                if comptime!(level > 0) {
                    counted = key >> comptime!(shift + BITS as u32) == higher;
                }
                if counted {
                    let digit = ((key >> shift) & 255) as usize;
                    let side = select(sides == INSIDE_BIT, 0usize, VALUES);
                    counters[side + digit].fetch_add(1u32);
                }
            }
        }
        at += TEAM;
    }
    sync_cube();
    #[unroll]
    for side in 0..SIDES {
        let count = counters[side * VALUES + unit].load();
        if count > 0 {
            bins[(level * SIDES + side) * VALUES + unit].fetch_add(count);
        }
    }
}

/// One over the number of pixels that are kept at those, zero at the others.
#[cube(launch)]
pub(crate) fn weights_kernel(
    rendered: &[f32],
    target: &[f32],
    near: &[u32],
    bins: &[Atomic<u32>],
    weights: &mut [f32],
) {
    let mut sums = Shared::<[u32]>::new_slice(TEAM);
    let mut found = Shared::<[u32]>::new_slice(3usize);
    let inside = prefix(bins, &mut sums, &mut found, 0usize, LEVELS);
    let outside = prefix(bins, &mut sums, &mut found, 1usize, LEVELS);
    let kept = inside.smaller + inside.same + outside.smaller + outside.same;
    let weight = 1.0 / (kept as f32).max(1.0);
    let mut at = CUBE_POS * BLOCK + UNIT_POS as usize;
    for _ in 0..EACH {
        if at < near.len() {
            let key = key(rendered[at], target[at]);
            let sides = near[at];
            let keeps = (sides == INSIDE_BIT && key <= inside.digits)
                || (sides == OUTSIDE_BIT && key <= outside.digits);
            weights[at] = select(keeps, weight, 0.0);
        }
        at += TEAM;
    }
}
