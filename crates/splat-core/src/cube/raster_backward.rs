//! Backward of the blending, back to front: a cube for every tile, a unit for every item of a batch.
//!
//! Units walk over the tile's pixels one behind the other, each a pixel later than the one with the item behind its own: every
//! pixel meets its items in their order, every item sums over its pixels alone, and no two units meet.

use cubecl::prelude::*;

use super::geometry::Lens;
use super::raster::{Ellipse, PIXELS, ellipse_at, footprint};
use super::splat::{COLOR, DEPTH, SPLAT};
use crate::cpu::{GEOMETRIC, MAX_ALPHA, MIN_ALPHA, TILE};

/// Units of a cube.
pub(crate) const TEAM: usize = 32;

/// Features that the memory of a cube holds for all pixels: WebGPU promises 16 KiB.
pub(crate) const MAX_FEATURES: usize = 8;

/// Numbers of a pixel in a table of gradients with so many channels: transmittance, last item, gradient of alpha, of the
/// channels.
pub(crate) const fn pixel_width(channels: usize) -> usize {
    3 + channels
}

/// The partial gradient of every slot that is drawn, [slots, 6 + C]. `pixels` are [n, H, W, 3 + C].
#[cube(launch)]
pub(crate) fn raster_backward_kernel(
    lens: Lens,
    splats: &[f32],
    features: &[f32],
    ranges: &[u32],
    list: &[u32],
    slots: &[u32],
    pixels: &[f32],
    partial: &mut [f32],
    #[comptime] channels: usize,
) {
    let tile = CUBE_POS;
    let unit = UNIT_POS as usize;
    let (width, height) = (lens.width as usize, lens.height as usize);
    let across = width.div_ceil(TILE);
    let down = height.div_ceil(TILE);
    let sample = tile / (across * down);
    let within = tile % (across * down);
    let left = (within % across) * TILE;
    let top = (within / across) * TILE;
    let mut first = 0usize;
    let mut height_in = 0usize;
    if tile < ranges.len() / 2 {
        first = ranges[2 * tile] as usize;
        height_in = height;
    }
    let width_in = comptime!(pixel_width(channels));
    let num_features = comptime!(channels.saturating_sub(4));
    // Of every pixel: transmittance in front of what was handled, and what lies behind; then what came in.
    let mut transmittance = Shared::<[f32]>::new_slice(PIXELS);
    let mut behind = Shared::<[f32]>::new_slice(PIXELS);
    let mut reach = Shared::<[u32]>::new_slice(PIXELS);
    let mut given = Shared::<[f32]>::new_slice(comptime!(PIXELS * (1 + channels)));
    let mut pixel = unit;
    while pixel < PIXELS {
        let (px, py) = (left + pixel % TILE, top + pixel / TILE);
        behind[pixel] = 0.0;
        reach[pixel] = 0u32;
        transmittance[pixel] = 1.0;
        if px < width && py < height_in {
            let from = ((sample * height + py) * width + px) * width_in;
            transmittance[pixel] = pixels[from];
            reach[pixel] = pixels[from + 1] as u32;
            #[unroll]
            for c in 0..comptime!(1 + channels) {
                given[pixel * comptime!(1 + channels) + c] = pixels[from + 2 + c];
            }
        }
        pixel += TEAM;
    }
    sync_cube();
    let max_alpha = comptime!(MAX_ALPHA as f32);
    let min_alpha = comptime!(MIN_ALPHA as f32);
    let mut values = Array::<f32>::new(channels);
    let mut ellipse = Ellipse {
        x: 0.0,
        y: 0.0,
        l11: 0.0,
        l21: 0.0,
        l22: 0.0,
        opacity: 0.0,
    };
    let mut sums = Array::<f32>::new(comptime!(GEOMETRIC + channels));
    // Behind the last item that a pixel of the tile drew there is nothing to do.
    let mut furthest = 0u32;
    for pixel in 0..PIXELS {
        furthest = furthest.max(reach[pixel]);
    }
    let count = furthest as usize;
    let batches = count.div_ceil(TEAM);
    for batch in 0..batches {
        // Unit 0 has the item that lies furthest behind.
        let from_end = batch * TEAM + unit;
        let mut place = 0usize;
        let active = from_end < count;
        #[unroll]
        for k in 0..comptime!(GEOMETRIC + channels) {
            sums[k] = 0.0;
        }
        if active {
            place = count - 1 - from_end;
            let item = list[first + place] as usize;
            ellipse = ellipse_at(splats, item * SPLAT);
            #[unroll]
            for c in 0..3usize {
                values[c] = splats[item * SPLAT + COLOR + c];
            }
            if comptime!(channels > 3) {
                values[3] = splats[item * SPLAT + DEPTH];
                #[unroll]
                for c in 0..num_features {
                    values[4 + c] = features[item * num_features + c];
                }
            }
        }
        for step in 0..comptime!(PIXELS + TEAM - 1) {
            if active && step >= unit && step - unit < PIXELS {
                let pixel = step - unit;
                if (place as u32) < reach[pixel] {
                    let x = (left + pixel % TILE) as f32 + 0.5;
                    let y = (top + pixel / TILE) as f32 + 0.5;
                    let f = footprint(ellipse, x, y);
                    let alpha = f.raw.min(max_alpha);
                    if alpha >= min_alpha {
                        let at = pixel * comptime!(1 + channels);
                        let mut dot = given[at];
                        #[unroll]
                        for c in 0..channels {
                            dot += given[at + 1 + c] * values[c];
                        }
                        let inverse = 1.0 / (1.0 - alpha);
                        // Not after / (1 - alpha): many equal alphas would round 1 - alpha the same way each time.
                        let after = transmittance[pixel];
                        let share = alpha * inverse * after;
                        let before = after + share;
                        let v_alpha = before * dot - behind[pixel] * inverse;
                        transmittance[pixel] = before;
                        behind[pixel] += share * dot;
                        // ∂alpha/∂sigma = -alpha, and 0 where alpha is clamped.
                        let s = select(f.raw < max_alpha, -(v_alpha * alpha), 0.0);
                        let sp = s * f.p;
                        sums[0] += sp;
                        sums[1] += sp * f.p;
                        sums[2] += sp * f.dy;
                        sums[3] += s * f.dy;
                        sums[4] += s * f.dy * f.dy;
                        sums[5] += s;
                        #[unroll]
                        for c in 0..channels {
                            sums[comptime!(GEOMETRIC + c)] += share * given[at + 1 + c];
                        }
                    }
                }
            }
            sync_cube();
        }
        if active {
            let to = slots[first + place] as usize * comptime!(GEOMETRIC + channels);
            #[unroll]
            for k in 0..comptime!(GEOMETRIC + channels) {
                partial[to + k] = sums[k];
            }
        }
        sync_cube();
    }
}

/// Adds up the partial gradients of every item: [items, 6 + C + 1], the last 1 for one that is listed. Behind all of them comes
/// what `flags` begin with.
#[cube(launch)]
pub(crate) fn slot_sums_kernel(
    partial: &[f32],
    lists: &[u32],
    flags: &[f32],
    sums: &mut [f32],
    #[comptime] width: usize,
) {
    let item = ABSOLUTE_POS;
    let items = lists.len() / 2;
    if item < items {
        let first = lists[2 * item] as usize;
        let count = lists[2 * item + 1] as usize;
        let mut own = Array::<f32>::new(width);
        #[unroll]
        for k in 0..width {
            own[k] = 0.0;
        }
        for slot in first..first + count {
            #[unroll]
            for k in 0..width {
                own[k] += partial[slot * width + k];
            }
        }
        let to = item * comptime!(width + 1);
        #[unroll]
        for k in 0..width {
            sums[to + k] = own[k];
        }
        sums[to + width] = select(count > 0, 1.0, 0.0);
    }
    if item == items {
        sums[item * comptime!(width + 1)] = flags[0];
    }
}
