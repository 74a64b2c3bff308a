//! What is asked about whole tensors, and what other kernels add up.

use cubecl::prelude::*;

use host::cube::sums::add_units;
use host::cube::vec3::{Vec3, store, vec3};

use crate::ops::LARGE_SCALE;

/// Units of a cube that add up together.
pub(crate) const TEAM: usize = 256;

/// Numbers that each unit adds up first.
pub(super) const EACH: usize = 8;

/// Samples of a cube.
pub(crate) const BLOCK: usize = TEAM * EACH;

/// The sum of one number of each unit of a cube; `shared` has one entry per unit.
#[cube]
pub(super) fn total(shared: &mut [f32], own: f32) -> f32 {
    let unit = UNIT_POS as usize;
    shared[unit] = own;
    add_units(shared, TEAM, 1usize);
    shared[0]
}

/// The sum of three numbers of each unit of a cube; `shared` has three entries per unit, and may be written again at once.
#[cube]
pub(super) fn total3(shared: &mut [f32], own: Vec3) -> Vec3 {
    let unit = UNIT_POS as usize;
    store(shared, 3 * unit, own);
    add_units(shared, TEAM, 3usize);
    let sums = vec3(shared[0], shared[1], shared[2]);
    sync_cube();
    sums
}

/// The sums of rows of `terms` [rows, n]: a cube for each.
#[cube(launch)]
pub(crate) fn sums_kernel(terms: &[f32], sums: &mut [f32]) {
    let mut shared = Shared::<[f32]>::new_slice(TEAM);
    let length = terms.len() / sums.len();
    let mut sum = 0.0f32;
    if CUBE_POS < sums.len() {
        let mut at = UNIT_POS as usize;
        while at < length {
            sum += terms[CUBE_POS * length + at];
            at += TEAM;
        }
    }
    let sum = total(&mut shared, sum);
    if UNIT_POS == 0 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = sum;
    }
}

/// Differences beyond this are scaled before they are squared, so that the square stays inside f32.
const LARGE: f32 = 1e9;

/// Sums of squared differences of [`BLOCK`] samples each of two pictures [H, W, 3], [2, blocks]: of the small differences, and
/// of the large ones times [`LARGE_SCALE`]. With `masked`, of the pixels whose bit is set in `valid`.
#[cube(launch)]
pub(crate) fn squared_error_kernel(
    a: &[f32],
    b: &[f32],
    valid: &[u32],
    terms: &mut [f32],
    #[comptime] masked: bool,
) {
    let mut shared = Shared::<[f32]>::new_slice(TEAM);
    let mut shared_large = Shared::<[f32]>::new_slice(TEAM);
    let mut small = 0.0f32;
    let mut large = 0.0f32;
    let mut at = CUBE_POS * BLOCK + UNIT_POS as usize;
    for _ in 0..EACH {
        if at < a.len() {
            let mut counts = true;
            if masked {
                let pixel = at / 3;
                let bit = (pixel % 32) as u32;
                counts = (valid[pixel / 32] >> bit) & 1 == 1;
            }
            if counts {
                let difference = a[at] - b[at];
                if difference.abs() > LARGE {
                    let scaled = difference * LARGE_SCALE;
                    large += scaled * scaled;
                } else {
                    small += difference * difference;
                }
            }
        }
        at += TEAM;
    }
    let small = total(&mut shared, small);
    let large = total(&mut shared_large, large);
    let blocks = terms.len() / 2;
    if UNIT_POS == 0 && CUBE_POS < blocks {
        terms[CUBE_POS] = small;
        terms[blocks + CUBE_POS] = large;
    }
}
