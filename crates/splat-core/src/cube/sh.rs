//! Real spherical harmonics up to degree 3 with the signs and constants of 3DGS.

use cubecl::prelude::*;
use host::cube::vec3::{Vec3, vec3};

use crate::cpu::{C0, C1, C2, C3};

/// Basis functions of degree 3.
pub(super) const BASIS: usize = 16;

/// Values of the basis functions in a unit direction; those over `degree` are left as they are.
#[cube]
pub(super) fn basis(b: &mut Array<f32>, d: Vec3, #[comptime] degree: usize) {
    let (x, y, z) = (d.x, d.y, d.z);
    b[0] = comptime!(C0 as f32);
    if comptime!(degree > 0) {
        let c1 = comptime!(C1 as f32);
        b[1] = -c1 * y;
        b[2] = c1 * z;
        b[3] = -c1 * x;
    }
    if comptime!(degree > 1) {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[4] = comptime!(C2[0] as f32) * x * y;
        b[5] = comptime!(C2[1] as f32) * y * z;
        b[6] = comptime!(C2[2] as f32) * (zz + zz - xx - yy);
        b[7] = comptime!(C2[3] as f32) * x * z;
        b[8] = comptime!(C2[4] as f32) * (xx - yy);
        if comptime!(degree > 2) {
            b[9] = comptime!(C3[0] as f32) * y * (3.0 * xx - yy);
            b[10] = comptime!(C3[1] as f32) * x * y * z;
            b[11] = comptime!(C3[2] as f32) * y * (4.0 * zz - xx - yy);
            b[12] = comptime!(C3[3] as f32) * z * (zz + zz - 3.0 * xx - 3.0 * yy);
            b[13] = comptime!(C3[4] as f32) * x * (4.0 * zz - xx - yy);
            b[14] = comptime!(C3[5] as f32) * z * (xx - yy);
            b[15] = comptime!(C3[6] as f32) * x * (xx - 3.0 * yy);
        }
    }
}

/// Gradient of Σ_b w_b basis_b with respect to the direction (as three free numbers).
#[cube]
pub(super) fn direction_gradient(w: &Array<f32>, d: Vec3, #[comptime] degree: usize) -> Vec3 {
    let (x, y, z) = (d.x, d.y, d.z);
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    if comptime!(degree > 0) {
        let c1 = comptime!(C1 as f32);
        gx = -c1 * w[3];
        gy = -c1 * w[1];
        gz = c1 * w[2];
    }
    if comptime!(degree > 1) {
        let a4 = comptime!(C2[0] as f32) * w[4];
        let a5 = comptime!(C2[1] as f32) * w[5];
        let a6 = comptime!(2.0 * C2[2] as f32) * w[6];
        let a7 = comptime!(C2[3] as f32) * w[7];
        let a8 = comptime!(2.0 * C2[4] as f32) * w[8];
        gx += a4 * y - a6 * x + a7 * z + a8 * x;
        gy += a4 * x + a5 * z - a6 * y - a8 * y;
        gz += a5 * y + 2.0 * a6 * z + a7 * x;
    }
    if comptime!(degree > 2) {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let a0 = comptime!(C3[0] as f32) * w[9];
        let a1 = comptime!(C3[1] as f32) * w[10];
        let a2 = comptime!(C3[2] as f32) * w[11];
        let a3 = comptime!(C3[3] as f32) * w[12];
        let a4 = comptime!(C3[4] as f32) * w[13];
        let a5 = comptime!(C3[5] as f32) * w[14];
        let a6 = comptime!(C3[6] as f32) * w[15];
        gx += a0 * 6.0 * x * y + a1 * y * z - a2 * 2.0 * x * y - a3 * 6.0 * x * z
            + a4 * (4.0 * zz - 3.0 * xx - yy)
            + a5 * 2.0 * x * z
            + a6 * 3.0 * (xx - yy);
        gy += a0 * 3.0 * (xx - yy) + a1 * x * z + a2 * (4.0 * zz - xx - 3.0 * yy)
            - a3 * 6.0 * y * z
            - a4 * 2.0 * x * y
            - a5 * 2.0 * y * z
            - a6 * 6.0 * x * y;
        gz += a1 * x * y
            + a2 * 8.0 * y * z
            + a3 * 3.0 * (zz + zz - xx - yy)
            + a4 * 8.0 * x * z
            + a5 * (xx - yy);
    }
    vec3(gx, gy, gz)
}
