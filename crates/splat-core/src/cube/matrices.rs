//! 3 x 3 matrices by rows.

use cubecl::prelude::*;
use host::cube::vec3::{Vec3, dot, load, scaled, store, sum, vec3};

#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Mat3 {
    pub(super) x: Vec3,
    pub(super) y: Vec3,
    pub(super) z: Vec3,
}

/// The nine numbers from `at` on.
#[cube]
pub(super) fn load_matrix(values: &[f32], at: usize) -> Mat3 {
    Mat3 {
        x: load(values, at),
        y: load(values, at + 3),
        z: load(values, at + 6),
    }
}

#[cube]
pub(super) fn store_matrix(values: &mut [f32], at: usize, m: Mat3) {
    store(values, at, m.x);
    store(values, at + 3, m.y);
    store(values, at + 6, m.z);
}

/// The rotation part of a pose [3, 4].
#[cube]
pub(super) fn pose_rotation(poses: &[f32], at: usize) -> Mat3 {
    Mat3 {
        x: load(poses, at),
        y: load(poses, at + 4),
        z: load(poses, at + 8),
    }
}

#[cube]
pub(super) fn transposed(m: Mat3) -> Mat3 {
    Mat3 {
        x: vec3(m.x.x, m.y.x, m.z.x),
        y: vec3(m.x.y, m.y.y, m.z.y),
        z: vec3(m.x.z, m.y.z, m.z.z),
    }
}

/// m v.
#[cube]
pub(super) fn apply(m: Mat3, v: Vec3) -> Vec3 {
    vec3(dot(m.x, v), dot(m.y, v), dot(m.z, v))
}

/// mᵀ v.
#[cube]
pub(super) fn apply_transposed(m: Mat3, v: Vec3) -> Vec3 {
    sum(sum(scaled(m.x, v.x), scaled(m.y, v.y)), scaled(m.z, v.z))
}

/// a b.
#[cube]
pub(super) fn mul3(a: Mat3, b: Mat3) -> Mat3 {
    Mat3 {
        x: apply_transposed(b, a.x),
        y: apply_transposed(b, a.y),
        z: apply_transposed(b, a.z),
    }
}

/// aᵀ b.
#[cube]
pub(super) fn transpose_mul3(a: Mat3, b: Mat3) -> Mat3 {
    mul3(transposed(a), b)
}

/// a bᵀ.
#[cube]
pub(super) fn mul_transpose3(a: Mat3, b: Mat3) -> Mat3 {
    Mat3 {
        x: apply(b, a.x),
        y: apply(b, a.y),
        z: apply(b, a.z),
    }
}
