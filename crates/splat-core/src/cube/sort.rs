//! A stable sort of pairs by the bits of their keys, from the lowest digit to the highest.
//!
//! Each unit owns neighbouring pairs and has a counter for every value of a digit: where a pair goes follows from sums in a
//! fixed order, so that no atomic operation is needed and pairs with equal keys keep their order.

use cubecl::prelude::*;

/// Bits of a digit, and its values.
pub(crate) const DIGIT: u32 = 4;
const VALUES: usize = 1 << DIGIT;
/// Units of a cube.
pub(crate) const UNITS: usize = 128;
/// Pairs of a unit.
const EACH: usize = 8;
/// Pairs of a cube.
pub(crate) const BLOCK: usize = UNITS * EACH;
/// Digits' counters of a table for so many blocks.
pub(crate) const fn table(blocks: usize) -> usize {
    blocks * VALUES
}

/// The digit of a key from bit `shift` on.
#[cube]
fn digit(key: u32, shift: u32) -> usize {
    ((key >> shift) & (VALUES as u32 - 1)) as usize
}

/// Counts each unit's pairs by digit, [values, units].
#[cube]
fn count(keys: &[u32], counters: &mut [u32], first: usize, shift: u32) {
    let unit = UNIT_POS as usize;
    #[unroll]
    for value in 0..VALUES {
        counters[value * UNITS + unit] = 0u32;
    }
    for k in 0..EACH {
        if first + k < keys.len() {
            counters[digit(keys[first + k], shift) * UNITS + unit] += 1u32;
        }
    }
    sync_cube();
}

/// How many pairs of each block have each digit, [values, blocks].
#[cube(launch)]
pub(crate) fn digits_kernel(keys: &[u32], table: &mut [u32], shift: u32) {
    let mut counters = Shared::<[u32]>::new_slice(UNITS * VALUES);
    let unit = UNIT_POS as usize;
    let blocks = table.len() / VALUES;
    count(keys, &mut counters, CUBE_POS * BLOCK + unit * EACH, shift);
    if unit < VALUES && CUBE_POS < blocks {
        let mut sum = 0u32;
        for other in 0..UNITS {
            sum += counters[unit * UNITS + other];
        }
        table[unit * blocks + CUBE_POS] = sum;
    }
}

/// Moves each pair to its place by one digit, or with `numbered` each key and its number; `starts` are the sums of [`digits_kernel`]'s table before each entry.
#[cube(launch)]
pub(crate) fn place_kernel(
    keys: &[u32],
    values: &[u32],
    starts: &[u32],
    to_keys: &mut [u32],
    to_values: &mut [u32],
    shift: u32,
    #[comptime] numbered: bool,
) {
    let mut counters = Shared::<[u32]>::new_slice(UNITS * VALUES);
    let unit = UNIT_POS as usize;
    let blocks = starts.len() / VALUES;
    let first = CUBE_POS * BLOCK + unit * EACH;
    count(keys, &mut counters, first, shift);
    if unit < VALUES && CUBE_POS < blocks {
        let mut next = starts[unit * blocks + CUBE_POS];
        for other in 0..UNITS {
            let own = counters[unit * UNITS + other];
            counters[unit * UNITS + other] = next;
            next += own;
        }
    }
    sync_cube();
    for k in 0..EACH {
        if first + k < keys.len() {
            let key = keys[first + k];
            let counter = digit(key, shift) * UNITS + unit;
            let place = counters[counter];
            counters[counter] = place + 1u32;
            to_keys[place as usize] = key;
            if comptime!(numbered) {
                to_values[place as usize] = (first + k) as u32;
            } else {
                to_values[place as usize] = values[first + k];
            }
        }
    }
}
