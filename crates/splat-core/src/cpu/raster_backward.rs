//! Backward of the blending, tile by tile, back to front.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use host::filled;

use super::blocks::{BLOCK, BLOCKS, PerChannel, centers, place};
use super::constants::{BASE_CHANNELS, MAX_ALPHA, MIN_ALPHA, TILE};
use super::project::Projection;
use super::raster::{BATCH, Footprint, RasterState, load_batch, load_channels};
use super::real::Real;
use super::splat::Splat;

/// Geometric sums in a partial gradient, before its channels. With s = ∂L/∂sigma per pixel:
/// Σ s p, Σ s p², Σ s p dy, Σ s dy, Σ s dy², Σ s.
pub(super) const GEOMETRIC: usize = 6;

/// The partial gradient of every slot: [slots, 6 + 4 + F] row-major, the geometric sums and then the
/// gradients of colour, depth and features.
pub(super) fn partial_gradients<T: Real>(
    projection: &Projection<T>,
    features: &[T],
    state: &RasterState<T>,
    v_output: &[T],
) -> Vec<T> {
    let _span = tracing::trace_span!("rasterize backward").entered();
    let tiles = &projection.tiles;
    let width = GEOMETRIC + 4 + state.num_features;
    let mut partial = filled(T::ZERO, tiles.slots.len() * width);
    let pieces = tiles.pieces_by_tile(&mut partial, width);
    let arch = Arch::new();
    pieces.into_par_iter().enumerate().for_each_init(
        Default::default,
        |(scratch, batch), (tile, partial)| {
            if !partial.is_empty() {
                arch.dispatch(UnblendTile {
                    projection,
                    features,
                    state,
                    v_output,
                    tile,
                    partial,
                    scratch,
                    batch,
                });
            }
        },
    );
    partial
}

struct UnblendTile<'a, T> {
    projection: &'a Projection<T>,
    features: &'a [T],
    state: &'a RasterState<T>,
    v_output: &'a [T],
    tile: usize,
    partial: &'a mut [T],
    /// Output gradient of the tile: [blocks, 5 + F] of 16 pixels; reused by the tiles of a thread.
    scratch: &'a mut Vec<[T; BLOCK]>,
    batch: &'a mut Vec<Splat<T>>,
}

impl<T: Real> WithSimd for UnblendTile<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let zero = T::splat(simd, T::ZERO);
        match self.state.num_features {
            0 => self.run(simd, [zero; 4], [zero; 4]),
            1 => self.run(simd, [zero; 5], [zero; 5]),
            n => self.run(simd, vec![zero; 4 + n], vec![zero; 4 + n]),
        }
    }
}

impl<T: Real> UnblendTile<'_, T> {
    /// The tile's output gradient by blocks: alpha first, then colour, depth, features.
    #[inline(always)]
    fn gather(&mut self, left: usize, top: usize, channels: usize) {
        let camera = &self.projection.view.camera;
        let stride = BASE_CHANNELS + self.state.num_features;
        self.scratch.clear();
        self.scratch.resize(BLOCKS * stride, [T::ZERO; BLOCK]);
        for y in 0..(camera.height - top).min(TILE) {
            for x in 0..(camera.width - left).min(TILE) {
                let (block, lane) = place(y, x);
                let to = &mut self.scratch[block * (channels + 1)..][..channels + 1];
                let pixel = ((top + y) * camera.width + left + x) * stride;
                let from = &self.v_output[pixel..pixel + stride];
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

    #[inline(always)]
    fn run<S: Simd>(
        mut self,
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
        self.gather(left, top, channels);
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
                    let v_output = &self.scratch[block * (channels + 1)..][..channels + 1];
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
