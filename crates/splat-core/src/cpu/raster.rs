//! Forward blending, tile by tile.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::lanes::{Lanes, PerChannel, add_scaled};
use super::project::{Splat, find_not_finite};
use super::{BASE_CHANNELS, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, Projection, Real, TILE};
use crate::SplatError;

/// An alpha threshold that no alpha reaches: marks pixels that are done.
const DONE: f64 = 2.0;

/// An image and what its backward pass needs.
#[derive(Clone, Debug)]
pub struct Raster<T> {
    /// [H, W, 5 + F]: colour 3, alpha, depth Σ z α T (not divided by alpha), features F.
    pub output: Vec<T>,
    /// For [`super::backward`].
    pub state: RasterState<T>,
}

/// What the backward pass needs of a forward pass beside its inputs.
#[derive(Clone, Debug)]
pub struct RasterState<T> {
    /// Transmittance behind the last Gaussian, per tile and row.
    pub(super) transmittance: Vec<[Lanes<T>; TILE]>,
    /// Per pixel one more than the place in the tile's list of the last Gaussian that was drawn.
    pub(super) last: Vec<[Lanes<u32>; TILE]>,
    pub(super) num_features: usize,
}

/// Blends projected Gaussians into colour, alpha, depth and `num_features` feature channels
/// (`features` is [N, F] row-major; empty for none), front to back on a black background.
///
/// # Errors
/// Features of the wrong length or not finite.
pub fn rasterize<T: Real>(
    projection: &Projection<T>,
    features: &[T],
    num_features: usize,
) -> Result<Raster<T>, SplatError> {
    let _span = tracing::trace_span!("rasterize").entered();
    if features.len() != projection.count * num_features {
        return Err(SplatError::Shape {
            tensor: "features",
            found: vec![features.len()],
            expected: format!("[{}, {num_features}]", projection.count),
        });
    }
    if num_features > 0 {
        find_not_finite("features", features, num_features, 0)?;
    }
    let channels = 4 + num_features;
    let tiles = &projection.tiles;
    let num_tiles = tiles.num_tiles();
    let per_tile = TILE * channels;
    let mut blended = vec![[T::ZERO; TILE]; num_tiles * per_tile];
    let mut transmittance = vec![[[T::ONE; TILE]; TILE]; num_tiles];
    let mut last = vec![[[0_u32; TILE]; TILE]; num_tiles];
    let arch = Arch::new();
    blended
        .par_chunks_mut(per_tile)
        .zip(&mut transmittance)
        .zip(&mut last)
        .enumerate()
        .for_each_init(
            Vec::new,
            |batch, (tile, ((blended, transmittance), last))| {
                arch.dispatch(BlendTile {
                    projection,
                    features,
                    num_features,
                    tile,
                    blended,
                    transmittance,
                    last,
                    batch,
                });
            },
        );

    let (width, depth_and_more) = (projection.view.camera.width, num_features + 1);
    let stride = BASE_CHANNELS + num_features;
    let mut output = vec![T::ZERO; projection.view.camera.num_pixels() * stride];
    output
        .par_chunks_mut(width * stride)
        .enumerate()
        .for_each(|(y, line)| {
            for (x, pixel) in line.chunks_exact_mut(stride).enumerate() {
                let tile = y / TILE * tiles.across + x / TILE;
                let (row, lane) = (y % TILE, x % TILE);
                let from = &blended[tile * per_tile + row * channels..][..channels];
                for k in 0..3 {
                    pixel[k] = from[k][lane];
                }
                pixel[3] = T::ONE - transmittance[tile][row][lane];
                for k in 0..depth_and_more {
                    pixel[4 + k] = from[3 + k][lane];
                }
            }
        });
    Ok(Raster {
        output,
        state: RasterState {
            transmittance,
            last,
            num_features,
        },
    })
}

/// Horizontal positions of a tile's pixel centres relative to `mean_x`.
#[inline(always)]
pub(super) fn offsets<T: Real>(first_column: usize, mean_x: T) -> Lanes<T> {
    let base = T::of(first_column as f64 + 0.5);
    std::array::from_fn(|l| (base + T::of(l as f64)) - mean_x)
}

/// Gaussians that a tile loads at a time: their cache misses overlap.
pub(super) const BATCH: usize = 64;

/// Loads a batch of a tile's Gaussians.
#[inline(always)]
pub(super) fn load_batch<T: Real>(
    projection: &Projection<T>,
    list: &[u32],
    batch: &mut Vec<Splat<T>>,
) {
    batch.clear();
    batch.extend(list.iter().map(|g| projection.splats[*g as usize]));
}

/// Colour, depth and features of a Gaussian.
#[inline(always)]
pub(super) fn load_channels<T: Real>(splat: &Splat<T>, features: &[T], values: &mut [T]) {
    values[..4].copy_from_slice(&splat.channels);
    let num_features = values.len() - 4;
    if num_features > 0 {
        let row = splat.row as usize * num_features;
        values[4..].copy_from_slice(&features[row..row + num_features]);
    }
}

struct BlendTile<'a, T> {
    projection: &'a Projection<T>,
    features: &'a [T],
    num_features: usize,
    tile: usize,
    blended: &'a mut [Lanes<T>],
    transmittance: &'a mut [Lanes<T>; TILE],
    last: &'a mut [Lanes<u32>; TILE],
    /// Reused by the tiles of a thread.
    batch: &'a mut Vec<Splat<T>>,
}

impl<T: Real> WithSimd for BlendTile<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        match self.num_features {
            0 => self.run([T::ZERO; 4]),
            1 => self.run([T::ZERO; 5]),
            n => self.run(vec![T::ZERO; 4 + n]),
        }
    }
}

impl<T: Real> BlendTile<'_, T> {
    #[inline(always)]
    fn run(self, mut values: impl PerChannel<T>) {
        let (projection, tiles) = (self.projection, &self.projection.tiles);
        let camera = &projection.view.camera;
        let (left, top) = (
            self.tile % tiles.across * TILE,
            self.tile / tiles.across * TILE,
        );
        let rows = (camera.height - top).min(TILE);
        let columns = (camera.width - left).min(TILE);
        // The alpha from which a pixel is drawn; pixels outside the image are done from the start.
        let mut threshold = [[T::of(DONE); TILE]; TILE];
        for row in &mut threshold[..rows] {
            row[..columns].fill(T::of(MIN_ALPHA));
        }
        let values = values.values();
        let channels = values.len();
        let list = &tiles.gaussians[tiles.slots_of_tile(self.tile)];
        for (k, batch_list) in list.chunks(BATCH).enumerate() {
            if threshold.iter().flatten().all(|t| *t == T::of(DONE)) {
                break;
            }
            load_batch(projection, batch_list, self.batch);
            for (place, splat) in self.batch.iter().enumerate() {
                let place = (k * BATCH + place) as u32;
                load_channels(splat, self.features, values);
                let dx = offsets(left, splat.mean[0]);
                let [from, to] = splat.rows.map(usize::from);
                for row in from.saturating_sub(top)..(to - top).min(TILE) {
                    let dy = T::of((top + row) as f64 + 0.5) - splat.mean[1];
                    let shift = splat.l21 * dy;
                    let q = splat.l22 * dy;
                    let q2 = q * q;
                    let threshold = &mut threshold[row];
                    let transmittance = &mut self.transmittance[row];
                    let last = &mut self.last[row];
                    let mut weight = [T::ZERO; TILE];
                    for l in 0..TILE {
                        let p = splat.l11 * dx[l] + shift;
                        let alpha = (splat.opacity * (p * p + q2).exp_neg()).min(T::of(MAX_ALPHA));
                        let before = transmittance[l];
                        let share = alpha * before;
                        // Not before (1 - alpha): many equal alphas would round 1 - alpha the same way each time.
                        let after = before - share;
                        let seen = alpha >= threshold[l];
                        let drawn = seen & (after > T::of(MIN_TRANSMITTANCE));
                        threshold[l] = if seen & !drawn {
                            T::of(DONE)
                        } else {
                            threshold[l]
                        };
                        transmittance[l] = if drawn { after } else { before };
                        last[l] = if drawn { place + 1 } else { last[l] };
                        weight[l] = if drawn { share } else { T::ZERO };
                    }
                    let blended = &mut self.blended[row * channels..][..channels];
                    for (sum, value) in blended.iter_mut().zip(values.iter()) {
                        add_scaled(sum, &weight, *value);
                    }
                }
            }
        }
    }
}
