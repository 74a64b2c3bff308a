//! One Gaussian's way from the world to an ellipse in the image, with all intermediate values, for
//! the forward and the backward pass alike.

use super::{LOW_PASS, Real, SplatSlices, View};

/// Below this a quaternion's norm counts as this much: a zero quaternion is the identity.
const NORM_FLOOR: f64 = 1e-12;

/// Intrinsics in the kernels' float type, and where the Jacobian is clamped.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens<T> {
    pub(super) fx: T,
    pub(super) fy: T,
    pub(super) cx: T,
    pub(super) cy: T,
    pub(super) near: T,
    pub(super) width: T,
    pub(super) height: T,
    /// x/z and y/z stay in these ranges in the Jacobian: the image and 0.15 of its size around it.
    min: [T; 2],
    max: [T; 2],
}

impl<T: Real> Lens<T> {
    pub(super) fn new(view: &View<T>) -> Self {
        let c = &view.camera;
        let (w, h) = (c.width as f64, c.height as f64);
        let margin = [0.3 * 0.5 * w / c.fx, 0.3 * 0.5 * h / c.fy];
        Self {
            fx: T::of(c.fx),
            fy: T::of(c.fy),
            cx: T::of(c.cx),
            cy: T::of(c.cy),
            near: T::of(c.near),
            width: T::of(w),
            height: T::of(h),
            min: [
                T::of(-c.cx / c.fx - margin[0]),
                T::of(-c.cy / c.fy - margin[1]),
            ],
            max: [
                T::of((w - c.cx) / c.fx + margin[0]),
                T::of((h - c.cy) / c.fy + margin[1]),
            ],
        }
    }
}

/// The ellipse of a Gaussian in the image and what led to it.
///
/// With the 2D covariance [[xx, xy], [xy, yy]], sigma(dx, dy) = p² + q², where
/// p = sqrt(1/2 / e) (dx - rho dy), q = sqrt(1/2 / yy) dy, rho = xy / yy, e = xx - xy² / yy.
/// This is half the Mahalanobis distance as a sum of squares: nothing cancels for thin ellipses,
/// where a conic's three products do.
#[derive(Clone, Debug)]
pub(super) struct Geometry<T> {
    /// Mean in camera space.
    pub(super) point: [T; 3],
    /// Mean in pixels.
    pub(super) mean2d: [T; 2],
    /// x/z and y/z as clamped for the Jacobian, and whether they were inside the range.
    pub(super) tan: [T; 2],
    pub(super) inside: [bool; 2],
    /// Unit quaternion, the divisor that made it, and whether that was the floor.
    pub(super) unit: [T; 4],
    pub(super) norm: T,
    pub(super) floored: bool,
    /// Matrix of the quaternion, and the whole rotation left * quaternion, row-major.
    pub(super) quat_matrix: [T; 9],
    pub(super) rotation: [T; 9],
    /// R_pose * rotation.
    pub(super) in_cam: [T; 9],
    pub(super) scale: [T; 3],
    /// The two rows of J * `in_cam` * diag(scale): the covariance is their Gram matrix + low-pass.
    pub(super) rows: [[T; 3]; 2],
    /// rows[0] - rho * rows`[1]`.
    pub(super) residual: [T; 3],
    pub(super) xx: T,
    pub(super) yy: T,
    pub(super) rho: T,
    pub(super) e: T,
}

#[inline(always)]
pub(super) fn mul3<T: Real>(a: &[T; 9], b: &[T; 9]) -> [T; 9] {
    std::array::from_fn(|k| {
        let (i, j) = (k / 3, k % 3);
        a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]
    })
}

/// aᵀ b.
#[inline(always)]
pub(super) fn transpose_mul3<T: Real>(a: &[T; 9], b: &[T; 9]) -> [T; 9] {
    std::array::from_fn(|k| {
        let (i, j) = (k / 3, k % 3);
        a[i] * b[j] + a[3 + i] * b[3 + j] + a[6 + i] * b[6 + j]
    })
}

/// a bᵀ.
#[inline(always)]
pub(super) fn mul_transpose3<T: Real>(a: &[T; 9], b: &[T; 9]) -> [T; 9] {
    std::array::from_fn(|k| {
        let (i, j) = (k / 3, k % 3);
        a[3 * i] * b[3 * j] + a[3 * i + 1] * b[3 * j + 1] + a[3 * i + 2] * b[3 * j + 2]
    })
}

/// The rotation part of a [3, 4] pose.
#[inline(always)]
pub(super) fn pose_rotation<T: Real>(pose: &[T; 12]) -> [T; 9] {
    std::array::from_fn(|k| pose[4 * (k / 3) + k % 3])
}

#[inline(always)]
fn quaternion_matrix<T: Real>([w, x, y, z]: [T; 4]) -> [T; 9] {
    let one = T::ONE;
    let two = T::of(2.0);
    [
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    ]
}

/// Gradient of an unnormalised quaternion from that of its matrix.
#[inline(always)]
pub(super) fn quaternion_gradient<T: Real>(g: &Geometry<T>, v: &[T; 9]) -> [T; 4] {
    let [w, x, y, z] = g.unit;
    let two = T::of(2.0);
    let (s01, s02, s12) = (v[1] + v[3], v[2] + v[6], v[5] + v[7]);
    let (a21, a02, a10) = (v[7] - v[5], v[2] - v[6], v[3] - v[1]);
    let unit = [
        two * (x * a21 + y * a02 + z * a10),
        two * (y * s01 + z * s02 + w * a21 - two * x * (v[4] + v[8])),
        two * (x * s01 + z * s12 + w * a02 - two * y * (v[0] + v[8])),
        two * (x * s02 + y * s12 + w * a10 - two * z * (v[0] + v[4])),
    ];
    let along = if g.floored {
        T::ZERO
    } else {
        w * unit[0] + x * unit[1] + y * unit[2] + z * unit[3]
    };
    std::array::from_fn(|k| (unit[k] - g.unit[k] * along) / g.norm)
}

/// What the projection of one Gaussian reads.
pub(super) struct Shape<'a, T> {
    pub(super) mean: [T; 3],
    pub(super) quat: [T; 4],
    /// Matrix multiplied from the left of the quaternion's.
    pub(super) left: Option<&'a [T]>,
    pub(super) log_scale: [T; 3],
}

impl<'a, T: Real> Shape<'a, T> {
    #[inline(always)]
    pub(super) fn of_row(splats: &SplatSlices<'a, T>, row: usize) -> Self {
        Self {
            mean: std::array::from_fn(|k| splats.means[3 * row + k]),
            quat: std::array::from_fn(|k| splats.quats[4 * row + k]),
            left: (row < splats.num_left()).then(|| &splats.left_rotations[9 * row..9 * row + 9]),
            log_scale: std::array::from_fn(|k| splats.log_scales[3 * row + k]),
        }
    }
}

/// Projects a Gaussian; `None` when it is not in front of the near plane or overflows.
#[inline(always)]
pub(super) fn project_one<T: Real>(
    lens: &Lens<T>,
    pose: &[T; 12],
    shape: &Shape<'_, T>,
) -> Option<Geometry<T>> {
    let Shape {
        mean,
        quat,
        left,
        log_scale,
    } = *shape;
    let point: [T; 3] = std::array::from_fn(|i| {
        pose[4 * i] * mean[0]
            + pose[4 * i + 1] * mean[1]
            + pose[4 * i + 2] * mean[2]
            + pose[4 * i + 3]
    });
    let [x, y, z] = point;
    if !(z > lens.near && z.is_finite()) {
        return None;
    }
    let inv_z = T::ONE / z;
    let slope = [x * inv_z, y * inv_z];
    let mean2d = [lens.fx * slope[0] + lens.cx, lens.fy * slope[1] + lens.cy];
    let inside = [0, 1].map(|k| slope[k] >= lens.min[k] && slope[k] <= lens.max[k]);
    let tan = [0, 1].map(|k| slope[k].max(lens.min[k]).min(lens.max[k]));

    // Scaled by the largest entry first, so that neither large nor small entries leave the range.
    let largest = quat.iter().fold(T::ZERO, |m, q| m.max(q.abs()));
    let floored = largest <= T::of(NORM_FLOOR);
    let (unit, norm) = if floored {
        (quat.map(|q| q / T::of(NORM_FLOOR)), T::of(NORM_FLOOR))
    } else {
        let q = quat.map(|q| q / largest);
        let length = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
        (q.map(|q| q / length), length * largest)
    };
    // Under the floor the vector part shrinks to nothing and the matrix to the identity.
    let quat_matrix = quaternion_matrix(unit);
    let rotation = match left {
        Some(l) => mul3(&std::array::from_fn(|k| l[k]), &quat_matrix),
        None => quat_matrix,
    };
    let in_cam = mul3(&pose_rotation(pose), &rotation);

    let scale = log_scale.map(T::exp);
    let (j0, j1) = (lens.fx * inv_z, lens.fy * inv_z);
    let (j02, j12) = (-j0 * tan[0], -j1 * tan[1]);
    let a0: [T; 3] = std::array::from_fn(|k| j0 * in_cam[k] + j02 * in_cam[6 + k]);
    let a1: [T; 3] = std::array::from_fn(|k| j1 * in_cam[3 + k] + j12 * in_cam[6 + k]);
    let m0: [T; 3] = std::array::from_fn(|k| a0[k] * scale[k]);
    let m1: [T; 3] = std::array::from_fn(|k| a1[k] * scale[k]);

    let low = T::of(LOW_PASS);
    let t0 = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2];
    let t1 = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2];
    let (xx, yy) = (t0 + low, t1 + low);
    let rho = (m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2]) / yy;
    // det = Σ minors² + low (t0 + t1) + low² (Cauchy-Binet): a sum of positive terms, so that a
    // needle's determinant keeps its digits. The minors are taken before scaling for the same reason.
    let minor = |i: usize, j: usize| scale[i] * scale[j] * (a0[i] * a1[j] - a0[j] * a1[i]);
    let (n01, n02, n12) = (minor(0, 1), minor(0, 2), minor(1, 2));
    let root = yy.sqrt();
    let (r01, r02, r12) = (n01 / root, n02 / root, n12 / root);
    let e = r01 * r01 + r02 * r02 + r12 * r12 + low * (t0 / yy) + low;
    let residual = [
        (m1[1] * n01 + m1[2] * n02 + low * m0[0]) / yy,
        (m1[2] * n12 - m1[0] * n01 + low * m0[1]) / yy,
        (low * m0[2] - m1[0] * n02 - m1[1] * n12) / yy,
    ];
    // One sum finds every overflow: infinities of either sign leave it infinite or NaN.
    let sum = e + xx + rho.abs() + residual[0].abs() + residual[1].abs() + residual[2].abs();
    if !sum.is_finite() || !(mean2d[0].abs() + mean2d[1].abs()).is_finite() {
        return None;
    }
    Some(Geometry {
        point,
        mean2d,
        tan,
        inside,
        unit,
        norm,
        floored,
        quat_matrix,
        rotation,
        in_cam,
        scale,
        rows: [m0, m1],
        residual,
        xx,
        yy,
        rho,
        e,
    })
}

/// Direction from the camera's centre to a mean (unit), its length, and the centre -Rᵀ t.
#[inline(always)]
pub(super) fn view_direction<T: Real>(pose: &[T; 12], mean: [T; 3]) -> ([T; 3], T) {
    // d = mean - centre = mean + Rᵀ t, normalised without leaving the range of the float type.
    let d: [T; 3] = std::array::from_fn(|j| {
        mean[j] + pose[j] * pose[3] + pose[4 + j] * pose[7] + pose[8 + j] * pose[11]
    });
    let largest = d.iter().fold(T::of(NORM_FLOOR), |m, v| m.max(v.abs()));
    let s = d.map(|v| v / largest);
    let length = (s[0] * s[0] + s[1] * s[1] + s[2] * s[2])
        .sqrt()
        .max(T::of(NORM_FLOOR));
    (s.map(|v| v / length), length * largest)
}
