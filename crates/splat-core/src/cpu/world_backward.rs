//! Backward of the projection of ellipses: from the sums of the blending's partial gradients to gradients in the world.

use pulp::Simd;

use super::body::Placed;
use super::geometry::{Geometry, Lens};
use super::matrices::{mul_transpose3, pose_rotation, transpose_mul3};
use super::packs::{Number, Pack, array};
use super::project::sigmoid;
use super::raster_backward::GEOMETRIC;
use super::real::Real;

/// Gradients of Gaussians in the world, but for the ways through their colours.
pub(super) struct WorldGradient<V> {
    pub(super) mean: [V; 3],
    /// Of the whole rotation, left * quaternion.
    pub(super) rotation: [V; 9],
    pub(super) log_scale: [V; 3],
    /// Of the pose's entries as twelve free numbers.
    pub(super) pose: [V; 12],
    /// Norm of the gradient of the mean in the image, in NDC units.
    pub(super) screen: V,
}

/// Gradients in the world from the geometric sums and the gradient of the depth; that of the pose is 0 where it is not wanted.
#[inline(always)]
pub(super) fn to_world<T: Real, S: Simd>(
    lens: &Lens<T>,
    g: &Geometry<T, S>,
    placed: &Placed<T, S>,
    (geometric, v_depth): ([Pack<T, S>; GEOMETRIC], Pack<T, S>),
    wants_pose: bool,
) -> WorldGradient<Pack<T, S>> {
    let [sp, spp, sp_dy, s_dy, s_dy_dy, _] = geometric;
    let n = |value| sp.like(value);
    let v_ellipse = EllipseGradient {
        mean2d: [
            -n(2.0) * g.l11 * sp,
            -n(2.0) * (g.l21 * sp + g.l22 * g.l22 * s_dy),
        ],
        e: -spp / g.e,
        rho_over_yy: -n(2.0) * g.l11 * sp_dy / g.yy,
        yy: -n(0.5) * s_dy_dy / (g.yy * g.yy),
        depth: v_depth,
    };
    let [across, down] = lens.size;
    let screen = norm2([
        v_ellipse.mean2d[0] * n(0.5) * n(across as f64),
        v_ellipse.mean2d[1] * n(0.5) * n(down as f64),
    ]);
    let v_shape = ellipse(lens, g, placed, &v_ellipse);
    let in_pose = pose_rotation(&lens.pose);
    let rotation: [_; 9] = array(
        #[inline(always)]
        |k| n(in_pose[k].to_f64()),
    );
    let v_point = v_shape.point;
    let mut pose = [n(0.0); 12];
    if wants_pose {
        let v_rotation = mul_transpose3(&v_shape.in_cam, &placed.rotation);
        for i in 0..3 {
            for j in 0..3 {
                pose[4 * i + j] = v_rotation[3 * i + j] + v_point[i] * placed.mean[j];
            }
            pose[4 * i + 3] = v_point[i];
        }
    }
    WorldGradient {
        mean: array(
            #[inline(always)]
            |j| {
                rotation[j] * v_point[0]
                    + rotation[3 + j] * v_point[1]
                    + rotation[6 + j] * v_point[2]
            },
        ),
        rotation: transpose_mul3(&rotation, &v_shape.in_cam),
        log_scale: v_shape.log_scale,
        pose,
        screen,
    }
}

/// Gradient of opacity logits from Σ s, the last of the geometric sums.
#[inline(always)]
pub(super) fn logit_gradient<T: Real, S: Simd>(sum: Pack<T, S>, logits: Pack<T, S>) -> Pack<T, S> {
    // s is -∂L/∂alpha · alpha, and ∂alpha/∂logit = alpha (1 - opacity).
    -sum * (-logits).map(sigmoid)
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

/// Gradients of log-scales, points in camera space and R_pose * rotation from those of the ellipses.
#[inline(always)]
fn ellipse<T: Real, S: Simd>(
    lens: &Lens<T>,
    g: &Geometry<T, S>,
    placed: &Placed<T, S>,
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
        v_a[0][k] = v_m0 * placed.scale[k];
        v_a[1][k] = v_m1 * placed.scale[k];
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
