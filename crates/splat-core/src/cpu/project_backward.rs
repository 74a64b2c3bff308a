//! Backward of the projection: sums each Gaussian's partial gradients over its tiles and carries
//! them on to the inputs.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::geometry::{
    Geometry, Lens, Shape, mul_transpose3, pose_rotation, project_one, quaternion_gradient,
    transpose_mul3, view_direction,
};
use super::project::{CHUNK, sh_color, sigmoid};
use super::raster_backward::GEOMETRIC;
use super::{BackwardOptions, Gradients, Projection, Real, SplatSlices, sh};

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

impl<T: Real> Piece<'_, T> {
    /// Every output with its width.
    fn outputs(&mut self) -> [(&mut [T], usize); 8] {
        let count = self.screen.len();
        let (sh_width, num_features) = (self.sh.len() / count, self.features.len() / count);
        [
            (&mut *self.means, 3),
            (&mut *self.quats, 4),
            (&mut *self.left_rotations, 9),
            (&mut *self.log_scales, 3),
            (&mut *self.opacity_logits, 1),
            (&mut *self.sh, sh_width),
            (&mut *self.features, num_features),
            (&mut *self.screen, 1),
        ]
    }

    fn is_finite(&mut self) -> bool {
        self.outputs().iter().all(|(out, _)| all_finite(out))
    }

    /// What belongs to a Gaussian in each output; nothing where it has no left rotation.
    fn row(&mut self, local: usize) -> [&mut [T]; 8] {
        self.outputs().map(|(out, width)| {
            let row = out.get_mut(local * width..(local + 1) * width);
            row.unwrap_or_default()
        })
    }
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
    let zeros = |len: usize| vec![T::ZERO; len];
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
        lens: Lens::new(&projection.view),
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
    lens: Lens<T>,
    num_features: usize,
    partial: &'a [T],
    options: BackwardOptions,
    drop_overflow: bool,
}

/// Gradients of a Gaussian's ellipse, means in pixels.
struct EllipseGradient<T> {
    mean2d: [T; 2],
    e: T,
    /// Gradient of rho divided by yy.
    rho_over_yy: T,
    yy: T,
    depth: T,
}

struct RunPiece<'a, 'b, T> {
    job: &'a Job<'a, T>,
    piece: Piece<'b, T>,
}

impl<T: Real> WithSimd for RunPiece<'_, '_, T> {
    type Output = [T; 12];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [T; 12] {
        self.job.run(self.piece)
    }
}

impl<T: Real> Job<'_, T> {
    #[inline(always)]
    fn run(&self, mut piece: Piece<'_, T>) -> [T; 12] {
        let mut pose = [T::ZERO; 12];
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
        let rows = || ranks.iter().zip(sums.chunks_exact(width)).enumerate();
        let visible = || rows().filter(|(_, (rank, _))| **rank != u32::MAX);
        for (local, (rank, sums)) in visible() {
            self.row(local, *rank as usize, sums, &mut piece, &mut pose);
        }
        if !self.drop_overflow || (all_finite(&pose) && piece.is_finite()) {
            return pose;
        }
        // Rare: once more, row by row.
        let mut pose = [T::ZERO; 12];
        for (local, (rank, sums)) in visible() {
            let mut own = [T::ZERO; 12];
            self.row(local, *rank as usize, sums, &mut piece, &mut own);
            if all_finite(&own) && piece.row(local).iter().all(|out| all_finite(out)) {
                for (sum, v) in pose.iter_mut().zip(own) {
                    *sum += v;
                }
            } else {
                piece
                    .row(local)
                    .into_iter()
                    .for_each(|out| out.fill(T::ZERO));
            }
        }
        pose
    }

    #[inline(always)]
    fn row(
        &self,
        local: usize,
        rank: usize,
        sums: &[T],
        piece: &mut Piece<'_, T>,
        v_pose: &mut [T; 12],
    ) {
        let row = piece.first + local;
        let view = &self.projection.view;
        let pose = &view.cam_from_world;
        let shape = Shape::of_row(self.splats, row);
        let mean = shape.mean;
        // It was visible, so this is `Some`; computing it again is cheaper than keeping it.
        let Some(g) = project_one(&self.lens, pose, &shape) else {
            return;
        };
        let splat = &self.projection.splats[rank];
        let two = T::of(2.0);
        let [sp, spp, sp_dy, s_dy, s_dy_dy, s] = std::array::from_fn(|k| sums[k]);
        let ellipse = EllipseGradient {
            mean2d: [
                -two * splat.l11 * sp,
                -two * (splat.l21 * sp + splat.l22 * splat.l22 * s_dy),
            ],
            e: -spp / g.e,
            rho_over_yy: -two * splat.l11 * sp_dy / g.yy,
            yy: -T::of(0.5) * s_dy_dy / (g.yy * g.yy),
            depth: sums[GEOMETRIC + 3],
        };
        // s sums -∂L/∂alpha · alpha, and ∂alpha/∂logit = alpha (1 - opacity).
        piece.opacity_logits[local] = -s * sigmoid(-self.splats.opacity_logits[row]);
        let half = T::of(0.5);
        let ndc = [
            ellipse.mean2d[0] * (half * self.lens.width),
            ellipse.mean2d[1] * (half * self.lens.height),
        ];
        piece.screen[local] = norm2(ndc);
        let f = self.num_features;
        piece.features[local * f..(local + 1) * f].copy_from_slice(&sums[GEOMETRIC + 4..]);

        let mut v_mean = [T::ZERO; 3];
        let v_direction = self.color(row, local, mean, &sums[GEOMETRIC..], piece);
        if self.options.view_direction {
            v_mean = v_direction;
            if self.options.pose {
                // centre = -Rᵀ t, and the direction is mean - centre: v_centre = -v_direction.
                for i in 0..3 {
                    let t = pose[4 * i + 3];
                    for j in 0..3 {
                        v_pose[4 * i + j] += t * v_direction[j];
                        v_pose[4 * i + 3] += pose[4 * i + j] * v_direction[j];
                    }
                }
            }
        }

        let (v_point, v_in_cam) = self.ellipse(&g, &ellipse, local, piece);
        let rotation = pose_rotation(pose);
        for j in 0..3 {
            v_mean[j] += rotation[j] * v_point[0]
                + rotation[3 + j] * v_point[1]
                + rotation[6 + j] * v_point[2];
        }
        piece.means[3 * local..3 * local + 3].copy_from_slice(&v_mean);
        if self.options.pose {
            let v_rotation = mul_transpose3(&v_in_cam, &g.rotation);
            for i in 0..3 {
                for j in 0..3 {
                    v_pose[4 * i + j] += v_rotation[3 * i + j] + v_point[i] * mean[j];
                }
                v_pose[4 * i + 3] += v_point[i];
            }
        }
        let v_rotation = transpose_mul3(&rotation, &v_in_cam);
        let v_quat = match shape.left {
            Some(l) => {
                piece.left_rotations[9 * local..9 * local + 9]
                    .copy_from_slice(&mul_transpose3(&v_rotation, &g.quat_matrix));
                transpose_mul3(&std::array::from_fn(|k| l[k]), &v_rotation)
            }
            None => v_rotation,
        };
        piece.quats[4 * local..4 * local + 4].copy_from_slice(&quaternion_gradient(&g, &v_quat));
    }

    /// Writes the SH gradient; returns the gradient of mean - centre.
    #[inline(always)]
    fn color(
        &self,
        row: usize,
        local: usize,
        mean: [T; 3],
        v_color: &[T],
        piece: &mut Piece<'_, T>,
    ) -> [T; 3] {
        let view = &self.projection.view;
        let coefficients = self.splats.sh_coefficients();
        let used = sh::num_coefficients(view.sh_degree);
        let (direction, length) = view_direction(&view.cam_from_world, mean);
        let basis = sh::basis(view.sh_degree, direction);
        let color = sh_color(self.splats, coefficients, row, used, &basis);
        let v: [T; 3] = std::array::from_fn(|k| {
            if color[k] > T::ZERO {
                v_color[k]
            } else {
                T::ZERO
            }
        });
        let stored = &self.splats.sh[row * coefficients * 3..][..used * 3];
        let out = &mut piece.sh[local * coefficients * 3..][..used * 3];
        let mut weights = [T::ZERO; 16];
        for b in 0..used {
            for k in 0..3 {
                out[3 * b + k] = basis[b] * v[k];
            }
            weights[b] = stored[3 * b] * v[0] + stored[3 * b + 1] * v[1] + stored[3 * b + 2] * v[2];
        }
        let v_unit = sh::direction_gradient(view.sh_degree, direction, &weights);
        let along = v_unit[0] * direction[0] + v_unit[1] * direction[1] + v_unit[2] * direction[2];
        std::array::from_fn(|k| (v_unit[k] - direction[k] * along) / length)
    }

    /// Writes the gradient of the log-scales; returns those of the point in camera space and of
    /// R_pose * rotation.
    #[inline(always)]
    fn ellipse(
        &self,
        g: &Geometry<T>,
        v: &EllipseGradient<T>,
        local: usize,
        piece: &mut Piece<'_, T>,
    ) -> ([T; 3], [T; 9]) {
        let two = T::of(2.0);
        let m1 = g.rows[1];
        let d = g.residual;
        // e = |m0|² - rho m0·m1 + low-pass etc. in terms of d = m0 - rho m1, which is small where
        // the ellipse is thin: gradients of the rows of the 2D factor, and of its columns' scales.
        let mut v_a = [[T::ZERO; 3]; 2];
        for k in 0..3 {
            let along = two * v.e * d[k];
            let v_m0 = along + v.rho_over_yy * m1[k];
            let v_m1 = -g.rho * along + v.rho_over_yy * (d[k] - g.rho * m1[k]) + two * v.yy * m1[k];
            v_a[0][k] = v_m0 * g.scale[k];
            v_a[1][k] = v_m1 * g.scale[k];
            piece.log_scales[3 * local + k] =
                two * (v.e * d[k] * d[k] + v.rho_over_yy * d[k] * m1[k] + v.yy * m1[k] * m1[k]);
        }
        // a0 = j0 in_cam[0] - j0 tan0 in_cam[2], a1 = j1 in_cam[1] - j1 tan1 in_cam[2].
        let [x, y, z] = g.point;
        let inv_z = T::ONE / z;
        let (j0, j1) = (self.lens.fx * inv_z, self.lens.fy * inv_z);
        let (j02, j12) = (-j0 * g.tan[0], -j1 * g.tan[1]);
        let b = &g.in_cam;
        let mut v_in_cam = [T::ZERO; 9];
        let (mut v_j0, mut v_j1, mut v_j02, mut v_j12) = (T::ZERO, T::ZERO, T::ZERO, T::ZERO);
        for k in 0..3 {
            v_in_cam[k] = j0 * v_a[0][k];
            v_in_cam[3 + k] = j1 * v_a[1][k];
            v_in_cam[6 + k] = j02 * v_a[0][k] + j12 * v_a[1][k];
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
            if g.inside[k] {
                point[k] += v_tan * inv_z;
                point[2] += -(v_tan * g.tan[k] * inv_z);
            }
        }
        (point, v_in_cam)
    }
}

/// Euclidean norm that neither overflows nor underflows on the way.
#[inline(always)]
fn norm2<T: Real>([a, b]: [T; 2]) -> T {
    let largest = a.abs().max(b.abs());
    if largest > T::ZERO {
        let (a, b) = (a / largest, b / largest);
        largest * (a * a + b * b).sqrt()
    } else {
        T::ZERO
    }
}
