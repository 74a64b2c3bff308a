//! Sums over the units of a cube, in a fixed order.

use cubecl::prelude::*;

/// Adds up `width` numbers of each of `team` units: those of unit u begin at `u * width`, and the sums are left at the front.
#[cube]
pub fn add_units<N: Numeric>(shared: &mut [N], #[comptime] team: usize, #[comptime] width: usize) {
    let unit = UNIT_POS as usize;
    sync_cube();
    #[unroll]
    for level in 1..=team.ilog2() {
        let half = comptime!(team >> level);
        if unit < half {
            #[unroll]
            for k in 0..width {
                let other = shared[(unit + half) * width + k];
                shared[unit * width + k] += other;
            }
        }
        sync_cube();
    }
}

/// The sum of the numbers of the units before each of `team`; `shared` has one entry per unit, and the last is then the sum of
/// all.
#[cube]
pub fn sum_before(shared: &mut [u32], own: u32, #[comptime] team: usize) -> u32 {
    let unit = UNIT_POS as usize;
    shared[unit] = own;
    sync_cube();
    #[unroll]
    for level in 0..team.ilog2() {
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
