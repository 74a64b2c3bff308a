//! Renders from all samples of an exposure, averaged in light.

use std::ops::Range;

use host::filled;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::blocks::{BLOCK, BLOCKS};
use super::body::Body;
use super::exposure::{COLORS, Exposed, ExposedState, Exposure, Moved, Sample};
use super::geometry::{Lens, project_some};
use super::packs::Pack;
use super::project::{find_not_finite, in_depth_order, keep_visible};
use super::raster::{blend, each_line};
use super::real::Real;
use super::splat::{Extent, Splat};
use super::stills::{Still, chunks, moved_shapes, stills};
use super::transfer::Transfer;
use super::types::{SplatSlices, View};
use crate::error::SplatError;

/// So many samples lie in memory at a time where no backward pass wants them all.
const TOGETHER: usize = 8;

/// See [`super::expose`]; without samples in its state where it does not go back.
pub(super) fn expose<T: Real>(
    exposure: &Exposure<'_, T>,
    goes_back: bool,
) -> Result<Exposed<T>, SplatError> {
    let _span = tracing::trace_span!("expose").entered();
    exposure.check()?;
    let splats = exposure.resting();
    let view = exposure.middle;
    splats.check(view.sh_degree)?;
    let middle = Lens::new(view)?;
    let stills = stills(exposure, &middle)?;
    let (n, count, camera) = (exposure.num_samples(), splats.len(), &view.camera);
    let [across, down] = camera.tiles();
    let num_tiles = across * down;
    let mut picture = filled([T::ZERO; BLOCK], num_tiles * BLOCKS * COLORS);
    let mut radii = vec![0.0_f32; count];
    let arch = Arch::new();
    // In order, so that the first fault is named whatever the threads do.
    let mut looks = Vec::with_capacity(n);
    for i in 0..n {
        let moved = exposure.moved(i);
        find_not_finite("moving_means", moved.means, 3, i * moved.rows)?;
        find_not_finite("left_rotations", moved.left_rotations, 9, i * moved.rows)?;
        let view = View {
            cam_from_world: std::array::from_fn(|k| exposure.poses[12 * i + k].to_f64()),
            ..view.clone()
        };
        let lens = Lens::new(&view)?;
        looks.push((view, lens, moved));
    }
    let take = |(view, lens, moved): &(View, Lens<T>, Moved<'_, T>)| {
        let pieces: Vec<_> = stills
            .par_iter()
            .zip(chunks(count))
            .map(|(stills, rows)| {
                arch.dispatch(ProjectStills {
                    splats: &splats,
                    stills,
                    moved,
                    lens,
                    rows,
                })
            })
            .collect();
        let projection = in_depth_order(view, *lens, count, &pieces)?;
        let (blended, raster) = blend(&projection, &[], COLORS);
        Ok(Sample {
            projection,
            raster,
            blended,
        })
    };
    let mut kept = Vec::new();
    for looks in looks.chunks(if goes_back { n } else { TOGETHER }) {
        // Samples side by side: what one does on a single thread, such as sorting, the others fill.
        let samples = looks.par_iter().map(take);
        let samples: Vec<Sample<T>> = samples.collect::<Result<_, SplatError>>()?;
        for sample in &samples {
            for (largest, radius) in radii.iter_mut().zip(&sample.projection.radii) {
                *largest = largest.max(*radius);
            }
        }
        picture
            .par_chunks_mut(BLOCKS * COLORS)
            .enumerate()
            .for_each(|(tile, sum)| {
                let tile = tile * BLOCKS * COLORS..(tile + 1) * BLOCKS * COLORS;
                for sample in &samples {
                    arch.dispatch(AddLight {
                        transfer: exposure.transfer,
                        weight: T::of(1.0 / n as f64),
                        blended: &sample.blended[tile.clone()],
                        sum,
                    });
                }
            });
        if goes_back {
            kept = samples;
        }
    }
    picture
        .par_chunks_mut(BLOCKS * COLORS)
        .for_each(|light| arch.dispatch(Encode(exposure.transfer, light)));
    let mut color = filled(T::ZERO, camera.num_pixels() * COLORS);
    each_line(&mut color, camera, COLORS, |tile, block, lane, pixel| {
        let from = &picture[(tile * BLOCKS + block) * COLORS..][..COLORS];
        for (value, from) in pixel.iter_mut().zip(from) {
            *value = from[lane];
        }
    });
    Ok(Exposed {
        color,
        radii,
        state: ExposedState {
            samples: kept,
            picture,
        },
    })
}

struct ProjectStills<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    stills: &'a [Still<T>],
    moved: &'a Moved<'a, T>,
    lens: &'a Lens<T>,
    rows: Range<usize>,
}

impl<T: Real> WithSimd for ProjectStills<'_, T> {
    type Output = Vec<(Splat<T>, Extent<T>)>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let mut visible = Vec::with_capacity(self.rows.len());
        let lanes = T::lanes::<S>();
        for (still, first) in self.stills.iter().zip(self.rows.clone().step_by(lanes)) {
            let rows = first..(first + lanes).min(self.rows.end);
            let placed = match moved_shapes(simd, self.splats, self.moved, &rows) {
                Some(shapes) => Body::new(simd, &shapes).placed,
                None => still.placed(simd),
            };
            let g = project_some(simd, self.lens, &placed);
            keep_visible(
                self.lens,
                &rows,
                &g,
                still.alpha(simd),
                #[inline(always)]
                |l| [still.color[0][l], still.color[1][l], still.color[2][l]],
                &mut visible,
            );
        }
        visible
    }
}

/// Adds the light of a tile's colours to a sum.
struct AddLight<'a, T> {
    transfer: Transfer,
    weight: T,
    blended: &'a [[T; BLOCK]],
    sum: &'a mut [[T; BLOCK]],
}

impl<T: Real> WithSimd for AddLight<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let weight = Pack::splat(simd, self.weight);
        for (sum, blended) in self.sum.iter_mut().zip(self.blended) {
            let blended = T::vectors::<S>(blended);
            for (sum, value) in T::vectors_mut::<S>(sum).iter_mut().zip(blended) {
                let [light, _] = self.transfer.decode(Pack::<T, S>::new(simd, *value));
                *sum = (Pack::<T, S>::new(simd, *sum) + weight * light).values();
            }
        }
    }
}

/// Turns a tile's light into values of the picture.
struct Encode<'a, T>(Transfer, &'a mut [[T; BLOCK]]);

impl<T: Real> WithSimd for Encode<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for light in self.1 {
            for light in T::vectors_mut::<S>(light) {
                *light = self.0.encode(Pack::<T, S>::new(simd, *light)).values();
            }
        }
    }
}
