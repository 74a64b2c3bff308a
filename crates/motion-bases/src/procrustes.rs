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
        matrix3: rotation,
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

#[cfg(test)]
mod tests {
    use super::*;
    use arbtest::arbitrary::{Result, Unstructured};
    use property::{property, uniform};

    fn number(u: &mut Unstructured<'_>, size: f64) -> Result<f64> {
        uniform(u, -size, size)
    }

    fn vector(u: &mut Unstructured<'_>, size: f64) -> Result<DVec3> {
        Ok(DVec3::new(
            number(u, size)?,
            number(u, size)?,
            number(u, size)?,
        ))
    }

    fn motion(u: &mut Unstructured<'_>) -> Result<DAffine3> {
        let axis = vector(u, 1.0)?.try_normalize().unwrap_or(DVec3::Z);
        let rotation = DQuat::from_axis_angle(axis, number(u, 3.1)?);
        Ok(DAffine3::from_rotation_translation(
            rotation,
            vector(u, 5.0)?,
        ))
    }

    fn is_rotation(m: DMat3) -> bool {
        (m * m.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-9)
            && (m.determinant() - 1.0).abs() < 1e-9
    }

    #[test]
    fn known_motions_come_back() {
        property("known motions", 500, |u| {
            let truth = motion(u)?;
            // Four points that span space, so that the motion is determined, and random ones.
            let mut src = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
            for _ in 0..u.int_in_range(0..=10)? {
                src.push(vector(u, 2.0)?);
            }
            let dst: Vec<DVec3> = src.iter().map(|&p| truth.transform_point3(p)).collect();
            let weights: Vec<f64> = src
                .iter()
                .map(|_| Ok(1.0 + number(u, 0.9)?))
                .collect::<Result<_>>()?;
            let found = procrustes(&src, &dst, &weights).expect("a motion");
            assert!(found.abs_diff_eq(truth, 1e-7), "{found:?} is not {truth:?}");
            Ok(())
        });
    }

    #[test]
    fn outliers_without_weight_do_not_matter_and_planes_give_no_reflection() {
        let truth = DAffine3::from_rotation_translation(
            DQuat::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 2.0),
            DVec3::new(1.0, -2.0, 3.0),
        );
        let mut src: Vec<DVec3> = (0..12)
            .map(|i| DVec3::new(f64::from(i % 4), f64::from(i / 4), 0.0))
            .collect();
        let mut dst: Vec<DVec3> = src.iter().map(|&p| truth.transform_point3(p)).collect();
        let mut weights = vec![1.0; 12];
        src.push(DVec3::splat(50.0));
        dst.push(DVec3::splat(-70.0));
        weights.push(0.0);
        let found = procrustes(&src, &dst, &weights).expect("a motion");
        assert!(found.abs_diff_eq(truth, 1e-8), "{found:?}");
        weights[12] = 1e-9;
        let found = procrustes(&src, &dst, &weights).expect("a motion");
        assert!(found.abs_diff_eq(truth, 1e-4), "{found:?}");
    }

    #[test]
    fn undetermined_rotations_are_the_smallest() {
        let moved = DVec3::new(3.0, 1.0, -2.0);
        let point = DVec3::new(1e3, -2e3, 5.0);
        for count in [1, 2, 7] {
            let found = procrustes(
                &vec![point; count],
                &vec![point + moved; count],
                &vec![0.3; count],
            );
            let found = found.expect("a motion");
            assert_eq!(found.matrix3, DMat3::IDENTITY, "{count} coincident points");
            assert!(
                found.translation.abs_diff_eq(moved, 1e-9),
                "{count} coincident points"
            );
        }
        // A line that turns by 90 degrees in the plane of x and y: that, and no turn about itself.
        let src: Vec<DVec3> = (0..5).map(|i| DVec3::X * f64::from(i)).collect();
        let dst: Vec<DVec3> = (0..5).map(|i| DVec3::Y * f64::from(i) + moved).collect();
        let found = procrustes(&src, &dst, &[1.0; 5]).expect("a motion");
        let quarter = DAffine3::from_rotation_translation(
            DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
            moved,
        );
        assert!(found.abs_diff_eq(quarter, 1e-7), "{found:?}");
    }

    #[test]
    fn any_points_give_a_rotation() {
        property("any points", 500, |u| {
            let count = u.int_in_range(1..=6)?;
            let size = [1e-9, 1.0, 1e6][u.int_in_range(0..=2)?];
            let (mut src, mut dst, mut weights) = (vec![], vec![], vec![]);
            for _ in 0..count {
                src.push(vector(u, size)?);
                dst.push(vector(u, size)?);
                weights.push(number(u, 1.0)?.abs() + 1e-6);
            }
            let found = procrustes(&src, &dst, &weights).expect("a motion");
            assert!(is_rotation(found.matrix3) && found.is_finite(), "{found:?}");
            Ok(())
        });
    }

    #[test]
    fn unusable_input_gives_none() {
        let p = [DVec3::ZERO, DVec3::X];
        assert_eq!(procrustes(&p, &p[..1], &[1.0, 1.0]), None);
        assert_eq!(procrustes(&p, &p, &[1.0]), None);
        assert_eq!(procrustes(&[], &[], &[]), None);
        assert_eq!(procrustes(&p, &p, &[0.0, 0.0]), None);
        assert_eq!(procrustes(&p, &p, &[1.0, -0.5]), None);
        assert_eq!(procrustes(&p, &p, &[1.0, f64::NAN]), None);
        assert_eq!(procrustes(&p, &[DVec3::NAN, DVec3::X], &[1.0, 1.0]), None);
    }
}
