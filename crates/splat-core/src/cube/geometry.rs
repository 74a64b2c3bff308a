//! The way of a Gaussian from the world to an ellipse in the image, with all intermediate values, for the forward and the
//! backward pass alike.

use cubecl::prelude::*;
use host::cube::finite::is_finite;
use host::cube::vec3::{Vec3, dot, scaled, sum, vec3};

use super::body::{FLOOR, Placed};
use super::matrices::{Mat3, apply, mul3, pose_rotation};
use crate::cpu::LOW_PASS;

const LOW: f32 = LOW_PASS as f32;

/// A pinhole's intrinsics, and where the Jacobian is clamped; see [`crate::cpu`].
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Lens {
    pub(crate) fx: f32,
    pub(crate) fy: f32,
    pub(crate) cx: f32,
    pub(crate) cy: f32,
    pub(crate) near: f32,
    pub(crate) min_x: f32,
    pub(crate) min_y: f32,
    pub(crate) max_x: f32,
    pub(crate) max_y: f32,
    /// Width and height in pixels.
    pub(crate) width: u32,
    pub(crate) height: u32,
}

/// The ellipse of a Gaussian in the image and what led to it; see the CPU's type of that name.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Geometry {
    pub(super) visible: bool,
    pub(super) point: Vec3,
    pub(super) mean_x: f32,
    pub(super) mean_y: f32,
    pub(super) tan_x: f32,
    pub(super) tan_y: f32,
    pub(super) inside_x: bool,
    pub(super) inside_y: bool,
    pub(super) in_cam: Mat3,
    pub(super) row1: Vec3,
    pub(super) residual: Vec3,
    pub(super) xx: f32,
    pub(super) yy: f32,
    pub(super) rho: f32,
    pub(super) e: f32,
    pub(super) l11: f32,
    pub(super) l21: f32,
    pub(super) l22: f32,
}

#[cube]
pub(super) fn magnitude(v: Vec3) -> f32 {
    v.x.abs() + v.y.abs() + v.z.abs()
}

/// Projects a Gaussian by the pose [3, 4] that begins at `at`.
#[cube]
pub(super) fn project_one(lens: Lens, poses: &[f32], at: usize, p: Placed) -> Geometry {
    let turn = pose_rotation(poses, at);
    let shift = vec3(poses[at + 3], poses[at + 7], poses[at + 11]);
    let point = sum(apply(turn, p.mean), shift);
    let inv_z = 1.0 / point.z;
    let slope_x = point.x * inv_z;
    let slope_y = point.y * inv_z;
    let mean_x = lens.fx * slope_x + lens.cx;
    let mean_y = lens.fy * slope_y + lens.cy;
    let tan_x = slope_x.max(lens.min_x).min(lens.max_x);
    let tan_y = slope_y.max(lens.min_y).min(lens.max_y);

    let in_cam = mul3(turn, p.rotation);
    let j0 = lens.fx * inv_z;
    let j1 = lens.fy * inv_z;
    let a0 = sum(scaled(in_cam.x, j0), scaled(in_cam.z, -j0 * tan_x));
    let a1 = sum(scaled(in_cam.y, j1), scaled(in_cam.z, -j1 * tan_y));
    let s = p.scale;
    let m0 = vec3(a0.x * s.x, a0.y * s.y, a0.z * s.z);
    let m1 = vec3(a1.x * s.x, a1.y * s.y, a1.z * s.z);

    let t0 = dot(m0, m0);
    let t1 = dot(m1, m1);
    let xx = t0 + LOW;
    let yy = t1 + LOW;
    let rho = dot(m0, m1) / yy;
    // The determinant as a sum of positive terms, of minors that are taken before scaling.
    let n01 = s.x * s.y * (a0.x * a1.y - a0.y * a1.x);
    let n02 = s.x * s.z * (a0.x * a1.z - a0.z * a1.x);
    let n12 = s.y * s.z * (a0.y * a1.z - a0.z * a1.y);
    let root = yy.sqrt();
    let (r01, r02, r12) = (n01 / root, n02 / root, n12 / root);
    let e = r01 * r01 + r02 * r02 + r12 * r12 + LOW * (t0 / yy) + LOW;
    let residual = vec3(
        (m1.y * n01 + m1.z * n02 + LOW * m0.x) / yy,
        (m1.z * n12 - m1.x * n01 + LOW * m0.y) / yy,
        (LOW * m0.z - m1.x * n02 - m1.y * n12) / yy,
    );
    // One sum finds every overflow: infinities of either sign leave it infinite or not a number.
    let total = e + xx + rho.abs() + magnitude(residual);
    let visible = lens.near < point.z
        && is_finite(point.z)
        && is_finite(total)
        && is_finite(mean_x.abs() + mean_y.abs());
    let l11 = (0.5 / e).sqrt();
    Geometry {
        visible,
        point,
        mean_x,
        mean_y,
        tan_x,
        tan_y,
        inside_x: (tan_x - slope_x).abs() < f32::MIN_POSITIVE,
        inside_y: (tan_y - slope_y).abs() < f32::MIN_POSITIVE,
        in_cam,
        row1: m1,
        residual,
        xx,
        yy,
        rho,
        e,
        l11,
        l21: -rho * l11,
        l22: (0.5 / yy).sqrt(),
    }
}

/// The direction from the camera's centre to a mean (unit), and its length. The centre is -Rᵀ t.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Direction {
    pub(super) unit: Vec3,
    pub(super) length: f32,
}

#[cube]
pub(super) fn view_direction(pose: &[f32], mean: Vec3) -> Direction {
    let turn = pose_rotation(pose, 0);
    let shift = vec3(pose[3], pose[7], pose[11]);
    let back = sum(
        sum(scaled(turn.x, shift.x), scaled(turn.y, shift.y)),
        scaled(turn.z, shift.z),
    );
    let d = sum(mean, back);
    // Normalised without leaving the range of the float type.
    let largest = d.x.abs().max(d.y.abs()).max(d.z.abs()).max(FLOOR);
    let s = vec3(d.x / largest, d.y / largest, d.z / largest);
    let length = dot(s, s).sqrt().max(FLOOR);
    Direction {
        unit: vec3(s.x / length, s.y / length, s.z / length),
        length: length * largest,
    }
}
