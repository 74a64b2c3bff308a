//! Vectors of three numbers.

use host::Real;

/// x, y, z.
pub(crate) type Vec3<T> = [T; 3];

#[inline(always)]
pub(crate) fn dot<T: Real>(a: Vec3<T>, b: Vec3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

#[inline(always)]
pub(crate) fn scaled<T: Real>(a: Vec3<T>, by: T) -> Vec3<T> {
    a.map(|v| v * by)
}

#[inline(always)]
pub(crate) fn sum<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(crate) fn difference<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn select<T: Real>(yes: bool, a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [0, 1, 2].map(|i| if yes { a[i] } else { b[i] })
}
