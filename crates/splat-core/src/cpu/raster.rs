//! Forward blending, tile by tile.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use host::filled;

use super::blocks::{ACROSS, BLOCK, BLOCKS, PerChannel, Pixels, blocks_under, centers, place};
use super::constants::{BASE_CHANNELS, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};
use super::project::{Projection, find_not_finite};
use super::real::Real;
use super::splat::Splat;
use crate::camera::Camera;
use crate::error::SplatError;

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
    /// Transmittance behind the last Gaussian, per tile.
    pub(super) transmittance: Vec<Pixels<T>>,
    /// Per pixel one more than the place in the tile's list of the last Gaussian that was drawn.
    pub(super) last: Vec<Pixels<T>>,
    /// For every slot a bit for each block of the tile in which the Gaussian was drawn.
    pub(super) drawn: Vec<u16>,
    /// Blended channels: colour, and depth and features where they were wanted.
    pub(super) channels: usize,
}

impl<T: Copy> Raster<T> {
    /// Colour of every pixel, row by row.
    pub fn color(&self) -> impl ExactSizeIterator<Item = [T; 3]> {
        self.pixels().map(|p| [p[0], p[1], p[2]])
    }

    /// 1 - the light that passes through all Gaussians, of every pixel.
    pub fn alpha(&self) -> impl ExactSizeIterator<Item = T> {
        self.pixels().map(|p| p[3])
    }

    /// Σ z α T of every pixel in scene units, not divided by alpha.
    pub fn depth(&self) -> impl ExactSizeIterator<Item = T> {
        self.pixels().map(|p| p[4])
    }

    /// The blended features of every pixel; empty slices where there were none.
    pub fn features(&self) -> impl ExactSizeIterator<Item = &[T]> {
        self.pixels().map(|p| &p[BASE_CHANNELS..])
    }

    fn pixels(&self) -> std::slice::ChunksExact<'_, T> {
        self.output.chunks_exact(self.state.channels + 1)
    }
}

/// See [`super::rasterize`].
pub(super) fn rasterize<T: Real>(
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
    let (blended, state) = blend(projection, features, channels);
    let camera = &projection.view.camera;
    let depth_and_more = num_features + 1;
    let stride = BASE_CHANNELS + num_features;
    let mut output = filled(T::ZERO, camera.num_pixels() * stride);
    each_line(&mut output, camera, stride, |tile, block, lane, pixel| {
        let from = &blended[(tile * BLOCKS + block) * channels..][..channels];
        for k in 0..3 {
            pixel[k] = from[k][lane];
        }
        pixel[3] = T::ONE - state.transmittance[tile][block][lane];
        for k in 0..depth_and_more {
            pixel[4 + k] = from[3 + k][lane];
        }
    });
    Ok(Raster { output, state })
}

/// Calls `write` with every pixel of an image and where it is: tile, block, lane.
pub(super) fn each_line<T: Real>(
    output: &mut [T],
    camera: &Camera,
    stride: usize,
    write: impl Fn(usize, usize, usize, &mut [T]) + Sync,
) {
    let across = camera.width.div_ceil(TILE);
    output
        .par_chunks_mut(camera.width * stride)
        .enumerate()
        .for_each(|(y, line)| {
            for (x, pixel) in line.chunks_exact_mut(stride).enumerate() {
                let (block, lane) = place(y % TILE, x % TILE);
                write(y / TILE * across + x / TILE, block, lane, pixel);
            }
        });
}

/// Blends the first `channels` of colour, depth and features: [tiles, blocks, channels] of 16 pixels.
pub(super) fn blend<T: Real>(
    projection: &Projection<T>,
    features: &[T],
    channels: usize,
) -> (Vec<[T; BLOCK]>, RasterState<T>) {
    let tiles = &projection.tiles;
    let num_tiles = tiles.num_tiles();
    let per_tile = BLOCKS * channels;
    let mut blended = filled([T::ZERO; BLOCK], num_tiles * per_tile);
    let mut transmittance = filled([[T::ONE; BLOCK]; BLOCKS], num_tiles);
    let mut last = filled([[T::ZERO; BLOCK]; BLOCKS], num_tiles);
    let mut drawn = vec![0_u16; tiles.slots.len()];
    let arch = Arch::new();
    blended
        .par_chunks_mut(per_tile)
        .zip(&mut transmittance)
        .zip(&mut last)
        .zip(tiles.pieces_by_tile(&mut drawn, 1))
        .enumerate()
        .for_each_init(
            Vec::new,
            |batch, (tile, (((blended, transmittance), last), drawn))| {
                arch.dispatch(BlendTile {
                    projection,
                    features,
                    channels,
                    tile,
                    blended,
                    transmittance,
                    last,
                    drawn,
                    batch,
                });
            },
        );
    let state = RasterState {
        transmittance,
        last,
        drawn,
        channels,
    };
    (blended, state)
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

/// Colour, depth and features of a Gaussian, each in all lanes.
#[inline(always)]
pub(super) fn load_channels<T: Real, S: Simd>(
    simd: S,
    splat: &Splat<T>,
    features: &[T],
    values: &mut [T::Vector<S>],
) {
    let row = splat.row as usize * values.len().saturating_sub(4);
    for (k, value) in values.iter_mut().enumerate() {
        *value = T::splat(
            simd,
            if k < 4 {
                splat.channels[k]
            } else {
                features[row + k - 4]
            },
        );
    }
}

/// A Gaussian's ellipse and opacity, each in all lanes.
#[derive(Clone, Copy)]
pub(super) struct Footprint<V> {
    x: V,
    y: V,
    l11: V,
    l21: V,
    l22: V,
    opacity: V,
}

impl<V: Copy> Footprint<V> {
    #[inline(always)]
    pub(super) fn new<T: Real<Vector<S> = V>, S: Simd>(simd: S, splat: &Splat<T>) -> Self {
        let splat_of = |value| T::splat(simd, value);
        Self {
            x: splat_of(splat.mean[0]),
            y: splat_of(splat.mean[1]),
            l11: splat_of(splat.l11),
            l21: splat_of(splat.l21),
            l22: splat_of(splat.l22),
            opacity: splat_of(splat.opacity),
        }
    }

    /// p, dy and alpha before its clamp at some pixel centres. Forward and backward pass get the same bits.
    #[inline(always)]
    pub(super) fn at<T: Real<Vector<S> = V>, S: Simd>(&self, simd: S, x: V, y: V) -> (V, V, V) {
        let dx = T::vsub(simd, x, self.x);
        let dy = T::vsub(simd, y, self.y);
        let p = T::mul_add(simd, self.l11, dx, T::vmul(simd, self.l21, dy));
        let q = T::vmul(simd, self.l22, dy);
        let sigma = T::mul_add(simd, p, p, T::vmul(simd, q, q));
        (p, dy, T::vmul(simd, self.opacity, T::exp_neg(simd, sigma)))
    }
}

struct BlendTile<'a, T> {
    projection: &'a Projection<T>,
    features: &'a [T],
    channels: usize,
    tile: usize,
    /// [blocks, channels] of 16 pixels.
    blended: &'a mut [[T; BLOCK]],
    transmittance: &'a mut Pixels<T>,
    last: &'a mut Pixels<T>,
    /// Of the tile's slots.
    drawn: &'a mut [u16],
    /// Reused by the tiles of a thread.
    batch: &'a mut Vec<Splat<T>>,
}

impl<T: Real> WithSimd for BlendTile<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let zero = T::splat(simd, T::ZERO);
        match self.channels {
            3 => self.run(simd, [zero; 3]),
            4 => self.run(simd, [zero; 4]),
            5 => self.run(simd, [zero; 5]),
            n => self.run(simd, vec![zero; n]),
        }
    }
}

impl<T: Real> BlendTile<'_, T> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S, mut values: impl PerChannel<T::Vector<S>>) {
        let (projection, tiles) = (self.projection, &self.projection.tiles);
        let camera = &projection.view.camera;
        let (left, top) = (
            self.tile % tiles.across * TILE,
            self.tile / tiles.across * TILE,
        );
        let [xs, ys] = centers::<T>(left, top);
        // The alpha from which a pixel is drawn; pixels outside the image are done from the start.
        let mut threshold = [[T::of(DONE); BLOCK]; BLOCKS];
        for (y, x) in (0..(camera.height - top).min(TILE))
            .flat_map(|y| (0..(camera.width - left).min(TILE)).map(move |x| (y, x)))
        {
            let (block, lane) = place(y, x);
            threshold[block][lane] = T::of(MIN_ALPHA);
        }
        let [zero, done] = [T::ZERO, T::of(DONE)].map(|v| T::splat(simd, v));
        let max_alpha = T::splat(simd, T::of(MAX_ALPHA));
        let min_transmittance = T::splat(simd, T::of(MIN_TRANSMITTANCE));
        let values = values.values();
        let channels = values.len();
        let list = &tiles.gaussians[tiles.slots_of_tile(self.tile)];
        for (k, batch_list) in list.chunks(BATCH).enumerate() {
            let live = threshold.map(|block| block.iter().any(|t| *t != T::of(DONE)));
            if !live.contains(&true) {
                break;
            }
            load_batch(projection, batch_list, self.batch);
            for (place, splat) in self.batch.iter().enumerate() {
                load_channels(simd, splat, self.features, values);
                let footprint = Footprint::new(simd, splat);
                let place = k * BATCH + place;
                let next = T::splat(simd, T::of((place + 1) as f64));
                let mut blocks = 0_u16;
                for by in blocks_under(splat.rows, top) {
                    for bx in blocks_under(splat.columns, left) {
                        let block = by * ACROSS + bx;
                        if !live[block] {
                            continue;
                        }
                        let (xs, ys) = (T::vectors::<S>(&xs[block]), T::vectors::<S>(&ys[block]));
                        let threshold = T::vectors_mut::<S>(&mut threshold[block]);
                        let transmittance = T::vectors_mut::<S>(&mut self.transmittance[block]);
                        let last = T::vectors_mut::<S>(&mut self.last[block]);
                        let blended = &mut self.blended[block * channels..][..channels];
                        for v in 0..xs.len() {
                            let (_, _, raw) = footprint.at::<T, S>(simd, xs[v], ys[v]);
                            let alpha =
                                T::select(simd, T::less(simd, raw, max_alpha), raw, max_alpha);
                            let before = transmittance[v];
                            let share = T::vmul(simd, alpha, before);
                            // Not before (1 - alpha): many equal alphas would round 1 - alpha the same way each time.
                            let after = T::vsub(simd, before, share);
                            let goes_on = T::less(simd, min_transmittance, after);
                            // Where it is not seen, nothing changes; where it is the last, the pixel is done.
                            let unseen = T::less(simd, alpha, threshold[v]);
                            let ends = T::select(simd, goes_on, threshold[v], done);
                            threshold[v] = T::select(simd, unseen, threshold[v], ends);
                            let share = T::select(simd, goes_on, share, zero);
                            let share = T::select(simd, unseen, zero, share);
                            let drawn = T::less(simd, zero, share);
                            blocks |= u16::from(T::any::<S>(simd, drawn)) << block;
                            transmittance[v] = T::select(simd, drawn, after, before);
                            last[v] = T::select(simd, drawn, next, last[v]);
                            for (sum, value) in blended.iter_mut().zip(values.iter()) {
                                let sum = &mut T::vectors_mut::<S>(sum)[v];
                                *sum = T::mul_add(simd, share, *value, *sum);
                            }
                        }
                    }
                }
                self.drawn[place] = blocks;
            }
        }
    }
}
