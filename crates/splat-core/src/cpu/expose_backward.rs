//! Backward of an exposure: back through every sample, and once through what the samples share.

use std::ops::Range;

use host::filled;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::blocks::{BLOCK, BLOCKS, place};
use super::body::{Body, Shapes, column, quaternion_gradient};
use super::color_backward::{Coloring, center_gradient, color_gradient};
use super::constants::TILE;
use super::exposure::{COLORS, ExposedState, Exposure, ExposureGradients, Moved, Sample};
use super::geometry::{Lens, project_some};
use super::matrices::{mul_transpose3, transpose_mul3};
use super::packs::{Number as _, Pack, WIDEST, array, packs};
use super::pieces::{Piece, RowGradient, drawn, no_gradients, pieces, put_columns};
use super::project::CHUNK;
use super::project_backward::{all_finite, tree_sum};
use super::raster_backward::{GEOMETRIC, partial_gradients, slot_sums};
use super::real::Real;
use super::stills::{Still, moved_shapes, stills};
use super::transfer::Transfer;
use super::types::SplatSlices;
use super::world_backward::{logit_gradient, to_world};
use crate::error::SplatError;

/// Sums of a partial gradient.
const WIDTH: usize = GEOMETRIC + COLORS;

/// Gradients of as many Gaussians as a vector has, summed over the samples.
#[derive(Clone)]
struct Totals<T> {
    mean: [[T; WIDEST]; 3],
    /// Of the quaternions' matrices.
    matrix: [[T; WIDEST]; 9],
    log_scale: [[T; WIDEST]; 3],
    color: [[T; WIDEST]; 3],
    /// Σ s, which becomes the logits', and the statistic of density control.
    others: [[T; WIDEST]; 2],
}

impl<T: Real> Totals<T> {
    fn zero() -> Self {
        let none = [T::ZERO; WIDEST];
        Self {
            mean: [none; 3],
            matrix: [none; 9],
            log_scale: [none; 3],
            color: [none; 3],
            others: [none; 2],
        }
    }
}

/// See [`super::expose_backward`].
pub(super) fn expose_backward<T: Real>(
    exposure: &Exposure<'_, T>,
    state: &ExposedState<T>,
    v_color: &[T],
    wants_poses: bool,
) -> Result<ExposureGradients<T>, SplatError> {
    let _span = tracing::trace_span!("expose backward").entered();
    exposure.check()?;
    let splats = exposure.resting();
    let view = exposure.middle;
    splats.check(view.sh_degree)?;
    let (n, count) = (exposure.num_samples(), splats.len());
    let camera = &view.camera;
    for (tensor, found, expected) in [
        ("poses", n, vec![state.samples.len()]),
        (
            "gradient of the picture",
            v_color.len(),
            vec![camera.height, camera.width, COLORS],
        ),
    ] {
        if found != expected.iter().product::<usize>() {
            return Err(SplatError::Shape {
                tensor,
                found: vec![found],
                expected: format!("{expected:?}"),
            });
        }
    }
    let drop_overflow = all_finite(v_color);
    let middle = Lens::new(view)?;
    let stills = stills(exposure, &middle)?;
    let v_light = light_gradient(exposure, state, v_color);
    let mut totals: Vec<Vec<Totals<T>>> = stills
        .iter()
        .map(|stills| vec![Totals::zero(); stills.len()])
        .collect();
    let rows = exposure.num_moving();
    let mut out = ExposureGradients {
        middle: no_gradients(&splats, 0),
        poses: filled(T::ZERO, exposure.poses.len()),
        moving_means: filled(T::ZERO, exposure.moving_means.len()),
        left_rotations: filled(T::ZERO, exposure.left_rotations.len()),
    };
    let arch = Arch::new();
    for (i, sample) in state.samples.iter().enumerate() {
        let partial = sample_partials(exposure.transfer, sample, &v_light);
        let moved = exposure.moved(i);
        let back = BackThrough {
            splats: &splats,
            sample,
            partial: &partial,
            moved: &moved,
            wants_poses,
            drop_overflow,
        };
        let v_means = &mut out.moving_means[3 * rows * i..3 * rows * (i + 1)];
        let v_left = &mut out.left_rotations[9 * rows * i..9 * rows * (i + 1)];
        let mut v_means = v_means.chunks_mut(3 * CHUNK);
        let mut v_left = v_left.chunks_mut(9 * CHUNK);
        let work: Vec<_> = totals
            .iter_mut()
            .zip(&stills)
            .enumerate()
            .map(|(chunk, (totals, stills))| ChunkOf {
                rows: chunk * CHUNK..((chunk + 1) * CHUNK).min(count),
                stills,
                totals,
                v_means: v_means.next().unwrap_or_default(),
                v_left: v_left.next().unwrap_or_default(),
            })
            .collect();
        let poses: Vec<[T; 12]> = work
            .into_par_iter()
            .map(|chunk| arch.dispatch(RunChunk { back: &back, chunk }))
            .collect();
        let pose = tree_sum(&poses);
        if !drop_overflow || all_finite(&pose) {
            out.poses[12 * i..12 * (i + 1)].copy_from_slice(&pose);
        }
    }
    let finish = Finish {
        splats: &splats,
        sh_degree: view.sh_degree,
        pose: &middle.pose,
        drop_overflow,
    };
    let poses: Vec<[T; 12]> = pieces(&mut out.middle, count)
        .into_par_iter()
        .zip(&totals)
        .map(|(piece, totals)| {
            arch.dispatch(RunFinish {
                finish: &finish,
                piece,
                totals,
            })
        })
        .collect();
    let pose = tree_sum(&poses);
    if !drop_overflow || all_finite(&pose) {
        out.middle.cam_from_world = pose;
    }
    Ok(out)
}

/// The gradient of each sample's light, [tiles, blocks, 3] of 16 pixels, from that of the picture.
fn light_gradient<T: Real>(
    exposure: &Exposure<'_, T>,
    state: &ExposedState<T>,
    v_color: &[T],
) -> Vec<[T; BLOCK]> {
    let camera = &exposure.middle.camera;
    let across = camera.width.div_ceil(TILE);
    let mut v_light = filled([T::ZERO; BLOCK], state.picture.len());
    let arch = Arch::new();
    v_light
        .par_chunks_mut(BLOCKS * COLORS)
        .zip(state.picture.par_chunks(BLOCKS * COLORS))
        .enumerate()
        .for_each(|(tile, (v_light, picture))| {
            let (left, top) = (tile % across * TILE, tile / across * TILE);
            for y in 0..(camera.height - top).min(TILE) {
                for x in 0..(camera.width - left).min(TILE) {
                    let (block, lane) = place(y, x);
                    let pixel = ((top + y) * camera.width + left + x) * COLORS;
                    for k in 0..COLORS {
                        v_light[block * COLORS + k][lane] = v_color[pixel + k];
                    }
                }
            }
            arch.dispatch(DivideBySlope {
                transfer: exposure.transfer,
                weight: T::of(1.0 / exposure.num_samples() as f64),
                picture,
                v_light,
            });
        });
    v_light
}

struct DivideBySlope<'a, T> {
    transfer: Transfer,
    weight: T,
    picture: &'a [[T; BLOCK]],
    v_light: &'a mut [[T; BLOCK]],
}

impl<T: Real> WithSimd for DivideBySlope<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let weight = Pack::splat(simd, self.weight);
        for (v_light, picture) in self.v_light.iter_mut().zip(self.picture) {
            let picture = T::vectors::<S>(picture);
            for (v_light, value) in T::vectors_mut::<S>(v_light).iter_mut().zip(picture) {
                let [_, slope] = self.transfer.decode(Pack::<T, S>::new(simd, *value));
                *v_light = (Pack::<T, S>::new(simd, *v_light) * weight / slope).values();
            }
        }
    }
}

/// The partial gradients of a sample's slots, [slots, 9].
fn sample_partials<T: Real>(
    transfer: Transfer,
    sample: &Sample<T>,
    v_light: &[[T; BLOCK]],
) -> Vec<T> {
    let arch = Arch::new();
    partial_gradients(&sample.projection, &[], &sample.raster, |tile, v_tile| {
        let tile = tile * BLOCKS * COLORS..(tile + 1) * BLOCKS * COLORS;
        arch.dispatch(TimesSlope {
            transfer,
            blended: &sample.blended[tile.clone()],
            v_light: &v_light[tile],
            v_tile,
        });
    })
}

struct TimesSlope<'a, T> {
    transfer: Transfer,
    blended: &'a [[T; BLOCK]],
    v_light: &'a [[T; BLOCK]],
    /// Alpha first, which has none.
    v_tile: &'a mut [[T; BLOCK]],
}

impl<T: Real> WithSimd for TimesSlope<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for block in 0..BLOCKS {
            for k in 0..COLORS {
                let from = block * COLORS + k;
                let blended = T::vectors::<S>(&self.blended[from]);
                let v_light = T::vectors::<S>(&self.v_light[from]);
                let to = T::vectors_mut::<S>(&mut self.v_tile[block * (COLORS + 1) + 1 + k]);
                for (to, (value, v_light)) in to.iter_mut().zip(blended.iter().zip(v_light)) {
                    let [_, slope] = self.transfer.decode(Pack::<T, S>::new(simd, *value));
                    *to = (Pack::<T, S>::new(simd, *v_light) * slope).values();
                }
            }
        }
    }
}

/// Back through one sample.
struct BackThrough<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    sample: &'a Sample<T>,
    partial: &'a [T],
    moved: &'a Moved<'a, T>,
    wants_poses: bool,
    drop_overflow: bool,
}

/// Some Gaussians, and where their gradients go.
struct ChunkOf<'a, T> {
    rows: Range<usize>,
    stills: &'a [Still<T>],
    totals: &'a mut [Totals<T>],
    /// Of those that move: [.., 3] and [.., 3, 3].
    v_means: &'a mut [T],
    v_left: &'a mut [T],
}

struct RunChunk<'a, 'b, T> {
    back: &'a BackThrough<'a, T>,
    chunk: ChunkOf<'b, T>,
}

impl<T: Real> WithSimd for RunChunk<'_, '_, T> {
    type Output = [T; 12];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> [T; 12] {
        let Self { back, mut chunk } = self;
        let projection = &back.sample.projection;
        let ranks = &projection.rank[chunk.rows.clone()];
        let sums = slot_sums(&projection.tiles, back.partial, WIDTH, ranks);
        let mut pose = [Pack::splat(simd, T::ZERO); 12];
        for (block, ranks) in ranks.chunks(T::lanes::<S>()).enumerate() {
            if ranks.iter().any(|rank| *rank != u32::MAX) {
                back.block(simd, block, ranks, &sums, &mut chunk, &mut pose);
            }
        }
        std::array::from_fn(|k| pose[k].sum())
    }
}

impl<T: Real> BackThrough<'_, T> {
    /// As many Gaussians as a vector has, or fewer.
    #[inline(always)]
    fn block<S: Simd>(
        &self,
        simd: S,
        block: usize,
        ranks: &[u32],
        sums: &[T],
        chunk: &mut ChunkOf<'_, T>,
        pose_sum: &mut [Pack<T, S>; 12],
    ) {
        let local = block * T::lanes::<S>();
        let own = local..local + ranks.len();
        let rows = chunk.rows.start + own.start..chunk.rows.start + own.end;
        let zero = Pack::splat(simd, T::ZERO);
        let moving = moved_shapes(simd, self.splats, self.moved, &rows)
            .map(|shapes| (Body::new(simd, &shapes), shapes));
        let placed = match &moving {
            Some((body, _)) => body.placed,
            None => chunk.stills[block].placed(simd),
        };
        let lens = &self.sample.projection.lens;
        let g = project_some(simd, lens, &placed);
        let sum_of = |k| column(simd, sums, WIDTH, &own, k);
        let geometric = array(sum_of);
        let v_color: [_; COLORS] = array(
            #[inline(always)]
            |k| sum_of(GEOMETRIC + k),
        );
        let v_world = to_world(lens, &g, &placed, (geometric, zero), self.wants_poses);
        let (v_left, v_matrix) = match &moving {
            Some((body, shapes)) => {
                let left = shapes
                    .left
                    .as_ref()
                    .expect("what moves has a left rotation");
                (
                    Some(mul_transpose3(&v_world.rotation, &body.quat_matrix)),
                    transpose_mul3(left, &v_world.rotation),
                )
            }
            None => (None, v_world.rotation),
        };
        let s = geometric[5];

        // A sample in which a Gaussian's gradient overflows gives it none.
        let mut kept = drawn(simd, ranks);
        if self.drop_overflow {
            let mut total = s.abs() + v_world.screen.abs();
            for values in [
                &v_world.mean[..],
                &v_matrix,
                &v_world.log_scale,
                &v_color,
                &v_world.pose,
                v_left.as_ref().map_or(&[], |left| left),
            ] {
                for value in values {
                    total += value.abs();
                }
            }
            kept = kept.and(total.is_finite());
        }
        for (sum, v) in pose_sum.iter_mut().zip(kept.only(v_world.pose)) {
            *sum += v;
        }
        let totals = &mut chunk.totals[block];
        let mut v_mean = kept.only(v_world.mean);
        if let Some(v_left) = &v_left {
            // Their means in this sample are an input by themselves.
            let count = ranks.len().min(self.moved.rows - rows.start);
            let moving = &kept.to_array()[..count];
            put_columns(chunk.v_means, local, moving, &v_mean);
            put_columns(chunk.v_left, local, moving, v_left);
            let rests = Pack::from_fn(
                simd,
                #[inline(always)]
                |l| if l < count { T::ZERO } else { T::ONE },
            );
            v_mean = zero.less(rests).only(v_mean);
        }
        add(&mut totals.mean, v_mean);
        add(&mut totals.matrix, kept.only(v_matrix));
        add(&mut totals.log_scale, kept.only(v_world.log_scale));
        add(&mut totals.color, kept.only(v_color));
        add(&mut totals.others, kept.only([s, v_world.screen]));
    }
}

/// Adds a vector to each total.
#[inline(always)]
fn add<T: Real, S: Simd, const C: usize>(totals: &mut [[T; WIDEST]; C], values: [Pack<T, S>; C]) {
    for (total, value) in totals.iter_mut().zip(values) {
        value.add_to(total);
    }
}

/// Back through what the samples share.
struct Finish<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    sh_degree: usize,
    /// Of the middle of the exposure.
    pose: &'a [T; 12],
    drop_overflow: bool,
}

struct RunFinish<'a, 'b, T> {
    finish: &'a Finish<'a, T>,
    piece: Piece<'b, T>,
    totals: &'a [Totals<T>],
}

impl<T: Real> WithSimd for RunFinish<'_, '_, T> {
    type Output = [T; 12];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> [T; 12] {
        let Self {
            finish,
            mut piece,
            totals,
        } = self;
        let mut pose = [Pack::splat(simd, T::ZERO); 12];
        for (block, totals) in totals.iter().enumerate() {
            let first = block * T::lanes::<S>();
            finish.block(simd, first, totals, &mut piece, &mut pose);
        }
        std::array::from_fn(|k| pose[k].sum())
    }
}

impl<T: Real> Finish<'_, T> {
    #[inline(always)]
    fn block<S: Simd>(
        &self,
        simd: S,
        local: usize,
        totals: &Totals<T>,
        piece: &mut Piece<'_, T>,
        pose_sum: &mut [Pack<T, S>; 12],
    ) {
        let count = T::lanes::<S>().min(piece.screen.len() - local);
        let rows = piece.first + local..piece.first + local + count;
        let shapes = Shapes::new(simd, self.splats, &rows);
        let body = Body::new(simd, &shapes);
        let zero = Pack::splat(simd, T::ZERO);
        let coloring = Coloring {
            splats: self.splats,
            sh_degree: self.sh_degree,
            pose: self.pose,
        };
        let v_color = packs(simd, &totals.color);
        let colors = color_gradient(simd, &coloring, &rows, shapes.mean, v_color);
        let logits = column(simd, self.splats.opacity_logits, 1, &rows, 0);
        let mut v_pose = [zero; 12];
        center_gradient(self.pose, &colors.v_direction, &mut v_pose);
        let v_mean = packs(simd, &totals.mean);
        let [s, screen] = packs(simd, &totals.others);
        let gradient = RowGradient {
            mean: array(
                #[inline(always)]
                |k| v_mean[k] + colors.v_direction[k],
            ),
            quat: quaternion_gradient(&body, &packs(simd, &totals.matrix)),
            log_scale: packs(simd, &totals.log_scale),
            logit: logit_gradient(s, logits),
            screen,
            colors,
        };
        let mut kept = zero.less(zero.like(1.0));
        if self.drop_overflow {
            let mut total = gradient.magnitude();
            for value in v_pose {
                total += value.abs();
            }
            kept = total.is_finite();
        }
        let is_kept = kept.to_array();
        // Lanes past the last Gaussian repeat it, with totals of zero.
        for (sum, v) in pose_sum.iter_mut().zip(kept.only(v_pose)) {
            *sum += v;
        }
        piece.put(local, &is_kept[..count], &gradient, self.sh_degree);
    }
}
