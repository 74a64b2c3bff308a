//! Which items touch which tile, and where each pair's partial gradient lies.

use cubecl::prelude::*;

use super::geometry::Lens;
use super::splat::{HALF, OPACITY, SIGMA_MAX, SPLAT, Span, pixel_range};
use crate::cpu::TILE;

/// The tiles of a band of rows that have a pixel centre in the ellipse's bounding interval there.
#[cube]
fn tiles_of_band(lens: Lens, splats: &[f32], item: usize, band: u32, rows: Span) -> Span {
    let tile = TILE as u32;
    let at = item * SPLAT;
    let (mx, my) = (splats[at], splats[at + 1]);
    let (l11, l21, l22) = (splats[at + 2], splats[at + 3], splats[at + 4]);
    let sigma_max = splats[at + SIGMA_MAX];
    let (half_x, half_y) = (splats[at + HALF], splats[at + HALF + 1]);
    // The slanted ellipse x(dy) = rho dy ± sqrt(sigma - q²) / l11: its rightmost point lies at dy = tip, its leftmost at -tip,
    // so over a band of rows the extreme is at the nearest dy.
    let rho = -l21 / l11;
    let tip = rho * half_y * half_y / half_x;
    let first = (band * tile).max(rows.from);
    let last = ((band + 1) * tile).min(rows.to) - 1;
    let low = first as f32 + 0.5 - my;
    let high = last as f32 + 0.5 - my;
    let right = tip.max(low).min(high);
    let left = (-tip).max(low).min(high);
    let qr = l22 * right;
    let ql = l22 * left;
    let right_root = (sigma_max - qr * qr).max(0.0).sqrt() / l11 * 1.001 + 0.01;
    let left_root = (sigma_max - ql * ql).max(0.0).sqrt() / l11 * 1.001 + 0.01;
    let across = lens.width.div_ceil(tile);
    let columns = pixel_range(
        mx + rho * left - left_root,
        mx + rho * right + right_root,
        across * tile,
    );
    Span {
        from: columns.from / tile,
        to: select(
            columns.from < columns.to,
            columns.to.div_ceil(tile),
            columns.from / tile,
        ),
    }
}

/// The rows of pixels that an item's box meets; none for one that cannot be seen.
#[cube]
fn rows_of(lens: Lens, splats: &[f32], item: usize) -> Span {
    let at = item * SPLAT;
    let half = splats[at + HALF + 1];
    let rows = pixel_range(splats[at + 1] - half, splats[at + 1] + half, lens.height);
    let seen = splats[at + OPACITY] > 0.0;
    Span {
        from: rows.from,
        to: select(seen, rows.to, rows.from),
    }
}

/// Number of tiles of every item, in depth order.
#[cube(launch)]
pub(crate) fn count_kernel(lens: Lens, splats: &[f32], order: &[u32], counts: &mut [u32]) {
    let place = ABSOLUTE_POS;
    if place < order.len() {
        let item = order[place] as usize;
        let rows = rows_of(lens, splats, item);
        let tile = TILE as u32;
        let mut count = 0u32;
        if rows.from < rows.to {
            for band in rows.from / tile..rows.to.div_ceil(tile) {
                let tiles = tiles_of_band(lens, splats, item, band, rows);
                count += tiles.to - tiles.from;
            }
        }
        counts[place] = count;
    }
}

/// Number of all slots, to entry `entry` of `totals`, which holds the largest u32; and 0 to the one behind it, if the number is
/// larger than a u32 holds.
#[cube(launch)]
pub(crate) fn total_kernel(counts: &[u32], starts: &[u32], totals: &[Atomic<u32>], entry: usize) {
    let place = ABSOLUTE_POS;
    if place < counts.len() {
        let end = starts[place] + counts[place];
        if end < starts[place] {
            totals[entry + 1].fetch_min(0u32);
        }
        if place == counts.len() - 1 {
            totals[entry].fetch_min(end);
        }
    }
}

/// Tile and item of every slot, and the slots of every item: [items, 2], the first and their number.
#[cube(launch)]
pub(crate) fn emit_kernel(
    lens: Lens,
    splats: &[f32],
    order: &[u32],
    counts: &[u32],
    starts: &[u32],
    tiles_of: &mut [u32],
    items: &mut [u32],
    lists: &mut [u32],
    rows_per_sample: usize,
) {
    let place = ABSOLUTE_POS;
    if place < order.len() {
        let item = order[place] as usize;
        let tile = TILE as u32;
        let across = lens.width.div_ceil(tile);
        let down = lens.height.div_ceil(tile);
        let before = (item / rows_per_sample) as u32 * across * down;
        let rows = rows_of(lens, splats, item);
        let start = starts[place];
        let end = start + counts[place];
        let mut slot = start;
        if rows.from < rows.to {
            for band in rows.from / tile..rows.to.div_ceil(tile) {
                let tiles = tiles_of_band(lens, splats, item, band, rows);
                for column in tiles.from..tiles.to {
                    // A compiler may round this kernel's sums otherwise than those of the one that counted.
                    if slot < end {
                        tiles_of[slot as usize] = before + band * across + column;
                        items[slot as usize] = item as u32;
                        slot += 1u32;
                    }
                }
            }
        }
        let none = (lists.len() / 2 / rows_per_sample) as u32 * across * down;
        while slot < end {
            tiles_of[slot as usize] = none;
            items[slot as usize] = item as u32;
            slot += 1u32;
        }
        lists[2 * item] = start;
        lists[2 * item + 1] = end - start;
    }
}

/// Where the slots of every tile begin and end in the sorted list, [tiles, 2] with zeros before, and the items of that list.
#[cube(launch)]
pub(crate) fn ranges_kernel(
    tiles_of: &[u32],
    slots: &[u32],
    items: &[u32],
    ranges: &mut [u32],
    list: &mut [u32],
) {
    let at = ABSOLUTE_POS;
    if at < slots.len() {
        let tile = tiles_of[at];
        let mut begins = at == 0;
        let mut ends = at == slots.len() - 1;
        if !begins {
            begins = tiles_of[at - 1] != tile;
        }
        if !ends {
            ends = tiles_of[at + 1] != tile;
        }
        if (tile as usize) < ranges.len() / 2 {
            if begins {
                ranges[2 * tile as usize] = at as u32;
            }
            if ends {
                ranges[2 * tile as usize + 1] = (at + 1) as u32;
            }
        }
        list[at] = items[slots[at] as usize];
    }
}
