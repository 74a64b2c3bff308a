//! Backward of the projection: sums each Gaussian's partial gradients over its tiles and carries
//! them on to the inputs.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::body::{Body, Shapes, column, quaternion_gradient};
use super::color_backward::{Coloring, center_gradient, color_gradient};
use super::geometry::{Lens, project_some};
use super::gradients::{BackwardOptions, Gradients};
use super::matrices::{mul_transpose3, transpose_mul3};
use super::packs::{Pack, array};
use super::pieces::{Piece, RowGradient, drawn, no_gradients, pieces, put_columns};
use super::project::Projection;
use super::raster_backward::{GEOMETRIC, slot_sums};
use super::real::Real;
use super::types::SplatSlices;
use super::world_backward::{logit_gradient, to_world};

/// Without a branch per value, so that it runs at memory speed.
#[inline(always)]
pub(super) fn all_finite<T: Real>(values: &[T]) -> bool {
    values.iter().fold(true, |ok, v| ok & v.is_finite())
}

/// Gradients of all inputs from the partial gradients of all slots.
///
/// With `drop_overflow`, a Gaussian whose gradient is larger than `T` can hold gets none, and neither does the pose.
pub(super) fn project_backward<T: Real>(
    splats: &SplatSlices<'_, T>,
    projection: &Projection<T>,
    num_features: usize,
    partial: &[T],
    options: BackwardOptions,
    drop_overflow: bool,
) -> Gradients<T> {
    let _span = tracing::trace_span!("project backward").entered();
    let mut out = no_gradients(splats, num_features);
    let pieces = pieces(&mut out, projection.count);
    let job = Job {
        splats,
        projection,
        lens: &projection.lens,
        num_features,
        partial,
        options,
        drop_overflow,
    };
    let arch = Arch::new();
    let poses: Vec<[T; 12]> = pieces
        .into_par_iter()
        .map(|piece| arch.dispatch(RunPiece { job: &job, piece }))
        .collect();
    let pose = tree_sum(&poses);
    if !drop_overflow || all_finite(&pose) {
        out.cam_from_world = pose;
    }
    out
}

/// Sum by halves: a fixed order and an error that grows with the logarithm of the count.
pub(super) fn tree_sum<T: Real>(values: &[[T; 12]]) -> [T; 12] {
    match values {
        [] => [T::ZERO; 12],
        [one] => *one,
        many => {
            let (a, b) = many.split_at(many.len() / 2);
            let (a, b) = (tree_sum(a), tree_sum(b));
            std::array::from_fn(|k| a[k] + b[k])
        }
    }
}

struct Job<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    projection: &'a Projection<T>,
    lens: &'a Lens<T>,
    num_features: usize,
    partial: &'a [T],
    options: BackwardOptions,
    drop_overflow: bool,
}

struct RunPiece<'a, 'b, T> {
    job: &'a Job<'a, T>,
    piece: Piece<'b, T>,
}

impl<T: Real> WithSimd for RunPiece<'_, '_, T> {
    type Output = [T; 12];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> [T; 12] {
        self.job.run(simd, self.piece)
    }
}

impl<T: Real> Job<'_, T> {
    #[inline(always)]
    fn run<S: Simd>(&self, simd: S, mut piece: Piece<'_, T>) -> [T; 12] {
        let width = GEOMETRIC + 4 + self.num_features;
        let ranks = &self.projection.rank[piece.first..piece.first + piece.screen.len()];
        let sums = slot_sums(&self.projection.tiles, self.partial, width, ranks);
        let mut pose = [Pack::splat(simd, T::ZERO); 12];
        let lanes = T::lanes::<S>();
        for (block, ranks) in ranks.chunks(lanes).enumerate() {
            if ranks.iter().any(|rank| *rank != u32::MAX) {
                self.rows(simd, block * lanes, ranks, &sums, &mut piece, &mut pose);
            }
        }
        std::array::from_fn(|k| pose[k].sum())
    }

    /// As many Gaussians as a vector has, or fewer.
    #[inline(always)]
    fn rows<S: Simd>(
        &self,
        simd: S,
        local: usize,
        ranks: &[u32],
        sums: &[T],
        piece: &mut Piece<'_, T>,
        pose_sum: &mut [Pack<T, S>; 12],
    ) {
        let pose = &self.lens.pose;
        let rows = piece.first + local..piece.first + local + ranks.len();
        let zero = Pack::splat(simd, T::ZERO);
        let shapes = Shapes::new(simd, self.splats, &rows);
        let body = Body::new(simd, &shapes);
        let g = project_some(simd, self.lens, &body.placed);
        let width = GEOMETRIC + 4 + self.num_features;
        let own = local..local + ranks.len();
        let sum_of = |k| column(simd, sums, width, &own, k);
        let geometric = array(sum_of);
        let v_depth = sum_of(GEOMETRIC + 3);
        let v_world = to_world(
            self.lens,
            &g,
            &body.placed,
            (geometric, v_depth),
            self.options.pose,
        );
        let (v_left, v_matrix) = match &shapes.left {
            Some(left) => (
                Some(mul_transpose3(&v_world.rotation, &body.quat_matrix)),
                transpose_mul3(left, &v_world.rotation),
            ),
            None => (None, v_world.rotation),
        };
        let v_color: [_; 3] = array(
            #[inline(always)]
            |k| sum_of(GEOMETRIC + k),
        );
        let coloring = Coloring {
            splats: self.splats,
            sh_degree: self.projection.view.sh_degree,
            pose,
        };
        let colors = color_gradient(simd, &coloring, &rows, shapes.mean, v_color);
        let logits = column(simd, self.splats.opacity_logits, 1, &rows, 0);
        let (mut v_mean, mut v_pose) = (v_world.mean, v_world.pose);
        if self.options.view_direction {
            for j in 0..3 {
                v_mean[j] += colors.v_direction[j];
            }
            if self.options.pose {
                center_gradient(pose, &colors.v_direction, &mut v_pose);
            }
        }
        let gradient = RowGradient {
            mean: v_mean,
            quat: quaternion_gradient(&body, &v_matrix),
            log_scale: v_world.log_scale,
            logit: logit_gradient(geometric[5], logits),
            screen: v_world.screen,
            colors,
        };

        // One that overflows leaves the sum of magnitudes infinite or not a number, and gets no gradient.
        let mut kept = drawn(simd, ranks);
        if self.drop_overflow {
            let mut total = gradient.magnitude();
            for value in v_pose.iter().chain(v_left.iter().flatten()) {
                total += value.abs();
            }
            kept = kept.and(total.is_finite());
            for k in 4..4 + self.num_features {
                kept = kept.and(sum_of(GEOMETRIC + k).is_finite());
            }
        }
        for (sum, v) in pose_sum.iter_mut().zip(v_pose) {
            *sum += kept.select(v, zero);
        }
        let kept = kept.to_array();
        let kept = &kept[..ranks.len()];
        piece.put(local, kept, &gradient, self.projection.view.sh_degree);
        if let Some(v_left) = &v_left {
            let with_left = kept.len().min(piece.left_rotations.len() / 9 - local);
            put_columns(piece.left_rotations, local, &kept[..with_left], v_left);
        }
        let f = self.num_features;
        for l in (0..kept.len()).filter(|l| kept[*l]) {
            let row = local + l;
            let features = &sums[row * width + GEOMETRIC + 4..][..f];
            piece.features[row * f..][..f].copy_from_slice(features);
        }
    }
}
