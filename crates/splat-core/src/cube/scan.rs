//! Prefix sums of counts.

use cubecl::prelude::*;

/// Units of a cube, and numbers that each adds up by itself.
const TEAM: usize = 128;
const EACH: usize = 8;
/// Units of a cube.
pub(crate) const UNITS: usize = TEAM;
/// Numbers of a cube.
pub(crate) const BLOCK: usize = TEAM * EACH;

/// Turns a number of each unit of a cube into the sum of those before it; `shared` has one entry per unit.
#[cube]
pub(super) fn before(shared: &mut [u32], own: u32) -> u32 {
    let unit = UNIT_POS as usize;
    shared[unit] = own;
    sync_cube();
    #[unroll]
    for level in 0..TEAM.ilog2() {
        let reach = comptime!(1usize << level);
        let mut other = 0u32;
        if unit >= reach {
            other = shared[unit - reach];
        }
        sync_cube();
        shared[unit] += other;
        sync_cube();
    }
    shared[unit] - own
}

/// The sum of each [`BLOCK`] of `counts`.
#[cube(launch)]
pub(crate) fn block_sums_kernel(counts: &[u32], sums: &mut [u32]) {
    let mut shared = Shared::<[u32]>::new_slice(TEAM);
    let first = CUBE_POS * BLOCK + UNIT_POS as usize * EACH;
    let mut own = 0u32;
    for k in 0..EACH {
        if first + k < counts.len() {
            own += counts[first + k];
        }
    }
    let sum = before(&mut shared, own) + own;
    if UNIT_POS as usize == TEAM - 1 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = sum;
    }
}

/// The sum of all counts before each; `starts` are those of the blocks.
#[cube(launch)]
pub(crate) fn block_scan_kernel(counts: &[u32], starts: &[u32], sums: &mut [u32]) {
    let mut shared = Shared::<[u32]>::new_slice(TEAM);
    let first = CUBE_POS * BLOCK + UNIT_POS as usize * EACH;
    let mut own = 0u32;
    for k in 0..EACH {
        if first + k < counts.len() {
            own += counts[first + k];
        }
    }
    let mut next = before(&mut shared, own);
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
