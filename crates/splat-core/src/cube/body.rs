//! The shape of Gaussians in the world: what no camera changes.

use cubecl::prelude::*;
use host::cube::vec3::{Vec3, load, vec3};

use super::matrices::{Mat3, load_matrix, mul3};
use crate::cpu::NORM_FLOOR;

pub(super) const FLOOR: f32 = NORM_FLOOR as f32;

/// Numbers of a Gaussian in a table of shapes: mean 3, quaternion 4, logarithms of scales 3, logit of the opacity.
pub(crate) const SHAPE: usize = 11;
/// Numbers of a moving Gaussian in a sample: mean 3, and the matrix multiplied from the left of its rotation.
pub(crate) const MOVED: usize = 12;

/// A quaternion of length 1, the divisor that made it, and whether that was more than the floor.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Unit {
    w: f32,
    v: Vec3,
    norm: f32,
    above_floor: bool,
}

/// Scaled by the largest entry first, so that neither large nor small entries leave the range.
#[cube]
pub(super) fn unit_quaternion(shapes: &[f32], row: usize) -> Unit {
    let at = row * SHAPE + 3;
    let w = shapes[at];
    let v = load(shapes, at + 1);
    let largest = w.abs().max(v.x.abs()).max(v.y.abs().max(v.z.abs()));
    let above_floor = FLOOR < largest;
    let by = select(above_floor, largest, FLOOR);
    let (qw, qx, qy, qz) = (w / by, v.x / by, v.y / by, v.z / by);
    let length = (qw * qw + qx * qx + qy * qy + qz * qz).sqrt();
    // Under the floor the vector part shrinks to nothing and the matrix to the identity.
    let divisor = select(above_floor, length, 1.0);
    Unit {
        w: qw / divisor,
        v: vec3(qx / divisor, qy / divisor, qz / divisor),
        norm: divisor * by,
        above_floor,
    }
}

#[cube]
pub(super) fn quaternion_matrix(q: Unit) -> Mat3 {
    let (w, x, y, z) = (q.w, q.v.x, q.v.y, q.v.z);
    Mat3 {
        x: vec3(
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ),
        y: vec3(
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ),
        z: vec3(
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ),
    }
}

/// Four numbers.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Quaternion {
    pub(super) w: f32,
    pub(super) v: Vec3,
}

/// Gradient of an unnormalised quaternion from that of its matrix.
#[cube]
pub(super) fn quaternion_gradient(q: Unit, g: Mat3) -> Quaternion {
    let (w, x, y, z) = (q.w, q.v.x, q.v.y, q.v.z);
    let (s01, s02, s12) = (g.x.y + g.y.x, g.x.z + g.z.x, g.y.z + g.z.y);
    let (a21, a02, a10) = (g.z.y - g.y.z, g.x.z - g.z.x, g.y.x - g.x.y);
    let vw = 2.0 * (x * a21 + y * a02 + z * a10);
    let vx = 2.0 * (y * s01 + z * s02 + w * a21 - 2.0 * x * (g.y.y + g.z.z));
    let vy = 2.0 * (x * s01 + z * s12 + w * a02 - 2.0 * y * (g.x.x + g.z.z));
    let vz = 2.0 * (x * s02 + y * s12 + w * a10 - 2.0 * z * (g.x.x + g.y.y));
    let along = select(q.above_floor, w * vw + x * vx + y * vy + z * vz, 0.0);
    Quaternion {
        w: (vw - w * along) / q.norm,
        v: vec3(
            (vx - x * along) / q.norm,
            (vy - y * along) / q.norm,
            (vz - z * along) / q.norm,
        ),
    }
}

/// Where a Gaussian is in a sample: all that a projection reads.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Placed {
    pub(super) mean: Vec3,
    /// left * quaternion.
    pub(super) rotation: Mat3,
    pub(super) scale: Vec3,
}

/// A Gaussian in a sample, where the first `moving` rows lie in `moved` [n, moving, 12].
#[cube]
pub(super) fn placed(
    shapes: &[f32],
    moved: &[f32],
    sample: usize,
    row: usize,
    moving: usize,
) -> Placed {
    let quat_matrix = quaternion_matrix(unit_quaternion(shapes, row));
    let at = row * SHAPE;
    let scales = load(shapes, at + 7);
    let mut mean = load(shapes, at);
    let mut rotation = quat_matrix;
    if row < moving {
        let from = (sample * moving + row) * MOVED;
        mean = load(moved, from);
        rotation = mul3(load_matrix(moved, from + 3), quat_matrix);
    }
    Placed {
        mean,
        rotation,
        scale: vec3(scales.x.exp(), scales.y.exp(), scales.z.exp()),
    }
}

#[cube]
pub(super) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}
