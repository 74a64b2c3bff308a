//! How many values are infinite or not numbers.

use cubecl::prelude::*;

use super::sums::add_units;

/// Units of a cube.
pub(crate) const TEAM: usize = 256;

/// Values that a unit looks at before there is a cube more.
const EACH: usize = 8;

/// Cubes at most; they go through what is left in turns.
const MOST: usize = 64;

/// The bits of an exponent. All are set in what is infinite or not a number: a comparison of floats may not say so, since
/// compilers for GPUs are free to take all to be numbers.
const EXPONENT: u32 = 0x7f80_0000;

/// Neither infinite nor not a number.
#[cube]
pub fn is_finite(value: f32) -> bool {
    value.to_bits() & EXPONENT != EXPONENT
}

/// Cubes that count so many values.
pub(crate) fn parts(values: usize) -> usize {
    values.div_ceil(TEAM * EACH).clamp(1, MOST)
}

/// What each cube counts.
#[cube(launch)]
pub(crate) fn count_kernel(values: &[f32], counts: &mut [f32]) {
    let mut shared = Shared::<[u32]>::new_slice(TEAM);
    let unit = UNIT_POS as usize;
    let mut own = 0u32;
    let mut at = CUBE_POS * TEAM + unit;
    while at < values.len() {
        if !is_finite(values[at]) {
            own += 1;
        }
        at += counts.len() * TEAM;
    }
    shared[unit] = own;
    add_units(&mut shared, TEAM, 1usize);
    if unit == 0 && CUBE_POS < counts.len() {
        counts[CUBE_POS] = shared[0] as f32;
    }
}
