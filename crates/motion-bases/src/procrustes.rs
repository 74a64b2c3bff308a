//! Weighted rigid alignment of point sets (orthogonal Procrustes; Kabsch 1976, Umeyama 1991).

use glam::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, Vector3};

/// The rigid motion that takes `src` to `dst`: the R and t that minimise Σ w |R src + t - dst|².
///
/// With the weighted means taken off, `C = Σ w dst srcᵀ = U S Vᵀ`, `R = U diag(1, 1, det) Vᵀ`,
/// `t = mean dst - R mean src`. Where the points leave the rotation open, the smallest one is taken:
/// none for coincident points, the shortest arc for points on a line.
///
/// Returns `None` when the lengths differ, a number is not finite, a weight is negative, or no
/// weight is positive.
#[must_use]
pub fn procrustes(src: &[DVec3], dst: &[DVec3], weights: &[f64]) -> Option<DAffine3> {
    if src.len() != dst.len() || src.len() != weights.len() {
        return None;
    }
    let total: f64 = weights.iter().sum();
    let usable = weights.iter().all(|&w| w >= 0.0) && total.is_finite() && total > 0.0;
    if !usable {
        return None;
    }
    let mean = |points: &[DVec3]| -> DVec3 {
        points
            .iter()
            .zip(weights)
            .map(|(&p, &w)| p * (w / total))
            .sum()
    };
    let (mean_src, mean_dst) = (mean(src), mean(dst));
    let mut covariance = Matrix3::zeros();
    // The largest coordinates among the points that count, for a threshold on rounding.
    let mut size = [0.0_f64; 2];
    for ((&a, &b), &w) in src.iter().zip(dst).zip(weights) {
        if w > 0.0 {
            size = [
                size[0].max(a.abs().max_element()),
                size[1].max(b.abs().max_element()),
            ];
        }
        let (a, b) = (a - mean_src, b - mean_dst);
        covariance +=
            Vector3::new(b.x, b.y, b.z) * Vector3::new(a.x, a.y, a.z).transpose() * (w / total);
    }
    if !covariance.iter().all(|v| v.is_finite()) || !mean_src.is_finite() || !mean_dst.is_finite() {
        return None;
    }
    let rotation = best_rotation(covariance, 1e-24 * size[0] * size[1])?;
    Some(DAffine3 {
        matrix3: rotation.into(),
        translation: mean_dst - rotation * mean_src,
    })
}

/// The rotation that maximises tr(Rᵀ C); singular values up to `nothing` are rounding.
fn best_rotation(covariance: Matrix3<f64>, nothing: f64) -> Option<DMat3> {
    let largest = covariance.abs().max();
    if largest <= nothing || largest < f64::MIN_POSITIVE {
        return Some(DMat3::IDENTITY);
    }
    // Scaled, because the decomposition squares the matrix.
    let svd = (covariance / largest).try_svd(true, true, 1e-15, 1000)?;
    let (u, v_t, s) = (svd.u?, svd.v_t?, svd.singular_values);
    let column = |k: usize| DVec3::new(u[(0, k)], u[(1, k)], u[(2, k)]);
    let row = |k: usize| DVec3::new(v_t[(k, 0)], v_t[(k, 1)], v_t[(k, 2)]);
    let rotation = if s[1] <= 1e-6 * s[0] {
        let (from, to) = (row(0).try_normalize()?, column(0).try_normalize()?);
        DMat3::from_quat(DQuat::from_rotation_arc(from, to))
    } else {
        let sign = (u.determinant() * v_t.determinant()).signum();
        let m = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
        DMat3::from_cols_array_2d(&[
            [m[(0, 0)], m[(1, 0)], m[(2, 0)]],
            [m[(0, 1)], m[(1, 1)], m[(2, 1)]],
            [m[(0, 2)], m[(1, 2)], m[(2, 2)]],
        ])
    };
    rotation.is_finite().then_some(rotation)
}
