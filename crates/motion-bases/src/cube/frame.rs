//! Gram–Schmidt on six numbers and its way back, as [`crate::gram_schmidt`] has it on tensors.

use cubecl::prelude::*;

use crate::rotation::{MIN_NORM, MIN_SINE, NEAR_Y_AXIS};
use host::cube::vec3::{Vec3, choose, cross, difference, dot, scaled, sum, vec3};

const LEAST: f32 = (MIN_NORM * MIN_NORM) as f32;
const LEAST_SINE: f32 = (MIN_SINE * MIN_SINE) as f32;
const NEAR: f32 = NEAR_Y_AXIS as f32;

/// The columns of a rotation, and what the way back needs.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Frame {
    pub(crate) x: Vec3,
    pub(crate) y: Vec3,
    pub(crate) z: Vec3,
    /// The second vector as it counts, of length 1 or an axis.
    second: Vec3,
    /// x × second, and how far it lies along x.
    across: Vec3,
    along: f32,
    /// By what gradients of the first and the second vector are scaled; 0 for one that was replaced.
    scale_first: f32,
    scale_second: f32,
    /// 1 / |across - along x|.
    inverse: f32,
}

/// Of two vectors with entries within ±1e9.
#[cube]
pub(crate) fn frame(given_first: Vec3, given_second: Vec3) -> Frame {
    let none = dot(given_first, given_first) < LEAST;
    let first = choose(none, vec3(1.0, 0.0, 0.0), given_first);
    let inverse_first = 1.0 / dot(first, first).sqrt();
    let x = scaled(first, inverse_first);

    let inverse_second = 1.0 / dot(given_second, given_second).max(LEAST).sqrt();
    let unit = scaled(given_second, inverse_second);
    let sine = cross(x, unit);
    let parallel = dot(sine, sine) < LEAST_SINE;
    let near = x.y * x.y > NEAR;
    let axis = choose(near, vec3(0.0, 0.0, 1.0), vec3(0.0, 1.0, 0.0));
    let second = choose(parallel, axis, unit);

    let across = cross(x, second);
    let along = dot(across, x);
    let right = difference(across, scaled(x, along));
    let inverse = 1.0 / dot(right, right).sqrt();
    let z = scaled(right, inverse);
    Frame {
        x,
        y: cross(z, x),
        z,
        second,
        across,
        along,
        scale_first: select(none, 0.0, inverse_first),
        scale_second: select(parallel, 0.0, inverse_second),
        inverse,
    }
}

/// The gradients of both vectors.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Six {
    pub(crate) first: Vec3,
    pub(crate) second: Vec3,
}

/// The gradient of the six numbers from those of the rotation's columns.
#[cube]
pub(crate) fn frame_backward(f: Frame, vx: Vec3, vy: Vec3, vz: Vec3) -> Six {
    // y = z × x
    let gz = sum(vz, cross(f.x, vy));
    let gx = sum(vx, cross(vy, f.z));
    // z = right / |right|
    let right = scaled(difference(gz, scaled(f.z, dot(f.z, gz))), f.inverse);
    // right = across - (across · x) x
    let along = -dot(right, f.x);
    let across = sum(right, scaled(f.x, along));
    let gx = sum(
        gx,
        difference(scaled(f.across, along), scaled(right, f.along)),
    );
    // across = x × second
    let gx = sum(gx, cross(f.second, across));
    Six {
        first: scaled(difference(gx, scaled(f.x, dot(f.x, gx))), f.scale_first),
        second: scaled(cross(across, f.x), f.scale_second),
    }
}
