//! Projection and culling of all items, and the search for inputs that are not numbers.

use cubecl::prelude::*;
use host::cube::finite::is_finite;
use host::cube::vec3::{load, store};

use super::body::{SHAPE, placed, sigmoid};
use super::geometry::{Lens, project_one};
use super::splat::{COLOR, DEPTH, HALF, OPACITY, RADIUS, SIGMA_MAX, SPLAT, pixel_range};
use crate::cpu::MIN_ALPHA;

/// Sorts behind all depths.
pub(crate) const NOWHERE: u32 = u32::MAX;

/// Projects every item; `keys` are what sorts them by depth.
#[cube(launch)]
pub(crate) fn project_kernel(
    lens: Lens,
    shapes: &[f32],
    moved: &[f32],
    poses: &[f32],
    colors: &[f32],
    splats: &mut [f32],
    keys: &mut [u32],
    moving: usize,
) {
    let item = ABSOLUTE_POS;
    let rows = colors.len() / 3;
    if item < keys.len() {
        let sample = item / rows;
        let row = item % rows;
        let p = placed(shapes, moved, sample, row, moving);
        let g = project_one(lens, poses, sample * 12, p);
        let opacity = sigmoid(shapes[row * SHAPE + 10]);
        let min_alpha = comptime!(MIN_ALPHA as f32);
        let sigma_max = (opacity / min_alpha).ln().max(0.0);
        // Enlarged beyond rounding: the threshold is decided per pixel, not here.
        let half_x = (2.0 * sigma_max * g.xx).sqrt() * 1.001 + 0.01;
        let half_y = (2.0 * sigma_max * g.yy).sqrt() * 1.001 + 0.01;
        let middle = 0.5 * (g.xx + g.yy);
        let spread = 0.5 * (g.xx - g.yy);
        let xy = g.rho * g.yy;
        let larger = middle + (spread * spread + xy * xy).sqrt();
        let columns = pixel_range(g.mean_x - half_x, g.mean_x + half_x, lens.width);
        let lines = pixel_range(g.mean_y - half_y, g.mean_y + half_y, lens.height);
        let color = load(colors, row * 3);
        let seen = g.visible
            && opacity >= min_alpha
            && columns.from < columns.to
            && lines.from < lines.to
            && is_finite(color.x + color.y + color.z);
        let at = item * SPLAT;
        splats[at] = g.mean_x;
        splats[at + 1] = g.mean_y;
        splats[at + 2] = g.l11;
        splats[at + 3] = g.l21;
        splats[at + 4] = g.l22;
        splats[at + OPACITY] = select(seen, opacity, 0.0);
        splats[at + DEPTH] = g.point.z;
        store(splats, at + COLOR, color);
        splats[at + SIGMA_MAX] = sigma_max;
        splats[at + HALF] = half_x;
        splats[at + HALF + 1] = half_y;
        splats[at + RADIUS] = (3.0 * larger.sqrt()).min(f32::MAX);
        // Depths are positive: their bits are in their order.
        keys[item] = select(seen, g.point.z.to_bits(), NOWHERE);
    }
}

/// Largest radius of every Gaussian over the samples, px, `[N]`; 0 for those that no tile lists. `lists` are [items, 2]: first
/// slot and number of slots.
#[cube(launch)]
pub(crate) fn radii_kernel(splats: &[f32], lists: &[u32], radii: &mut [f32]) {
    let row = ABSOLUTE_POS;
    let rows = radii.len();
    if row < rows {
        let samples = lists.len() / (2 * rows);
        let mut largest = 0.0f32;
        for sample in 0..samples {
            let item = sample * rows + row;
            if lists[2 * item + 1] > 0u32 {
                largest = largest.max(splats[item * SPLAT + RADIUS]);
            }
        }
        radii[row] = largest;
    }
}

/// What rows of a table hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Rows {
    /// One tensor.
    Plain,
    /// Mean, quaternion, logarithms of scales and logit.
    Shapes,
    /// Mean and left rotation.
    Moved,
}

/// Writes to `faults` the first row of `values` (rows of `width`) with an entry that is not finite, if that is before what stands
/// there: from `first` on, one entry for each tensor that the rows hold.
#[cube(launch)]
pub(crate) fn faults_kernel(
    values: &[f32],
    faults: &[Atomic<u32>],
    width: usize,
    first: usize,
    #[comptime] of: Rows,
) {
    let at = ABSOLUTE_POS;
    if at < values.len() && !is_finite(values[at]) {
        let mut entry = first;
        let column = at % width;
        if comptime!(of != Rows::Plain) && column >= 3 {
            entry += 1;
        }
        if comptime!(of == Rows::Shapes) {
            if column >= 7 {
                entry += 1;
            }
            if column >= 10 {
                entry += 1;
            }
        }
        faults[entry].fetch_min((at / width) as u32);
    }
}
