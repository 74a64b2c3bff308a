//! The way of Gaussians from the world to ellipses in the image, several at a time, with all intermediate
//! values, for the forward and the backward pass alike.

use pulp::Simd;

use super::body::{NORM_FLOOR, Placed};
use super::constants::LOW_PASS;
use super::matrices::{mul3, pose_rotation};
use super::packs::{Number, Pack, Where, array};
use super::real::Real;
use super::types::View;
use crate::camera::{Camera, CameraModel};
use crate::error::SplatError;

/// A pinhole's intrinsics and pose in the kernels' float type, and where the Jacobian is clamped.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens<T> {
    pub(super) fx: T,
    pub(super) fy: T,
    pub(super) cx: T,
    pub(super) cy: T,
    pub(super) near: T,
    /// Width and height in pixels.
    pub(super) size: [usize; 2],
    /// Rows [R | t], from the world to the camera.
    pub(super) pose: [T; 12],
    /// x/z and y/z stay in these ranges in the Jacobian: the image and 0.15 of its size around it.
    min: [T; 2],
    max: [T; 2],
}

impl<T: Real> Lens<T> {
    /// Refuses a camera that is not usable, and a pose that is not finite.
    pub(super) fn new(view: &View) -> Result<Self, SplatError> {
        let pose = view.cam_from_world.map(T::of);
        if let Some(k) = pose.iter().position(|v| !v.is_finite()) {
            return Err(SplatError::NotFinite {
                tensor: "cam_from_world",
                row: k / 4,
            });
        }
        view.camera.check()?;
        let c = &view.camera;
        // What the kernels compute; another model needs a lens of its own.
        let CameraModel::Pinhole = c.model;
        let [min, max] = tangents(c);
        Ok(Self {
            fx: T::of(c.fx),
            fy: T::of(c.fy),
            cx: T::of(c.cx),
            cy: T::of(c.cy),
            near: T::of(c.near),
            size: [c.width, c.height],
            pose,
            min: min.map(T::of),
            max: max.map(T::of),
        })
    }
}

/// Least and largest x/z and y/z in the Jacobian.
pub(crate) fn tangents(c: &Camera) -> [[f64; 2]; 2] {
    let CameraModel::Pinhole = c.model;
    let (w, h) = (c.width as f64, c.height as f64);
    let margin = [0.3 * 0.5 * w / c.fx, 0.3 * 0.5 * h / c.fy];
    [
        [-c.cx / c.fx - margin[0], -c.cy / c.fy - margin[1]],
        [(w - c.cx) / c.fx + margin[0], (h - c.cy) / c.fy + margin[1]],
    ]
}

/// The ellipses of Gaussians in the image and what led to them.
///
/// With the 2D covariance [[xx, xy], [xy, yy]], sigma(dx, dy) = p² + q², where
/// p = sqrt(1/2 / e) (dx - rho dy), q = sqrt(1/2 / yy) dy, rho = xy / yy, e = xx - xy² / yy.
/// This is half the Mahalanobis distance as a sum of squares: nothing cancels for thin ellipses,
/// where a conic's three products do.
#[derive(Clone, Debug)]
pub(super) struct Geometry<T: Real, S: Simd> {
    /// In front of the near plane, and nothing overflows. The other values are of no use elsewhere.
    pub(super) visible: Where<T, S>,
    /// Mean in camera space.
    pub(super) point: [Pack<T, S>; 3],
    /// Mean in pixels.
    pub(super) mean2d: [Pack<T, S>; 2],
    /// x/z and y/z as clamped for the Jacobian, and whether they were inside the range.
    pub(super) tan: [Pack<T, S>; 2],
    pub(super) inside: [Where<T, S>; 2],
    /// R_pose * rotation.
    pub(super) in_cam: [Pack<T, S>; 9],
    /// The two rows of J * `in_cam` * diag(scale): the covariance is their Gram matrix + low-pass.
    pub(super) rows: [[Pack<T, S>; 3]; 2],
    /// rows[0] - rho * rows`[1]`.
    pub(super) residual: [Pack<T, S>; 3],
    pub(super) xx: Pack<T, S>,
    pub(super) yy: Pack<T, S>,
    pub(super) rho: Pack<T, S>,
    pub(super) e: Pack<T, S>,
    /// sigma = (l11 dx + l21 dy)² + (l22 dy)².
    pub(super) l11: Pack<T, S>,
    pub(super) l21: Pack<T, S>,
    pub(super) l22: Pack<T, S>,
}

/// Projects Gaussians.
#[inline(always)]
pub(super) fn project_some<T: Real, S: Simd>(
    simd: S,
    lens: &Lens<T>,
    placed: &Placed<T, S>,
) -> Geometry<T, S> {
    let Placed {
        mean,
        rotation,
        scale,
    } = placed;
    let splat = |value| Pack::splat(simd, value);
    let n = |value| splat(T::of(value));
    let pose: [_; 12] = array(
        #[inline(always)]
        |k| splat(lens.pose[k]),
    );
    let point: [_; 3] = array(
        #[inline(always)]
        |i| {
            pose[4 * i] * mean[0]
                + pose[4 * i + 1] * mean[1]
                + pose[4 * i + 2] * mean[2]
                + pose[4 * i + 3]
        },
    );
    let [x, y, z] = point;
    let inv_z = n(1.0) / z;
    let slope = [x * inv_z, y * inv_z];
    let (fx, fy) = (splat(lens.fx), splat(lens.fy));
    let mean2d = [
        fx * slope[0] + splat(lens.cx),
        fy * slope[1] + splat(lens.cy),
    ];
    let tan: [_; 2] = array(
        #[inline(always)]
        |k| slope[k].max(splat(lens.min[k])).min(splat(lens.max[k])),
    );
    // Inside is where the clamp changed nothing.
    let inside: [_; 2] = array(
        #[inline(always)]
        |k| {
            (tan[k] - slope[k])
                .abs()
                .less(n(f64::from(f32::MIN_POSITIVE)))
        },
    );

    let in_cam = mul3(&pose_rotation(&pose), rotation);

    let (j0, j1) = (fx * inv_z, fy * inv_z);
    let (j02, j12) = (-j0 * tan[0], -j1 * tan[1]);
    let a0: [_; 3] = array(
        #[inline(always)]
        |k| j0 * in_cam[k] + j02 * in_cam[6 + k],
    );
    let a1: [_; 3] = array(
        #[inline(always)]
        |k| j1 * in_cam[3 + k] + j12 * in_cam[6 + k],
    );
    let m0: [_; 3] = array(
        #[inline(always)]
        |k| a0[k] * scale[k],
    );
    let m1: [_; 3] = array(
        #[inline(always)]
        |k| a1[k] * scale[k],
    );

    let low = n(LOW_PASS);
    let t0 = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2];
    let t1 = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2];
    let (xx, yy) = (t0 + low, t1 + low);
    let rho = (m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2]) / yy;
    // det = Σ minors² + low (t0 + t1) + low² (Cauchy-Binet): a sum of positive terms, so that a
    // needle's determinant keeps its digits. The minors are taken before scaling for the same reason.
    let [n01, n02, n12]: [_; 3] = array(
        #[inline(always)]
        |k| {
            let (i, j) = [(0, 1), (0, 2), (1, 2)][k];
            scale[i] * scale[j] * (a0[i] * a1[j] - a0[j] * a1[i])
        },
    );
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
    let visible = splat(lens.near)
        .less(z)
        .and(z.is_finite())
        .and(sum.is_finite())
        .and((mean2d[0].abs() + mean2d[1].abs()).is_finite());
    let l11 = (n(0.5) / e).sqrt();
    Geometry {
        visible,
        point,
        mean2d,
        tan,
        inside,
        in_cam,
        rows: [m0, m1],
        residual,
        xx,
        yy,
        rho,
        e,
        l11,
        l21: -rho * l11,
        l22: (n(0.5) / yy).sqrt(),
    }
}

/// Directions from the camera's centre to means (unit), and their lengths. The centre is -Rᵀ t.
#[inline(always)]
pub(super) fn view_directions<T: Real, S: Simd>(
    pose: &[T; 12],
    mean: [Pack<T, S>; 3],
) -> ([Pack<T, S>; 3], Pack<T, S>) {
    // d = mean - centre = mean + Rᵀ t, normalised without leaving the range of the float type.
    let d: [_; 3] = array(
        #[inline(always)]
        |j| {
            let back = pose[j] * pose[3] + pose[4 + j] * pose[7] + pose[8 + j] * pose[11];
            mean[j] + mean[j].like(back.to_f64())
        },
    );
    let floor = mean[0].like(NORM_FLOOR);
    let largest = floor.max(d[0].abs()).max(d[1].abs()).max(d[2].abs());
    let s: [_; 3] = array(
        #[inline(always)]
        |k| d[k] / largest,
    );
    let length = (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]).sqrt().max(floor);
    (
        array(
            #[inline(always)]
            |k| s[k] / length,
        ),
        length * largest,
    )
}
