//! Forward blending: a cube for every tile, a unit for every pixel.

use cubecl::prelude::*;

use super::geometry::Lens;
use super::splat::{COLOR, DEPTH, OPACITY, SPLAT};
use crate::cpu::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};

/// Units of a cube: the pixels of a tile, row by row.
pub(crate) const PIXELS: usize = TILE * TILE;
/// Items that a cube loads at a time.
const BATCH: usize = 64;
/// Numbers of an item that shared memory holds: those of its footprint, depth and colour.
const HELD: usize = 10;
/// Numbers of a pixel that the way back needs: transmittance behind the last item, and one more than that item's place in the
/// tile's list.
pub(crate) const STATE: usize = 2;

/// p, dy and alpha before its clamp at a pixel centre.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Footprint {
    pub(super) p: f32,
    pub(super) dy: f32,
    pub(super) raw: f32,
}

/// An item's ellipse and opacity.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Ellipse {
    pub(super) x: f32,
    pub(super) y: f32,
    pub(super) l11: f32,
    pub(super) l21: f32,
    pub(super) l22: f32,
    pub(super) opacity: f32,
}

/// The item whose numbers begin at `at`.
#[cube]
pub(super) fn ellipse_at(splats: &[f32], at: usize) -> Ellipse {
    Ellipse {
        x: splats[at],
        y: splats[at + 1],
        l11: splats[at + 2],
        l21: splats[at + 3],
        l22: splats[at + 4],
        opacity: splats[at + OPACITY],
    }
}

/// What an item is at a pixel centre.
#[cube]
pub(super) fn footprint(e: Ellipse, x: f32, y: f32) -> Footprint {
    let dx = x - e.x;
    let dy = y - e.y;
    let p = e.l11 * dx + e.l21 * dy;
    let q = e.l22 * dy;
    Footprint {
        p,
        dy,
        raw: e.opacity * (-(p * p + q * q)).exp(),
    }
}

/// Blends colour, and with `full` depth and features, into `output`: [n, H, W, 3], or [H, W, 5 + F] with alpha and depth behind
/// colour. `state` is [n, H, W, 2].
#[cube(launch)]
pub(crate) fn raster_kernel(
    lens: Lens,
    splats: &[f32],
    features: &[f32],
    ranges: &[u32],
    list: &[u32],
    output: &mut [f32],
    state: &mut [f32],
    #[comptime] num_features: usize,
    #[comptime] full: bool,
) {
    let tile = CUBE_POS;
    let unit = UNIT_POS as usize;
    let (width, height) = (lens.width as usize, lens.height as usize);
    let across = width.div_ceil(TILE);
    let down = height.div_ceil(TILE);
    let sample = tile / (across * down);
    let within = tile % (across * down);
    let px = (within % across) * TILE + unit % TILE;
    let py = (within / across) * TILE + unit / TILE;
    let inside = px < width && py < height && tile < ranges.len() / 2;
    let (x, y) = (px as f32 + 0.5, py as f32 + 0.5);
    let mut first = 0usize;
    let mut last = 0usize;
    if tile < ranges.len() / 2 {
        first = ranges[2 * tile] as usize;
        last = ranges[2 * tile + 1] as usize;
    }
    let channels = comptime!(if full { 4 + num_features } else { 3 });
    let mut sums = Array::<f32>::new(channels);
    #[unroll]
    for c in 0..channels {
        sums[c] = 0.0;
    }
    let max_alpha = comptime!(MAX_ALPHA as f32);
    let min_alpha = comptime!(MIN_ALPHA as f32);
    let least = comptime!(MIN_TRANSMITTANCE as f32);
    let mut transmittance = 1.0f32;
    let mut drawn = 0u32;
    let mut done = !inside;
    let mut held = Shared::<[f32]>::new_slice(BATCH * HELD);
    let mut batch = first;
    while batch < last {
        if unit < BATCH && batch + unit < last {
            let from = list[batch + unit] as usize * SPLAT;
            #[unroll]
            for k in 0..HELD {
                held[unit * HELD + k] = splats[from + k];
            }
        }
        sync_cube();
        let count = (last - batch).min(BATCH);
        for k in 0..count {
            if !done {
                let at = k * HELD;
                let raw = footprint(ellipse_at(&held, at), x, y).raw;
                let alpha = raw.min(max_alpha);
                if alpha >= min_alpha {
                    let share = alpha * transmittance;
                    let after = transmittance - share;
                    if after > least {
                        transmittance = after;
                        drawn = (batch + k - first + 1) as u32;
                        #[unroll]
                        for c in 0..3usize {
                            sums[c] += share * held[at + COLOR + c];
                        }
                        if comptime!(full) {
                            sums[3] += share * held[at + DEPTH];
                            if comptime!(num_features > 0) {
                                let row = list[batch + k] as usize * num_features;
                                #[unroll]
                                for c in 0..num_features {
                                    sums[4 + c] += share * features[row + c];
                                }
                            }
                        }
                    } else {
                        done = true;
                    }
                }
            }
        }
        sync_cube();
        batch += BATCH;
    }
    if inside {
        let pixel = (sample * height + py) * width + px;
        state[pixel * STATE] = transmittance;
        state[pixel * STATE + 1] = drawn as f32;
        let stride = comptime!(if full { channels + 1 } else { channels });
        #[unroll]
        for c in 0..3usize {
            output[pixel * stride + c] = sums[c];
        }
        if comptime!(full) {
            output[pixel * stride + 3] = 1.0 - transmittance;
            #[unroll]
            for c in 3..channels {
                output[pixel * stride + 1 + c] = sums[c];
            }
        }
    }
}
