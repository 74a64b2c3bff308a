//! Which Gaussians touch which tile, and where each pair's partial gradient lies.

use rayon::prelude::*;

use super::constants::TILE;
use super::real::Real;
use super::splat::{Extent, Splat};
use crate::error::SplatError;

/// For every tile its Gaussians in depth order, and for every Gaussian its places in those lists.
///
/// A *slot* is a place in the concatenation of the tiles' lists. Gaussians are counted in depth order.
#[derive(Clone, Debug, Default)]
pub(super) struct TileLists {
    /// Number of tiles along x and y.
    pub(super) across: usize,
    pub(super) down: usize,
    /// First slot of every tile, and the number of slots.
    pub(super) tile_starts: Vec<u32>,
    /// Gaussian of every slot.
    pub(super) gaussians: Vec<u32>,
    /// First entry of every Gaussian in `slots`, and their number.
    pub(super) slot_starts: Vec<u32>,
    /// Slots, Gaussian by Gaussian.
    pub(super) slots: Vec<u32>,
}

impl TileLists {
    pub(super) fn num_tiles(&self) -> usize {
        self.across * self.down
    }

    /// The slots of a tile.
    #[inline]
    pub(super) fn slots_of_tile(&self, tile: usize) -> std::ops::Range<usize> {
        self.tile_starts[tile] as usize..self.tile_starts[tile + 1] as usize
    }

    /// A table of `width` values per slot, cut by tiles.
    pub(super) fn pieces_by_tile<'a, V>(
        &self,
        table: &'a mut [V],
        width: usize,
    ) -> Vec<&'a mut [V]> {
        let mut rest = table;
        let sizes = self.tile_starts.windows(2).map(|w| (w[1] - w[0]) as usize);
        sizes
            .map(|slots| {
                let (piece, more) = std::mem::take(&mut rest).split_at_mut(slots * width);
                rest = more;
                piece
            })
            .collect()
    }

    /// The slots of a Gaussian, tiles ascending.
    #[inline]
    pub(super) fn slots_of_gaussian(&self, gaussian: usize) -> &[u32] {
        &self.slots[self.slot_starts[gaussian] as usize..self.slot_starts[gaussian + 1] as usize]
    }

    /// Lists for Gaussians in depth order.
    pub(super) fn new<T: Real>(
        splats: &[Splat<T>],
        extents: &[Extent<T>],
        width: usize,
        height: usize,
    ) -> Result<Self, SplatError> {
        let (across, down) = (width.div_ceil(TILE), height.div_ceil(TILE));
        // Every chunk of Gaussians by itself: the tiles of each, and how many come into each tile.
        let mut chunks: Vec<Chunk> = splats
            .par_chunks(CHUNK)
            .zip(extents.par_chunks(CHUNK))
            .map(|(splats, extents)| {
                let mut chunk = Chunk {
                    tiles: Vec::with_capacity(3 * splats.len()),
                    ends: Vec::with_capacity(splats.len()),
                    counts: vec![0; across * down],
                };
                for (splat, extent) in splats.iter().zip(extents) {
                    each_tile(splat, extent, across, |tile| {
                        chunk.tiles.push(tile);
                        chunk.counts[tile as usize] += 1;
                    });
                    chunk.ends.push(chunk.tiles.len() as u32);
                }
                chunk
            })
            .collect();
        let count: usize = chunks.iter().map(|chunk| chunk.tiles.len()).sum();
        if count > u32::MAX as usize {
            return Err(SplatError::TooManyTiles { count });
        }
        // A chunk's counts become its first slot in every tile. Gaussians come in depth order, and so do their slots.
        let mut tile_starts = Vec::with_capacity(across * down + 1);
        let mut next = 0;
        for tile in 0..across * down {
            tile_starts.push(next);
            for chunk in &mut chunks {
                let count = std::mem::replace(&mut chunk.counts[tile], next);
                next += count;
            }
        }
        tile_starts.push(next);
        let mut slot_starts = Vec::with_capacity(splats.len() + 1);
        slot_starts.push(0);
        let mut first = 0;
        for chunk in &chunks {
            slot_starts.extend(chunk.ends.iter().map(|end| first + end));
            first += chunk.tiles.len() as u32;
        }
        chunks.par_iter_mut().for_each(|chunk| {
            for slot in &mut chunk.tiles {
                let place = &mut chunk.counts[*slot as usize];
                *slot = *place;
                *place += 1;
            }
        });
        let mut slots = Vec::with_capacity(count);
        for chunk in chunks {
            slots.extend_from_slice(&chunk.tiles);
        }
        let mut gaussians = vec![0_u32; count];
        for (gaussian, range) in slot_starts.windows(2).enumerate() {
            for slot in &slots[range[0] as usize..range[1] as usize] {
                gaussians[*slot as usize] = gaussian as u32;
            }
        }
        Ok(Self {
            across,
            down,
            tile_starts,
            gaussians,
            slot_starts,
            slots,
        })
    }
}

/// Gaussians that one task lists: enough that its counts by tile are not what it spends its time on.
const CHUNK: usize = 1 << 14;

/// The lists of some Gaussians.
struct Chunk {
    /// Tiles of all of them, one Gaussian after the other; then their slots.
    tiles: Vec<u32>,
    /// Where each Gaussian's tiles end.
    ends: Vec<u32>,
    /// Number of tiles' entries; then the tile's next slot.
    counts: Vec<u32>,
}

/// Calls `visit` with every tile that has a pixel centre in the ellipse's bounding interval of its
/// band of rows, in ascending order.
#[inline]
fn each_tile<T: Real>(
    splat: &Splat<T>,
    extent: &Extent<T>,
    across: usize,
    mut visit: impl FnMut(u32),
) {
    let half = T::of(0.5);
    let [mx, my] = splat.mean;
    // The slanted ellipse x(dy) = rho dy ± sqrt(sigma - q²) / l11: its rightmost point lies at
    // dy = tip, its leftmost at -tip, so over a band of rows the extreme is at the nearest dy.
    let rho = -splat.l21 / splat.l11;
    let tip = rho * extent.half[1] * extent.half[1] / extent.half[0];
    let [from, to] = splat.rows.map(usize::from);
    for band in from / TILE..to.div_ceil(TILE) {
        let first = (band * TILE).max(from);
        let last = ((band + 1) * TILE).min(to) - 1;
        let low = T::of(first as f64) + half - my;
        let high = T::of(last as f64) + half - my;
        let side = |dy: T| {
            let dy = dy.max(low).min(high);
            let q = splat.l22 * dy;
            let root = (extent.sigma_max - q * q).max(T::ZERO).sqrt() / splat.l11;
            (rho * dy, root * T::of(1.001) + T::of(0.01))
        };
        let (right, right_root) = side(tip);
        let (left, left_root) = side(-tip);
        let Some((from, to)) = pixel_range(
            mx + left - left_root,
            mx + right + right_root,
            across * TILE,
        ) else {
            continue;
        };
        for column in from / TILE..to.div_ceil(TILE) {
            visit((band * across + column) as u32);
        }
    }
}

/// The pixels [from, to) of a line of `count` whose centres lie in [low, high].
#[inline(always)]
pub(super) fn pixel_range<T: Real>(low: T, high: T, count: usize) -> Option<(usize, usize)> {
    let limit = T::of(count as f64);
    let low = (low - T::of(0.5)).max(T::ZERO);
    let high = (high + T::of(0.5)).min(limit);
    if !(low < limit && high > T::ZERO) {
        return None;
    }
    let (from, to) = (low.to_f64().ceil() as usize, high.to_f64().floor() as usize);
    (from < to).then_some((from, to))
}
