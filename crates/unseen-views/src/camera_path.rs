//! Camera poses on and beside a camera's path.
//!
//! Both functions take and return `cam_from_world`. Where the path itself has no camera, two kinds of
//! pose are made from two neighbours on it: one half-way between them, and one beside the path, across it.

use glam::{DAffine3, DMat3, DVec3};

/// Below this length an average of two unit axes says nothing about a direction.
const MIN_AXIS: f64 = 1e-6;
/// Below this sine between viewing direction and baseline their normal is rounding noise.
const MIN_SINE: f64 = 1e-6;
/// A baseline below this share of the centres' distance from the origin is rounding noise.
const MIN_BASELINE: f64 = 1e-9;

/// The camera's pose half-way between two neighbours: centres averaged, axes averaged and made orthonormal.
///
/// The viewing direction is the mean of the two, and x is perpendicular to it and to the mean of the
/// two y axes. For two poses that differ by a turn about one of the camera's own axes this is half of that
/// turn, and for any other small turn nearly so.
///
/// `None` where the mean has no direction (cameras that look opposite ways, or are upside down to
/// each other) and where a pose holds a number that is not finite.
#[must_use]
pub fn parallel_pose(a: &DAffine3, b: &DAffine3) -> Option<DAffine3> {
    let (world_from_a, world_from_b) = (a.inverse(), b.inverse());
    let mean = |axis: fn(&DMat3) -> DVec3| {
        (axis(&world_from_a.matrix3) + axis(&world_from_b.matrix3)) * 0.5
    };
    let z = unit(mean(|m| m.z_axis))?;
    let x = unit(mean(|m| m.y_axis).cross(z))?;
    let y = z.cross(x);
    let center = (world_from_a.translation + world_from_b.translation) * 0.5;
    let cam_from_world_rotation = DMat3::from_cols(x, y, z).transpose();
    let cam_from_world = DAffine3::from_mat3_translation(
        cam_from_world_rotation,
        -(cam_from_world_rotation * center),
    );
    cam_from_world.is_finite().then_some(cam_from_world)
}

/// The camera's pose `a` with its centre moved by `offset` (scene units, either sign) across the path.
///
/// The direction is that of `a`'s viewing direction x the baseline from `a` to `b`: for a camera that
/// moves to its right, a positive offset moves it along its y axis, which is down. Where this has no
/// direction, because the pair stands still or moves straight along the view, `a`'s y axis is taken.
///
/// Where one of the two poses is not finite, the result is not finite.
#[must_use]
pub fn perpendicular_pose(a: &DAffine3, b: &DAffine3, offset: f64) -> DAffine3 {
    let world_from_a = a.inverse();
    let (center_a, center_b) = (world_from_a.translation, b.inverse().translation);
    if !center_b.is_finite() {
        // It has no direction then, which must not pass for that of a pair that stands still.
        return DAffine3::from_mat3_translation(a.matrix3, DVec3::NAN);
    }
    let baseline = center_b - center_a;
    let noise = MIN_BASELINE * center_a.length().max(center_b.length());
    let view = world_from_a.matrix3.z_axis;
    let across = if baseline.length() > noise {
        baseline.try_normalize().and_then(|baseline| {
            let normal = view.cross(baseline);
            (normal.length() > MIN_SINE).then(|| normal.normalize_or_zero())
        })
    } else {
        None
    };
    let direction = across.unwrap_or(world_from_a.matrix3.y_axis);
    let center = center_a + direction * offset;
    DAffine3::from_mat3_translation(a.matrix3, -(a.matrix3 * center))
}

/// The unit vector along `v`, unless `v` is too short to have a direction.
pub(crate) fn unit(v: DVec3) -> Option<DVec3> {
    let length = v.length();
    (length.is_finite() && length > MIN_AXIS).then(|| v / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use arbtest::arbitrary::{Result, Unstructured};
    use glam::DQuat;
    use property::property;
    use splat_core::camera_center;

    fn number(u: &mut Unstructured<'_>, limit: f64) -> Result<f64> {
        Ok(f64::from(u.int_in_range(-10_000..=10_000)?) * 1e-4 * limit)
    }

    fn vector(u: &mut Unstructured<'_>, limit: f64) -> Result<DVec3> {
        Ok(DVec3::new(
            number(u, limit)?,
            number(u, limit)?,
            number(u, limit)?,
        ))
    }

    fn pose(u: &mut Unstructured<'_>) -> Result<DAffine3> {
        Ok(DAffine3::from_rotation_translation(
            DQuat::from_scaled_axis(vector(u, 3.0)?),
            vector(u, 100.0)?,
        ))
    }

    /// The pose of a camera with a rotation (`world_from_cam`) at a centre.
    fn at(rotation: DQuat, center: DVec3) -> DAffine3 {
        DAffine3::from_rotation_translation(rotation, center).inverse()
    }

    fn assert_rigid(pose: &DAffine3) {
        let off = pose.matrix3 * pose.matrix3.transpose() - DMat3::IDENTITY;
        assert!(
            off.to_cols_array().iter().all(|v| v.abs() < 1e-9),
            "not a rotation: {off}"
        );
        let determinant = pose.matrix3.determinant();
        assert!(
            (determinant - 1.0).abs() < 1e-9,
            "determinant {determinant}"
        );
    }

    #[test]
    fn a_pose_is_half_way_between_itself_and_itself() {
        property("a_pose_is_half_way_between_itself_and_itself", 500, |u| {
            let a = pose(u)?;
            let middle = parallel_pose(&a, &a).expect("a pose has a direction");
            assert!(
                middle.abs_diff_eq(a, 1e-9),
                "{a:?} became {middle:?} half-way to itself"
            );
            Ok(())
        });
    }

    #[test]
    fn half_way_is_rigid_and_does_not_depend_on_the_order() {
        property(
            "half_way_is_rigid_and_does_not_depend_on_the_order",
            500,
            |u| {
                let (a, b) = (pose(u)?, pose(u)?);
                let (ab, ba) = (parallel_pose(&a, &b), parallel_pose(&b, &a));
                assert_eq!(ab, ba, "the order of the pair decided");
                if let Some(pose) = ab {
                    assert_rigid(&pose);
                    let expected = (camera_center(&a) + camera_center(&b)) * 0.5;
                    let distance = camera_center(&pose).distance(expected);
                    assert!(distance < 1e-9, "{distance} off the midpoint");
                }
                Ok(())
            },
        );
    }

    /// The pose of a camera that looks anywhere, turned about an axis of its own.
    fn turned(axis: DVec3, angle: f64) -> DAffine3 {
        let somewhere = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0);
        let turn = DQuat::from_axis_angle(axis, angle);
        at(somewhere * turn, DVec3::new(1.0, 2.0, 3.0))
    }

    #[test]
    fn half_of_a_turn_about_an_axis_of_the_camera_is_half_the_angle() {
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let (a, b) = (turned(axis, 0.0), turned(axis, 0.6));
            let middle = parallel_pose(&a, &b).expect("a direction");
            assert!(
                middle.abs_diff_eq(turned(axis, 0.3), 1e-12),
                "about {axis}: {middle:?} is not half the turn"
            );
        }
    }

    #[test]
    fn half_of_a_small_turn_is_half_the_angle_but_for_its_square() {
        let axis = DVec3::new(0.48, -0.6, 0.64);
        for angle in [1e-3, 0.01, 0.1] {
            let (a, b) = (turned(axis, 0.0), turned(axis, angle));
            let middle = parallel_pose(&a, &b).expect("a direction").matrix3;
            let half = turned(axis, 0.5 * angle).matrix3;
            assert!(
                middle.abs_diff_eq(half, 0.125 * angle * angle),
                "{angle}: {middle:?} is far from half the turn"
            );
        }
    }

    #[test]
    fn poses_without_a_middle_give_none() {
        let forward = at(DQuat::IDENTITY, DVec3::ZERO);
        let backward = at(
            DQuat::from_rotation_y(std::f64::consts::PI),
            DVec3::new(1.0, 0.0, 0.0),
        );
        let upside_down = at(DQuat::from_rotation_z(std::f64::consts::PI), DVec3::ZERO);
        let lost = DAffine3::from_translation(DVec3::new(f64::NAN, 0.0, 0.0));
        for (name, other) in [
            ("backward", backward),
            ("upside down", upside_down),
            ("not a number", lost),
        ] {
            assert_eq!(parallel_pose(&forward, &other), None, "{name}");
        }
    }

    #[test]
    fn across_a_path_to_the_right_is_down() {
        let a = at(DQuat::IDENTITY, DVec3::new(0.5, 0.0, 1.0));
        let b = at(DQuat::from_rotation_x(0.2), DVec3::new(0.75, 0.0, 1.25));
        let moved = perpendicular_pose(&a, &b, 0.25);
        assert_eq!(moved.matrix3, a.matrix3, "the rotation changed");
        let center = camera_center(&moved);
        assert!(
            center.distance(DVec3::new(0.5, 0.25, 1.0)) < 1e-12,
            "moved to {center}"
        );
    }

    #[test]
    fn across_is_perpendicular_to_view_and_baseline_and_as_far_as_told() {
        property(
            "across_is_perpendicular_to_view_and_baseline_and_as_far_as_told",
            500,
            |u| {
                let (a, b, offset) = (pose(u)?, pose(u)?, number(u, 2.0)?);
                let moved = perpendicular_pose(&a, &b, offset);
                assert_eq!(moved.matrix3, a.matrix3, "the rotation changed");
                let step = camera_center(&moved) - camera_center(&a);
                assert!(
                    (step.length() - offset.abs()).abs() < 1e-9,
                    "moved by {} instead of {offset}",
                    step.length()
                );
                let view = a.inverse().matrix3.z_axis;
                assert!(step.dot(view).abs() < 1e-9, "moved along the view");
                let baseline = (camera_center(&b) - camera_center(&a)).normalize_or_zero();
                if view.cross(baseline).length() > 1e-3 {
                    assert!(step.dot(baseline).abs() < 1e-9, "moved along the path");
                }
                Ok(())
            },
        );
    }

    #[test]
    fn a_pose_that_is_not_finite_gives_none_that_is() {
        let good = at(DQuat::from_rotation_x(0.2), DVec3::new(0.75, 0.0, 1.25));
        let wrong = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY].map(|v| {
            let shift = DVec3::new(0.0, v, 0.0);
            DAffine3::from_mat3_translation(good.matrix3, shift)
        });
        let mut skew = good;
        skew.matrix3.y_axis.z = f64::NAN;
        // Without an inverse it has no centre.
        let flat = DAffine3::from_mat3_translation(DMat3::ZERO, DVec3::X);
        for bad in wrong.into_iter().chain([skew, flat]) {
            for (a, b) in [(good, bad), (bad, good), (bad, bad)] {
                let beside = perpendicular_pose(&a, &b, 0.25);
                assert!(!beside.is_finite(), "{a:?}, {b:?}: {beside:?}");
            }
        }
    }

    #[test]
    fn a_still_pair_and_one_that_moves_along_the_view_take_the_y_axis() {
        let rotation = DQuat::from_rotation_z(0.7);
        let a = at(rotation, DVec3::new(3.0, -2.0, 5.0));
        let ahead = at(rotation, DVec3::new(3.0, -2.0, 6.0));
        // Noise of a few rounding steps on a still camera is no baseline.
        let noise = at(rotation, DVec3::new(3.0 + 1e-15, -2.0, 5.0));
        for (name, b) in [("still", a), ("ahead", ahead), ("noise", noise)] {
            let step = camera_center(&perpendicular_pose(&a, &b, -0.5)) - camera_center(&a);
            let expected = rotation * DVec3::Y * -0.5;
            assert!(
                step.distance(expected) < 1e-12,
                "{name}: moved by {step}, not {expected}"
            );
        }
    }
}
