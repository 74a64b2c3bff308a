//! Quaternions of posed Gaussians, for files. Not part of any differentiable path.

/// The unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix (row-major).
///
/// The branch on the largest component keeps it accurate near 180° (Shepperd 1978).
#[must_use]
pub fn quat_from_matrix(rotation: &[f64; 9]) -> [f64; 4] {
    let [m00, m01, m02, m10, m11, m12, m20, m21, m22] = *rotation;
    // Four times the square of each component.
    let squares = [
        1.0 + m00 + m11 + m22,
        1.0 + m00 - m11 - m22,
        1.0 - m00 + m11 - m22,
        1.0 - m00 - m11 + m22,
    ];
    let largest = (1..4).fold(
        0,
        |best, k| if squares[k] > squares[best] { k } else { best },
    );
    let twice = squares[largest].max(0.0).sqrt(); // twice the largest component
    let products = match largest {
        0 => [twice * twice, m21 - m12, m02 - m20, m10 - m01],
        1 => [m21 - m12, twice * twice, m10 + m01, m02 + m20],
        2 => [m02 - m20, m10 + m01, twice * twice, m21 + m12],
        _ => [m10 - m01, m02 + m20, m21 + m12, twice * twice],
    };
    let quat = normalized(products);
    if quat[0] < 0.0 {
        quat.map(|v| -v)
    } else {
        quat
    }
}

/// Quaternions of Gaussians after their motion: quat(R) q, both as (w, x, y, z), normalised.
///
/// `rotations` (row-major) belong to the first rows of `quats`; the rows after them are only
/// normalised. A quaternion of length zero counts as no rotation.
#[must_use]
pub fn quats_of_posed(rotations: &[[f64; 9]], quats: &[[f32; 4]]) -> Vec<[f32; 4]> {
    let mut rotations = rotations.iter();
    quats
        .iter()
        .map(|quat| {
            let own = normalized(quat.map(f64::from));
            let posed = rotations.next().map_or(own, |rotation| {
                normalized(product(&quat_from_matrix(rotation), &own))
            });
            posed.map(|v| v as f32)
        })
        .collect()
}

/// The quaternion at length one; (1, 0, 0, 0) where it has none.
fn normalized(quat: [f64; 4]) -> [f64; 4] {
    let norm = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
    if norm > 0.0 && norm.is_finite() {
        quat.map(|v| v / norm)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

/// Hamilton product: first `b`, then `a`.
fn product(a: &[f64; 4], b: &[f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DQuat, DVec3};

    fn rows(m: DMat3) -> [f64; 9] {
        m.transpose().to_cols_array()
    }

    #[test]
    fn every_branch_agrees_with_glam_up_to_sign() {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(0.6, -0.64, 0.48)];
        for axis in axes {
            for angle in [0.0, 1e-9, 0.3, 1.5, 3.0, std::f64::consts::PI, 4.0, 6.2] {
                let expected = DQuat::from_axis_angle(axis, angle);
                let [w, x, y, z] = quat_from_matrix(&rows(DMat3::from_quat(expected)));
                let dot = expected.dot(DQuat::from_xyzw(x, y, z, w)).abs();
                assert!(
                    (dot - 1.0).abs() < 1e-12,
                    "axis {axis}, angle {angle}: |dot| {dot}"
                );
                assert!(w >= 0.0, "axis {axis}, angle {angle}: w = {w}");
            }
        }
    }

    #[test]
    fn posed_quaternions_turn_vectors_as_the_product_of_rotations_does() {
        let motion = DMat3::from_axis_angle(DVec3::new(0.36, 0.48, 0.8), 2.1);
        let own = DQuat::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), -0.7);
        let stored = [own.w, own.x, own.y, own.z].map(|v| 3.0 * v as f32);
        let posed = quats_of_posed(&[rows(motion)], &[stored, stored, [0.0; 4]]);
        let rotate = |q: [f32; 4], v: DVec3| {
            let [w, x, y, z] = q.map(f64::from);
            DQuat::from_xyzw(x, y, z, w) * v
        };
        let v = DVec3::new(1.0, -2.0, 0.5);
        assert!(
            (rotate(posed[0], v) - motion * (own * v)).length() < 1e-6,
            "rotated row"
        );
        assert!(
            (rotate(posed[1], v) - own * v).length() < 1e-6,
            "row without motion"
        );
        assert_eq!(posed[2], [1.0, 0.0, 0.0, 0.0]);
    }
}
