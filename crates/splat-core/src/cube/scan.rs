//! Prefix sums of counts.

use cubecl::prelude::*;
use host::cube::sums::sum_before;

/// Units of a cube.
pub(crate) const UNITS: usize = 128;
/// Numbers of a unit.
const EACH: usize = 8;
/// Numbers of a cube.
pub(crate) const BLOCK: usize = UNITS * EACH;

/// The sum of each [`BLOCK`] of `counts`.
#[cube(launch)]
pub(crate) fn block_sums_kernel(counts: &[u32], sums: &mut [u32]) {
    let mut shared = Shared::<[u32]>::new_slice(UNITS);
    let first = CUBE_POS * BLOCK + UNIT_POS as usize * EACH;
    let mut own = 0u32;
    for k in 0..EACH {
        if first + k < counts.len() {
            own += counts[first + k];
        }
    }
    let sum = sum_before(&mut shared, own, UNITS) + own;
    if UNIT_POS as usize == UNITS - 1 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = sum;
    }
}

/// The sum of all counts before each; `starts` are those of the blocks.
#[cube(launch)]
pub(crate) fn block_scan_kernel(counts: &[u32], starts: &[u32], sums: &mut [u32]) {
    let mut shared = Shared::<[u32]>::new_slice(UNITS);
    let first = CUBE_POS * BLOCK + UNIT_POS as usize * EACH;
    let mut own = 0u32;
    for k in 0..EACH {
        if first + k < counts.len() {
            own += counts[first + k];
        }
    }
    let mut next = sum_before(&mut shared, own, UNITS);
    if CUBE_POS < starts.len() {
        next += starts[CUBE_POS];
    }
    for k in 0..EACH {
        if first + k < counts.len() {
            sums[first + k] = next;
            next += counts[first + k];
        }
    }
}
