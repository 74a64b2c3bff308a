//! Backward of the blending, tile by tile, back to front.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::lanes::{Lanes, PerChannel, add_product, add_scaled, sum_lanes};
use super::project::Splat;
use super::raster::{BATCH, load_batch, load_channels, offsets};
use super::{BASE_CHANNELS, MAX_ALPHA, MIN_ALPHA, Projection, RasterState, Real, TILE};

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
    let mut partial = vec![T::ZERO; tiles.slots.len() * width];
    let mut pieces = Vec::with_capacity(tiles.num_tiles());
    let mut rest = partial.as_mut_slice();
    for tile in 0..tiles.num_tiles() {
        let (piece, more) = rest.split_at_mut(tiles.slots_of_tile(tile).len() * width);
        pieces.push(piece);
        rest = more;
    }
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
    /// Output gradient of the tile: [rows, 5 + F] lanes; reused by the tiles of a thread.
    scratch: &'a mut Vec<Lanes<T>>,
    batch: &'a mut Vec<Splat<T>>,
}

impl<T: Real> WithSimd for UnblendTile<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let zero = [T::ZERO; TILE];
        match self.state.num_features {
            0 => self.run([T::ZERO; 4], [zero; 4]),
            1 => self.run([T::ZERO; 5], [zero; 5]),
            n => self.run(vec![T::ZERO; 4 + n], vec![zero; 4 + n]),
        }
    }
}

impl<T: Real> UnblendTile<'_, T> {
    /// The tile's output gradient with pixels in lanes: alpha first, then colour, depth, features.
    #[inline(always)]
    fn gather(&mut self, left: usize, top: usize, channels: usize) {
        let camera = &self.projection.view.camera;
        let stride = BASE_CHANNELS + self.state.num_features;
        self.scratch.clear();
        self.scratch.resize(TILE * (channels + 1), [T::ZERO; TILE]);
        for row in 0..(camera.height - top).min(TILE) {
            let to = &mut self.scratch[row * (channels + 1)..][..channels + 1];
            for lane in 0..(camera.width - left).min(TILE) {
                let pixel = ((top + row) * camera.width + left + lane) * stride;
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
    fn run(mut self, mut values: impl PerChannel<T>, mut sums: impl PerChannel<Lanes<T>>) {
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
        let list = &tiles.gaussians[tiles.slots_of_tile(self.tile)];
        let last = &self.state.last[self.tile];
        let row_last = last.map(|lanes| lanes.iter().fold(0, |m, l| m.max(*l)));
        let tile_last = row_last.iter().fold(0, |m, l| m.max(*l)) as usize;
        // Transmittance in front of the Gaussians handled so far, and Σ weight · (their channels ·
        // output gradient), which is what lies behind the next one.
        let mut transmittance = self.state.transmittance[self.tile];
        let mut behind = [[T::ZERO; TILE]; TILE];

        for (k, batch_list) in list[..tile_last].chunks(BATCH).enumerate().rev() {
            load_batch(projection, batch_list, self.batch);
            for (place, splat) in self.batch.iter().enumerate().rev() {
                let place = k * BATCH + place;
                load_channels(splat, self.features, values);
                sums.fill([T::ZERO; TILE]);
                let mut geometric = [[T::ZERO; TILE]; GEOMETRIC];
                let dx = offsets(left, splat.mean[0]);
                let [from, to] = splat.rows.map(usize::from);
                for row in from.saturating_sub(top)..(to - top).min(TILE) {
                    if row_last[row] as usize <= place {
                        continue;
                    }
                    let dy = T::of((top + row) as f64 + 0.5) - splat.mean[1];
                    let shift = splat.l21 * dy;
                    let q = splat.l22 * dy;
                    let q2 = q * q;
                    let v_output = &self.scratch[row * (channels + 1)..][..channels + 1];
                    let mut dot = v_output[0];
                    for (v, value) in v_output[1..].iter().zip(values.iter()) {
                        add_scaled(&mut dot, v, *value);
                    }
                    let (last, transmittance, behind) =
                        (&last[row], &mut transmittance[row], &mut behind[row]);
                    let mut weight = [T::ZERO; TILE];
                    let mut s = [T::ZERO; TILE];
                    let mut p = [T::ZERO; TILE];
                    for l in 0..TILE {
                        // The same operations as in the forward pass, so that the same pixels are drawn.
                        p[l] = splat.l11 * dx[l] + shift;
                        let raw = splat.opacity * (p[l] * p[l] + q2).exp_neg();
                        let clamped = raw.min(T::of(MAX_ALPHA));
                        let drawn = (clamped >= T::of(MIN_ALPHA)) & (last[l] > place as u32);
                        let alpha = if drawn { clamped } else { T::ZERO };
                        let inverse = T::ONE / (T::ONE - alpha);
                        // Not after / (1 - alpha), for the forward pass' reason.
                        let after = transmittance[l];
                        let share = alpha * inverse * after;
                        let before = after + share;
                        transmittance[l] = before;
                        weight[l] = share;
                        let v_alpha = before * dot[l] - behind[l] * inverse;
                        behind[l] += weight[l] * dot[l];
                        // ∂alpha/∂sigma = -alpha, and 0 where alpha is clamped.
                        let passes = drawn & (raw < T::of(MAX_ALPHA));
                        s[l] = if passes { -(v_alpha * raw) } else { T::ZERO };
                    }
                    let sp: Lanes<T> = std::array::from_fn(|l| s[l] * p[l]);
                    add_scaled(&mut geometric[0], &sp, T::ONE);
                    add_product(&mut geometric[1], &sp, &p);
                    add_scaled(&mut geometric[2], &sp, dy);
                    add_scaled(&mut geometric[3], &s, dy);
                    add_scaled(&mut geometric[4], &s, dy * dy);
                    add_scaled(&mut geometric[5], &s, T::ONE);
                    for (sum, v) in sums.iter_mut().zip(&v_output[1..]) {
                        add_product(sum, &weight, v);
                    }
                }
                let partial = &mut self.partial[place * width..][..width];
                sum_lanes(&geometric, &mut partial[..GEOMETRIC]);
                sum_lanes(sums, &mut partial[GEOMETRIC..]);
            }
        }
    }
}
