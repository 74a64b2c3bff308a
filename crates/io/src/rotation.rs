//! Rotations of files, which are rounded.

use glam::{DAffine3, DMat3, DQuat, DVec3};

/// The nearest rotation to a matrix that is one but for rounding. None where it is not finite, scaled, or
/// mirrored.
pub(crate) fn nearest_rotation(matrix: DMat3) -> Option<DMat3> {
    let excess = matrix.transpose() * matrix - DMat3::IDENTITY;
    let off = excess.to_cols_array().map(f64::abs);
    // Written so that what is not a number is refused.
    let is_rotation = off.iter().all(|&v| v <= 1e-2) && matrix.determinant() > 0.0;
    is_rotation.then(|| DMat3::from_quat(DQuat::from_mat3(&matrix).normalize()))
}

/// The camera at `center` whose axes turn with `world_from_cam`.
pub(crate) fn camera_at(center: DVec3, world_from_cam: DMat3) -> DAffine3 {
    let cam_from_world = world_from_cam.transpose();
    DAffine3::from_mat3_translation(cam_from_world, -(cam_from_world * center))
}

/// The inverse of a camera's pose, world from camera, [4, 4] row-major. None where that is no rigid transform.
pub(crate) fn cam_from_world(pose: &[f32]) -> Option<DAffine3> {
    let at = |row: usize, column: usize| f64::from(pose[4 * row + column]);
    let column = |c: usize| DVec3::new(at(0, c), at(1, c), at(2, c));
    let rotation = nearest_rotation(DMat3::from_cols(column(0), column(1), column(2)))?;
    let center = column(3);
    center.is_finite().then(|| camera_at(center, rotation))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounded_rotations_are_rotations_and_others_are_not() {
        let rotation = DMat3::from_rotation_y(0.7) * DMat3::from_rotation_x(-0.2);
        let rounded = rotation.to_cols_array().map(|v| (1e4 * v).round() / 1e4);
        let found = nearest_rotation(DMat3::from_cols_array(&rounded)).expect("a rotation");
        assert!((found.transpose() * found - DMat3::IDENTITY).abs_diff_eq(DMat3::ZERO, 1e-12));
        assert!(found.abs_diff_eq(rotation, 1e-4));
        let mirror = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        for no_rotation in [1.1 * rotation, mirror, f64::NAN * rotation, DMat3::ZERO] {
            assert!(nearest_rotation(no_rotation).is_none(), "{no_rotation}");
        }
    }

    #[test]
    fn a_camera_is_at_its_centre() {
        let center = DVec3::new(1.0, 2.0, 3.0);
        let camera = camera_at(center, DMat3::from_rotation_z(0.3));
        assert!(camera.transform_point3(center).length() < 1e-12);
    }
}
