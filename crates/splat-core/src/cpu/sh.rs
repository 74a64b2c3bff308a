//! Real spherical harmonics up to degree 3 with the signs and constants of 3DGS.

use super::packs::{Number, array};

pub(crate) const C0: f64 = 0.282_094_791_773_878_14;
pub(crate) const C1: f64 = 0.488_602_511_902_919_9;
pub(crate) const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
pub(crate) const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Number of coefficients up to a degree.
pub(super) fn num_coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Values of the basis functions in a unit direction; those over `degree` stay 0.
#[inline(always)]
pub(super) fn basis<N: Number>(degree: usize, [x, y, z]: [N; 3]) -> [N; 16] {
    let c = |value| x.like(value);
    let mut b = [c(0.0); 16];
    b[0] = c(C0);
    if degree == 0 {
        return b;
    }
    b[1] = -c(C1) * y;
    b[2] = c(C1) * z;
    b[3] = -c(C1) * x;
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    b[4] = c(C2[0]) * x * y;
    b[5] = c(C2[1]) * y * z;
    b[6] = c(C2[2]) * (zz + zz - xx - yy);
    b[7] = c(C2[3]) * x * z;
    b[8] = c(C2[4]) * (xx - yy);
    if degree == 2 {
        return b;
    }
    let three = c(3.0);
    b[9] = c(C3[0]) * y * (three * xx - yy);
    b[10] = c(C3[1]) * x * y * z;
    b[11] = c(C3[2]) * y * (c(4.0) * zz - xx - yy);
    b[12] = c(C3[3]) * z * (zz + zz - three * xx - three * yy);
    b[13] = c(C3[4]) * x * (c(4.0) * zz - xx - yy);
    b[14] = c(C3[5]) * z * (xx - yy);
    b[15] = c(C3[6]) * x * (xx - three * yy);
    b
}

/// Gradient of Σ_b weight_b basis_b with respect to the direction (as three free numbers).
#[inline(always)]
pub(super) fn direction_gradient<N: Number>(
    degree: usize,
    [x, y, z]: [N; 3],
    w: &[N; 16],
) -> [N; 3] {
    let c = |value| x.like(value);
    if degree == 0 {
        return [c(0.0); 3];
    }
    let c1 = c(C1);
    let mut g = [-c1 * w[3], -c1 * w[1], c1 * w[2]];
    if degree == 1 {
        return g;
    }
    let two = c(2.0);
    let (a4, a5, a7) = (c(C2[0]) * w[4], c(C2[1]) * w[5], c(C2[3]) * w[7]);
    let (a6, a8) = (two * c(C2[2]) * w[6], two * c(C2[4]) * w[8]);
    g[0] += a4 * y - a6 * x + a7 * z + a8 * x;
    g[1] += a4 * x + a5 * z - a6 * y - a8 * y;
    g[2] += a5 * y + two * a6 * z + a7 * x;
    if degree == 2 {
        return g;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (three, four, six, eight) = (c(3.0), c(4.0), c(6.0), c(8.0));
    let a: [N; 7] = array(
        #[inline(always)]
        |k| c(C3[k]) * w[9 + k],
    );
    g[0] += a[0] * six * x * y + a[1] * y * z - a[2] * two * x * y - a[3] * six * x * z
        + a[4] * (four * zz - three * xx - yy)
        + a[5] * two * x * z
        + a[6] * three * (xx - yy);
    g[1] += a[0] * three * (xx - yy) + a[1] * x * z + a[2] * (four * zz - xx - three * yy)
        - a[3] * six * y * z
        - a[4] * two * x * y
        - a[5] * two * y * z
        - a[6] * six * x * y;
    g[2] += a[1] * x * y
        + a[2] * eight * y * z
        + a[3] * three * (zz + zz - xx - yy)
        + a[4] * eight * x * z
        + a[5] * (xx - yy);
    g
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Number for f64 {
        fn like(self, value: f64) -> Self {
            value
        }
    }

    #[test]
    fn basis_is_orthonormal_on_the_sphere() {
        // Products of degree-3 functions are polynomials of degree 6: Gauss-Legendre with 8 nodes in
        // z and 16 equal steps in longitude integrate them exactly.
        let nodes = [
            (0.183_434_642_495_649_8, 0.362_683_783_378_362),
            (0.525_532_409_916_329, 0.313_706_645_877_887_3),
            (0.796_666_477_413_626_7, 0.222_381_034_453_374_48),
            (0.960_289_856_497_536_3, 0.101_228_536_290_376_26),
        ];
        let mut gram = [[0.0_f64; 16]; 16];
        for (node, weight) in nodes {
            for z in [node, -node] {
                for k in 0..16 {
                    let phi = std::f64::consts::TAU * f64::from(k) / 16.0;
                    let r = f64::sqrt(1.0 - z * z);
                    let b = basis(3, [r * phi.cos(), r * phi.sin(), z]);
                    for i in 0..16 {
                        for j in 0..16 {
                            gram[i][j] += weight * std::f64::consts::TAU / 16.0 * b[i] * b[j];
                        }
                    }
                }
            }
        }
        for i in 0..16 {
            for j in 0..16 {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!(
                    (gram[i][j] - expected).abs() < 1e-12,
                    "<b{i}, b{j}> = {}",
                    gram[i][j]
                );
            }
        }
    }

    #[test]
    fn direction_gradient_is_the_derivative_of_the_basis() {
        let d = [0.3_f64, -0.7, 0.5];
        let w: [f64; 16] = std::array::from_fn(|k| (k as f64 * 1.7).sin());
        for degree in 0..=3 {
            let value =
                |d: [f64; 3]| -> f64 { basis(degree, d).iter().zip(&w).map(|(b, w)| b * w).sum() };
            let g = direction_gradient(degree, d, &w);
            for axis in 0..3 {
                let (mut plus, mut minus) = (d, d);
                plus[axis] += 1e-5;
                minus[axis] -= 1e-5;
                let numeric = (value(plus) - value(minus)) / 2e-5;
                assert!(
                    (g[axis] - numeric).abs() < 1e-8,
                    "degree {degree}, axis {axis}: {} against {numeric}",
                    g[axis]
                );
            }
        }
    }
}
