//! Products of 3 x 3 matrices, row-major.

use super::packs::{Number, array};

/// a b.
#[inline(always)]
pub(super) fn mul3<N: Number>(a: &[N; 9], b: &[N; 9]) -> [N; 9] {
    array(
        #[inline(always)]
        |k| {
            let (i, j) = (k / 3, k % 3);
            a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]
        },
    )
}

/// aᵀ b.
#[inline(always)]
pub(super) fn transpose_mul3<N: Number>(a: &[N; 9], b: &[N; 9]) -> [N; 9] {
    array(
        #[inline(always)]
        |k| {
            let (i, j) = (k / 3, k % 3);
            a[i] * b[j] + a[3 + i] * b[3 + j] + a[6 + i] * b[6 + j]
        },
    )
}

/// a bᵀ.
#[inline(always)]
pub(super) fn mul_transpose3<N: Number>(a: &[N; 9], b: &[N; 9]) -> [N; 9] {
    array(
        #[inline(always)]
        |k| {
            let (i, j) = (k / 3, k % 3);
            a[3 * i] * b[3 * j] + a[3 * i + 1] * b[3 * j + 1] + a[3 * i + 2] * b[3 * j + 2]
        },
    )
}

/// The rotation part of a [3, 4] pose.
#[inline(always)]
pub(super) fn pose_rotation<N: Copy>(pose: &[N; 12]) -> [N; 9] {
    array(
        #[inline(always)]
        |k| pose[4 * (k / 3) + k % 3],
    )
}
