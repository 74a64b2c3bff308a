//! Vectors of three numbers.

use cubecl::prelude::*;

/// x, y, z.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Vec3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

/// A vector of these.
#[cube]
pub fn vec3(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3 { x, y, z }
}

/// The three numbers from `at` on.
#[cube]
pub fn load(values: &[f32], at: usize) -> Vec3 {
    vec3(values[at], values[at + 1], values[at + 2])
}

/// Writes the three numbers from `at` on.
#[cube]
pub fn store(values: &mut [f32], at: usize, v: Vec3) {
    values[at] = v.x;
    values[at + 1] = v.y;
    values[at + 2] = v.z;
}

#[cube]
pub fn dot(a: Vec3, b: Vec3) -> f32 {
    a.x * b.x + a.y * b.y + a.z * b.z
}

#[cube]
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    vec3(
        a.y * b.z - a.z * b.y,
        a.z * b.x - a.x * b.z,
        a.x * b.y - a.y * b.x,
    )
}

#[cube]
pub fn scaled(a: Vec3, by: f32) -> Vec3 {
    vec3(a.x * by, a.y * by, a.z * by)
}

#[cube]
pub fn sum(a: Vec3, b: Vec3) -> Vec3 {
    vec3(a.x + b.x, a.y + b.y, a.z + b.z)
}

#[cube]
pub fn difference(a: Vec3, b: Vec3) -> Vec3 {
    vec3(a.x - b.x, a.y - b.y, a.z - b.z)
}

#[cube]
pub fn choose(yes: bool, a: Vec3, b: Vec3) -> Vec3 {
    vec3(
        select(yes, a.x, b.x),
        select(yes, a.y, b.y),
        select(yes, a.z, b.z),
    )
}
