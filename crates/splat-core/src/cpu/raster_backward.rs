//! Backward of the blending, tile by tile, back to front.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use host::filled;

use super::blocks::{BLOCK, BLOCKS, PerChannel, centers, place};
use super::constants::{MAX_ALPHA, MIN_ALPHA, TILE};
use super::project::Projection;
use super::raster::{BATCH, Footprint, RasterState, load_batch, load_channels};
use super::real::Real;
use super::splat::Splat;
use super::tiles::TileLists;
use crate::camera::Camera;

/// Geometric sums in a partial gradient, before its channels. With s = ∂L/∂sigma per pixel:
/// Σ s p, Σ s p², Σ s p dy, Σ s dy, Σ s dy², Σ s.
pub(crate) const GEOMETRIC: usize = 6;

/// The partial gradient of every slot: [slots, 6 + C] row-major, the geometric sums and then the gradients of the C
/// channels that were blended.
///
/// `v_tile` writes the gradient of a tile's output: [blocks, 1 + C] of 16 pixels, alpha first; it finds zeros.
pub(super) fn partial_gradients<T: Real>(
    projection: &Projection<T>,
    features: &[T],
    state: &RasterState<T>,
    v_tile: impl Fn(usize, &mut [[T; BLOCK]]) + Sync,
) -> Vec<T> {
    let _span = tracing::trace_span!("rasterize backward").entered();
    let tiles = &projection.tiles;
    let width = GEOMETRIC + state.channels;
    let mut partial = filled(T::ZERO, tiles.slots.len() * width);
    let pieces = tiles.pieces_by_tile(&mut partial, width);
    let arch = Arch::new();
    pieces.into_par_iter().enumerate().for_each_init(
        Default::default,
        |(scratch, batch), (tile, partial)| {
            if !partial.is_empty() {
                let scratch: &mut Vec<[T; BLOCK]> = scratch;
                scratch.clear();
                scratch.resize(BLOCKS * (1 + state.channels), [T::ZERO; BLOCK]);
                v_tile(tile, scratch);
                arch.dispatch(UnblendTile {
                    projection,
                    features,
                    state,
                    v_output: scratch,
                    tile,
                    partial,
                    batch,
                });
            }
        },
    );
    partial
}

/// The partial gradients of Gaussians, `width` values each, summed over their slots; `ranks` are their places in depth order.
///
/// A tight loop of its own: the cache misses on partial gradients, which lie in the order of tiles, then overlap.
#[inline(always)]
pub(super) fn slot_sums<T: Real>(
    tiles: &TileLists,
    partial: &[T],
    width: usize,
    ranks: &[u32],
) -> Vec<T> {
    let mut sums = vec![T::ZERO; width * ranks.len()];
    for (rank, sums) in ranks.iter().zip(sums.chunks_exact_mut(width)) {
        if *rank != u32::MAX {
            for slot in tiles.slots_of_gaussian(*rank as usize) {
                let partial = &partial[*slot as usize * width..][..width];
                for (sum, value) in sums.iter_mut().zip(partial) {
                    *sum += *value;
                }
            }
        }
    }
    sums
}

/// The gradient of a tile's output from that of an image [H, W, 5 + F]: see [`partial_gradients`].
pub(super) fn tile_gradient<T: Real>(
    camera: &Camera,
    channels: usize,
    v_output: &[T],
    tile: usize,
    v_tile: &mut [[T; BLOCK]],
) {
    let across = camera.width.div_ceil(TILE);
    let (left, top) = (tile % across * TILE, tile / across * TILE);
    let stride = channels + 1;
    for y in 0..(camera.height - top).min(TILE) {
        for x in 0..(camera.width - left).min(TILE) {
            let (block, lane) = place(y, x);
            let to = &mut v_tile[block * stride..][..stride];
            let pixel = ((top + y) * camera.width + left + x) * stride;
            let from = &v_output[pixel..pixel + stride];
            to[0][lane] = from[3];
            for k in 0..3 {
                to[1 + k][lane] = from[k];
            }
            for k in 4..stride {
                to[k][lane] = from[k];
            }
        }
    }
}

struct UnblendTile<'a, T> {
    projection: &'a Projection<T>,
    features: &'a [T],
    state: &'a RasterState<T>,
    /// Output gradient of the tile: [blocks, 1 + C] of 16 pixels.
    v_output: &'a [[T; BLOCK]],
    tile: usize,
    partial: &'a mut [T],
    batch: &'a mut Vec<Splat<T>>,
}

impl<T: Real> WithSimd for UnblendTile<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let zero = T::splat(simd, T::ZERO);
        match self.state.channels {
            3 => self.run(simd, [zero; 3], [zero; 3]),
            4 => self.run(simd, [zero; 4], [zero; 4]),
            5 => self.run(simd, [zero; 5], [zero; 5]),
            n => self.run(simd, vec![zero; n], vec![zero; n]),
        }
    }
}

impl<T: Real> UnblendTile<'_, T> {
    #[inline(always)]
    fn run<S: Simd>(
        self,
        simd: S,
        mut values: impl PerChannel<T::Vector<S>>,
        mut sums: impl PerChannel<T::Vector<S>>,
    ) {
        let (projection, tiles) = (self.projection, &self.projection.tiles);
        let (left, top) = (
            self.tile % tiles.across * TILE,
            self.tile / tiles.across * TILE,
        );
        let values = values.values();
        let sums = sums.values();
        let channels = values.len();
        let width = GEOMETRIC + channels;
        let [xs, ys] = centers::<T>(left, top);
        let list = &tiles.gaussians[tiles.slots_of_tile(self.tile)];
        let last = &self.state.last[self.tile];
        let drawn = &self.state.drawn[tiles.slots_of_tile(self.tile)];
        let tile_last = drawn.iter().rposition(|b| *b != 0).map_or(0, |p| p + 1);
        // Transmittance in front of the Gaussians handled so far, and Σ weight · (their channels ·
        // output gradient), which is what lies behind the next one.
        let mut transmittance = self.state.transmittance[self.tile];
        let mut behind = [[T::ZERO; BLOCK]; BLOCKS];
        let [zero, one] = [T::ZERO, T::ONE].map(|v| T::splat(simd, v));
        let min_alpha = T::splat(simd, T::of(MIN_ALPHA));
        let max_alpha = T::splat(simd, T::of(MAX_ALPHA));

        for (k, batch_list) in list[..tile_last].chunks(BATCH).enumerate().rev() {
            load_batch(projection, batch_list, self.batch);
            for (place, splat) in self.batch.iter().enumerate().rev() {
                let place = k * BATCH + place;
                let mut blocks = drawn[place];
                if blocks == 0 {
                    continue;
                }
                load_channels(simd, splat, self.features, values);
                let footprint = Footprint::new(simd, splat);
                let place_in_lanes = T::splat(simd, T::of(place as f64));
                sums.fill(zero);
                let mut geometric = [zero; GEOMETRIC];
                while blocks != 0 {
                    let block = blocks.trailing_zeros() as usize;
                    blocks &= blocks - 1;
                    let (xs, ys) = (T::vectors::<S>(&xs[block]), T::vectors::<S>(&ys[block]));
                    let last = T::vectors::<S>(&last[block]);
                    let transmittance = T::vectors_mut::<S>(&mut transmittance[block]);
                    let behind = T::vectors_mut::<S>(&mut behind[block]);
                    let v_output = &self.v_output[block * (channels + 1)..][..channels + 1];
                    for v in 0..xs.len() {
                        let mut dot = T::vectors::<S>(&v_output[0])[v];
                        for (gradient, value) in v_output[1..].iter().zip(values.iter()) {
                            dot = T::mul_add(simd, T::vectors::<S>(gradient)[v], *value, dot);
                        }
                        // The same operations as in the forward pass, so that the same pixels are drawn.
                        let (p, dy, raw) = footprint.at::<T, S>(simd, xs[v], ys[v]);
                        let unclamped = T::less(simd, raw, max_alpha);
                        let clamped = T::select(simd, unclamped, raw, max_alpha);
                        let seen =
                            T::select(simd, T::less(simd, place_in_lanes, last[v]), clamped, zero);
                        let alpha = T::select(simd, T::less(simd, seen, min_alpha), zero, seen);
                        let inverse = T::vdiv(simd, one, T::vsub(simd, one, alpha));
                        // Not after / (1 - alpha), for the forward pass' reason.
                        let after = transmittance[v];
                        let share = T::vmul(simd, T::vmul(simd, alpha, inverse), after);
                        let before = T::vadd(simd, after, share);
                        transmittance[v] = before;
                        let v_alpha = T::vsub(
                            simd,
                            T::vmul(simd, before, dot),
                            T::vmul(simd, behind[v], inverse),
                        );
                        behind[v] = T::mul_add(simd, share, dot, behind[v]);
                        // ∂alpha/∂sigma = -alpha, and 0 where alpha is clamped.
                        let passing = T::select(simd, unclamped, alpha, zero);
                        let s = T::vsub(simd, zero, T::vmul(simd, v_alpha, passing));
                        let sp = T::vmul(simd, s, p);
                        let s_dy = T::vmul(simd, s, dy);
                        geometric[0] = T::vadd(simd, geometric[0], sp);
                        geometric[1] = T::mul_add(simd, sp, p, geometric[1]);
                        geometric[2] = T::mul_add(simd, sp, dy, geometric[2]);
                        geometric[3] = T::vadd(simd, geometric[3], s_dy);
                        geometric[4] = T::mul_add(simd, s_dy, dy, geometric[4]);
                        geometric[5] = T::vadd(simd, geometric[5], s);
                        for (sum, gradient) in sums.iter_mut().zip(&v_output[1..]) {
                            *sum = T::mul_add(simd, share, T::vectors::<S>(gradient)[v], *sum);
                        }
                    }
                }
                let partial = &mut self.partial[place * width..][..width];
                for (target, sum) in partial.iter_mut().zip(geometric.iter().chain(&*sums)) {
                    *target = T::sum(simd, *sum);
                }
            }
        }
    }
}
