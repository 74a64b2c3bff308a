//! Backward of the projection: sums each Gaussian's partial gradients over its tiles and carries
//! them on to the inputs.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use host::filled;

use super::geometry::{
    Geometry, Lens, Shapes, column, mul_transpose3, pose_rotation, project_some,
    quaternion_gradient, transpose_mul3, view_directions,
};
use super::gradients::{BackwardOptions, Gradients};
use super::packs::{Number, Pack, WIDEST, array, arrays};
use super::project::{CHUNK, Projection, sh_color, sigmoid};
use super::raster_backward::GEOMETRIC;
use super::real::Real;
use super::sh;
use super::types::SplatSlices;

/// The output rows of one piece of work.
struct Piece<'a, T> {
    first: usize,
    means: &'a mut [T],
    quats: &'a mut [T],
    left_rotations: &'a mut [T],
    log_scales: &'a mut [T],
    opacity_logits: &'a mut [T],
    sh: &'a mut [T],
    features: &'a mut [T],
    screen: &'a mut [T],
}

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
    let n = projection.count;
    let sh_width = 3 * splats.sh_coefficients();
    let zeros = |len: usize| filled(T::ZERO, len);
    let mut out = Gradients {
        means: zeros(3 * n),
        quats: zeros(4 * n),
        left_rotations: zeros(splats.left_rotations.len()),
        log_scales: zeros(3 * n),
        opacity_logits: zeros(n),
        sh: zeros(n * sh_width),
        features: zeros(n * num_features),
        cam_from_world: [T::ZERO; 12],
        screen: zeros(n),
    };
    let mut left = out.left_rotations.chunks_mut(9 * CHUNK);
    let mut features = out.features.chunks_mut((num_features * CHUNK).max(1));
    let mut pieces = Vec::with_capacity(n.div_ceil(CHUNK));
    let dense = out
        .means
        .chunks_mut(3 * CHUNK)
        .zip(out.quats.chunks_mut(4 * CHUNK))
        .zip(out.log_scales.chunks_mut(3 * CHUNK))
        .zip(out.opacity_logits.chunks_mut(CHUNK))
        .zip(out.sh.chunks_mut((sh_width * CHUNK).max(1)))
        .zip(out.screen.chunks_mut(CHUNK));
    for (k, (((((means, quats), log_scales), opacity_logits), sh), screen)) in dense.enumerate() {
        pieces.push(Piece {
            first: k * CHUNK,
            means,
            quats,
            left_rotations: left.next().unwrap_or_default(),
            log_scales,
            opacity_logits,
            sh,
            features: features.next().unwrap_or_default(),
            screen,
        });
    }
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
fn tree_sum<T: Real>(values: &[[T; 12]]) -> [T; 12] {
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

/// Gradients of Gaussians' ellipses, means in pixels.
struct EllipseGradient<V> {
    mean2d: [V; 2],
    e: V,
    /// Gradient of rho divided by yy.
    rho_over_yy: V,
    yy: V,
    depth: V,
}

/// What comes out of [`ellipse`].
struct ShapeGradient<V> {
    log_scale: [V; 3],
    /// Of the mean in camera space.
    point: [V; 3],
    /// Of R_pose * rotation.
    in_cam: [V; 9],
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
        // All sums of the piece first, in a tight loop: the cache misses on the partial gradients,
        // which lie in the order of tiles, then overlap.
        let mut sums = vec![T::ZERO; width * piece.screen.len()];
        let ranks = &self.projection.rank[piece.first..piece.first + piece.screen.len()];
        for (rank, sums) in ranks.iter().zip(sums.chunks_exact_mut(width)) {
            if *rank != u32::MAX {
                for slot in self.projection.tiles.slots_of_gaussian(*rank as usize) {
                    let partial = &self.partial[*slot as usize * width..][..width];
                    for (sum, value) in sums.iter_mut().zip(partial) {
                        *sum += *value;
                    }
                }
            }
        }
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
        let view = &self.projection.view;
        let pose = &self.lens.pose;
        let rows = piece.first + local..piece.first + local + ranks.len();
        let zero = Pack::splat(simd, T::ZERO);
        let n = |value| zero.like(value);
        let shapes = Shapes::new(simd, self.splats, &rows);
        let g = project_some(simd, self.lens, &shapes);
        let width = GEOMETRIC + 4 + self.num_features;
        let own = local..local + ranks.len();
        let sum_of = |k| column(simd, sums, width, &own, k);
        let [sp, spp, sp_dy, s_dy, s_dy_dy, s] = array(sum_of);
        let v_ellipse = EllipseGradient {
            mean2d: [
                -n(2.0) * g.l11 * sp,
                -n(2.0) * (g.l21 * sp + g.l22 * g.l22 * s_dy),
            ],
            e: -spp / g.e,
            rho_over_yy: -n(2.0) * g.l11 * sp_dy / g.yy,
            yy: -n(0.5) * s_dy_dy / (g.yy * g.yy),
            depth: sum_of(GEOMETRIC + 3),
        };
        // s sums -∂L/∂alpha · alpha, and ∂alpha/∂logit = alpha (1 - opacity).
        let logits = column(simd, self.splats.opacity_logits, 1, &rows, 0);
        let v_logit = -s * (-logits).map(sigmoid);
        let [across, down] = self.lens.size;
        let screen = norm2([
            v_ellipse.mean2d[0] * n(0.5) * n(across as f64),
            v_ellipse.mean2d[1] * n(0.5) * n(down as f64),
        ]);

        let v_color: [_; 3] = array(
            #[inline(always)]
            |k| sum_of(GEOMETRIC + k),
        );
        let colors = self.colors(simd, &rows, shapes.mean, v_color);
        let v_shape = ellipse(self.lens, &g, &v_ellipse);
        let splat = |value| Pack::splat(simd, value);
        let in_pose = pose_rotation(pose);
        let rotation: [_; 9] = array(
            #[inline(always)]
            |k| splat(in_pose[k]),
        );
        let v_point = v_shape.point;
        let mut v_mean: [_; 3] = array(
            #[inline(always)]
            |j| {
                rotation[j] * v_point[0]
                    + rotation[3 + j] * v_point[1]
                    + rotation[6 + j] * v_point[2]
            },
        );
        let mut v_pose = [zero; 12];
        if self.options.pose {
            let v_rotation = mul_transpose3(&v_shape.in_cam, &g.rotation);
            for i in 0..3 {
                for j in 0..3 {
                    v_pose[4 * i + j] = v_rotation[3 * i + j] + v_point[i] * shapes.mean[j];
                }
                v_pose[4 * i + 3] = v_point[i];
            }
        }
        if self.options.view_direction {
            for j in 0..3 {
                v_mean[j] += colors.v_direction[j];
            }
            if self.options.pose {
                // centre = -Rᵀ t, and the direction is mean - centre: v_centre = -v_direction.
                for i in 0..3 {
                    for j in 0..3 {
                        v_pose[4 * i + j] += splat(pose[4 * i + 3]) * colors.v_direction[j];
                        v_pose[4 * i + 3] += splat(pose[4 * i + j]) * colors.v_direction[j];
                    }
                }
            }
        }
        let v_rotation = transpose_mul3(&rotation, &v_shape.in_cam);
        let (v_left, v_matrix) = match &shapes.left {
            Some(left) => (
                Some(mul_transpose3(&v_rotation, &g.quat_matrix)),
                transpose_mul3(left, &v_rotation),
            ),
            None => (None, v_rotation),
        };
        let v_quat = quaternion_gradient(&g, &v_matrix);

        // One that overflows leaves the sum of magnitudes infinite or not a number, and gets no gradient.
        let drawn = Pack::from_fn(
            simd,
            #[inline(always)]
            |l| {
                let is_drawn = ranks.get(l).is_some_and(|rank| *rank != u32::MAX);
                if is_drawn { T::ONE } else { T::ZERO }
            },
        );
        let mut kept = zero.less(drawn);
        if self.drop_overflow {
            let mut total = v_logit.abs() + screen.abs();
            for values in [
                &v_mean[..],
                &v_quat,
                &v_shape.log_scale,
                &v_pose,
                v_left.as_ref().map_or(&[], |left| left),
            ] {
                for value in values {
                    total += value.abs();
                }
            }
            for value in colors.v_color {
                // A basis function of SH is under 4.
                total += value.abs() * n(4.0);
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
        write(piece.means, 3, local, ranks.len(), &kept, &v_mean);
        write(piece.quats, 4, local, ranks.len(), &kept, &v_quat);
        write(
            piece.log_scales,
            3,
            local,
            ranks.len(),
            &kept,
            &v_shape.log_scale,
        );
        write(
            piece.opacity_logits,
            1,
            local,
            ranks.len(),
            &kept,
            &[v_logit],
        );
        write(piece.screen, 1, local, ranks.len(), &kept, &[screen]);
        if let Some(v_left) = &v_left {
            let count = ranks.len().min(piece.left_rotations.len() / 9 - local);
            write(piece.left_rotations, 9, local, count, &kept, v_left);
        }
        let v_color = arrays(colors.v_color);
        let (f, stored) = (self.num_features, 3 * self.splats.sh_coefficients());
        let used = sh::num_coefficients(view.sh_degree);
        for l in (0..ranks.len()).filter(|l| kept[*l]) {
            let row = local + l;
            let features = &sums[row * width + GEOMETRIC + 4..][..f];
            piece.features[row * f..][..f].copy_from_slice(features);
            let out = piece.sh[row * stored..][..3 * used].as_chunks_mut::<3>().0;
            for (out, basis) in out.iter_mut().zip(&colors.basis) {
                *out = array(
                    #[inline(always)]
                    |k| basis[l] * v_color[k][l],
                );
            }
        }
    }

    /// Gradients of the colours' way through SH.
    #[inline(always)]
    fn colors<S: Simd>(
        &self,
        simd: S,
        rows: &Range<usize>,
        mean: [Pack<T, S>; 3],
        v_color: [Pack<T, S>; 3],
    ) -> ColorGradient<T, S> {
        let view = &self.projection.view;
        let (used, all) = (
            sh::num_coefficients(view.sh_degree),
            self.splats.sh_coefficients(),
        );
        let (direction, length) = view_directions(&self.lens.pose, mean);
        let basis = arrays(sh::basis(view.sh_degree, direction));
        let mut passed = arrays(v_color);
        let mut weights = [[T::ZERO; WIDEST]; 16];
        for (l, row) in rows.clone().enumerate() {
            let stored = &self.splats.sh[row * all * 3..][..used * 3];
            let color = sh_color(stored, &basis, l);
            // Where a colour was clamped at zero, nothing passes.
            let v: [T; 3] = array(
                #[inline(always)]
                |k| {
                    if color[k] > T::ZERO {
                        passed[k][l]
                    } else {
                        T::ZERO
                    }
                },
            );
            for k in 0..3 {
                passed[k][l] = v[k];
            }
            for (weight, c) in weights.iter_mut().zip(stored.chunks_exact(3)) {
                weight[l] = c[0] * v[0] + c[1] * v[1] + c[2] * v[2];
            }
        }
        let weights = array(
            #[inline(always)]
            |b| Pack::load(simd, &weights[b]),
        );
        let v_unit = sh::direction_gradient(view.sh_degree, direction, &weights);
        let along = v_unit[0] * direction[0] + v_unit[1] * direction[1] + v_unit[2] * direction[2];
        ColorGradient {
            basis,
            v_color: array(
                #[inline(always)]
                |k| Pack::load(simd, &passed[k]),
            ),
            v_direction: array(
                #[inline(always)]
                |k| (v_unit[k] - direction[k] * along) / length,
            ),
        }
    }
}

/// What comes out of [`Job::colors`].
struct ColorGradient<T: Real, S: Simd> {
    /// Values of the SH basis.
    basis: [[T; WIDEST]; 16],
    /// Gradient of the colours before their clamp at zero.
    v_color: [Pack<T, S>; 3],
    /// Gradient of mean - centre.
    v_direction: [Pack<T, S>; 3],
}

/// Writes the columns of those Gaussians that are kept, from row `first` on.
#[inline(always)]
fn write<T: Real, S: Simd, const C: usize>(
    target: &mut [T],
    width: usize,
    first: usize,
    count: usize,
    kept: &[bool; WIDEST],
    columns: &[Pack<T, S>; C],
) {
    let columns = arrays(*columns);
    let rows = target[first * width..][..count * width].chunks_exact_mut(width);
    for (l, row) in rows.enumerate() {
        if kept[l] {
            for (value, column) in row.iter_mut().zip(&columns) {
                *value = column[l];
            }
        }
    }
}

/// Gradients of log-scales, points in camera space and R_pose * rotation from those of the ellipses.
#[inline(always)]
fn ellipse<T: Real, S: Simd>(
    lens: &Lens<T>,
    g: &Geometry<T, S>,
    v: &EllipseGradient<Pack<T, S>>,
) -> ShapeGradient<Pack<T, S>> {
    let [x, y, z] = g.point;
    let zero = x.like(0.0);
    let two = x.like(2.0);
    let m1 = g.rows[1];
    let d = g.residual;
    // e = |m0|² - rho m0·m1 + low-pass etc. in terms of d = m0 - rho m1, which is small where
    // the ellipse is thin: gradients of the rows of the 2D factor, and of its columns' scales.
    let mut v_a = [[zero; 3]; 2];
    let mut log_scale = [zero; 3];
    for k in 0..3 {
        let along = two * v.e * d[k];
        let v_m0 = along + v.rho_over_yy * m1[k];
        let v_m1 = -g.rho * along + v.rho_over_yy * (d[k] - g.rho * m1[k]) + two * v.yy * m1[k];
        v_a[0][k] = v_m0 * g.scale[k];
        v_a[1][k] = v_m1 * g.scale[k];
        log_scale[k] =
            two * (v.e * d[k] * d[k] + v.rho_over_yy * d[k] * m1[k] + v.yy * m1[k] * m1[k]);
    }
    // a0 = j0 in_cam[0] - j0 tan0 in_cam[2], a1 = j1 in_cam[1] - j1 tan1 in_cam[2].
    let inv_z = x.like(1.0) / z;
    let (fx, fy) = (x.like(lens.fx.to_f64()), x.like(lens.fy.to_f64()));
    let (j0, j1) = (fx * inv_z, fy * inv_z);
    let (j02, j12) = (-j0 * g.tan[0], -j1 * g.tan[1]);
    let b = &g.in_cam;
    let mut in_cam = [zero; 9];
    let (mut v_j0, mut v_j1, mut v_j02, mut v_j12) = (zero, zero, zero, zero);
    for k in 0..3 {
        in_cam[k] = j0 * v_a[0][k];
        in_cam[3 + k] = j1 * v_a[1][k];
        in_cam[6 + k] = j02 * v_a[0][k] + j12 * v_a[1][k];
        v_j0 += v_a[0][k] * b[k];
        v_j1 += v_a[1][k] * b[3 + k];
        v_j02 += v_a[0][k] * b[6 + k];
        v_j12 += v_a[1][k] * b[6 + k];
    }
    let [v_u, v_v] = v.mean2d;
    let mut point = [v_u * j0, v_v * j1, v.depth];
    point[2] += -(point[0] * (x * inv_z) + point[1] * (y * inv_z))
        - (j0 * v_j0 + j1 * v_j1 + j02 * v_j02 + j12 * v_j12) * inv_z;
    for (k, v_tan) in [-j0 * v_j02, -j1 * v_j12].into_iter().enumerate() {
        let v_tan = g.inside[k].select(v_tan, zero);
        point[k] += v_tan * inv_z;
        point[2] += -(v_tan * g.tan[k] * inv_z);
    }
    ShapeGradient {
        log_scale,
        point,
        in_cam,
    }
}

/// Euclidean norm that neither overflows nor underflows on the way.
#[inline(always)]
fn norm2<T: Real, S: Simd>([a, b]: [Pack<T, S>; 2]) -> Pack<T, S> {
    let zero = a.like(0.0);
    let largest = a.abs().max(b.abs());
    let (a, b) = (a / largest, b / largest);
    zero.less(largest)
        .select(largest * (a * a + b * b).sqrt(), zero)
}
