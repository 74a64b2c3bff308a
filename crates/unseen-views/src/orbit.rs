//! Paths around where a video was filmed from: an ellipse and a spiral, as far out as the camera itself went.
//!
//! The spiral is LLFF's (Mildenhall et al. 2019), which many renderers of splats offer.

use std::f64::consts::TAU;

use glam::{DAffine3, DMat3, DVec3};

use crate::camera_path::unit;

/// So large a share of the camera's places lies within the path on each axis.
const QUANTILE: f64 = 0.9;
/// A camera that stood still is gone round at this share of the distance of what it looks at.
const LEAST_SHARE: f64 = 0.02;
/// Turns of the spiral.
const TURNS: f64 = 2.0;

/// A closed path around the mean camera, which looks at one point all the way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    center: DVec3,
    /// Right, down and forward of the mean camera.
    axes: DMat3,
    /// How far the path goes along each, scene units.
    radii: DVec3,
    /// What is looked at.
    focus: DVec3,
}

impl Orbit {
    /// Around cameras (`cam_from_world`), which look at what is `focus_depth` scene units ahead of their mean. The path goes `reach`
    /// times as far as nine tenths of the cameras on each axis, and at least a little.
    ///
    /// `None` where there is no camera, and where they look in opposite directions.
    #[must_use]
    pub fn around(cameras: &[DAffine3], focus_depth: f64, reach: f64) -> Option<Self> {
        let poses: Vec<DAffine3> = cameras.iter().map(DAffine3::inverse).collect();
        let mean = |of: fn(&DAffine3) -> DVec3| {
            poses.iter().map(of).sum::<DVec3>() / poses.len().max(1) as f64
        };
        let forward = unit(mean(|pose| pose.matrix3.z_axis))?;
        let right = unit(mean(|pose| pose.matrix3.y_axis).cross(forward))?;
        let axes = DMat3::from_cols(right, forward.cross(right), forward);
        let center = mean(|pose| pose.translation);
        let least = DVec3::new(LEAST_SHARE, LEAST_SHARE, 0.0) * focus_depth;
        let radii = [0, 1, 2].map(|c| {
            let away = |pose: &DAffine3| (pose.translation - center).dot(axes.col(c)).abs();
            let mut away: Vec<f64> = poses.iter().map(away).collect();
            away.sort_unstable_by(f64::total_cmp);
            away[(QUANTILE * (away.len() - 1) as f64).round() as usize]
        });
        let orbit = Self {
            center,
            axes,
            radii: DVec3::from_array(radii).max(least) * reach,
            focus: center + forward * focus_depth,
        };
        orbit.ellipse(0.0).is_finite().then_some(orbit)
    }

    /// The pose (`cam_from_world`) on an ellipse across the view, at a share of the way round from 0 to 1.
    #[must_use]
    pub fn ellipse(&self, share: f64) -> DAffine3 {
        let angle = TAU * share;
        self.looking_from(DVec3::new(angle.cos(), angle.sin(), 0.0))
    }

    /// The pose on a spiral: twice round, once back and forth.
    #[must_use]
    pub fn spiral(&self, share: f64) -> DAffine3 {
        let angle = TAU * TURNS * share;
        self.looking_from(DVec3::new(angle.cos(), angle.sin(), (angle / TURNS).sin()))
    }

    /// From a place in units of the radii, at the focus.
    fn looking_from(&self, place: DVec3) -> DAffine3 {
        let center = self.center + self.axes * (self.radii * place);
        let forward = (self.focus - center).normalize_or(self.axes.z_axis);
        let right = self
            .axes
            .y_axis
            .cross(forward)
            .normalize_or(self.axes.x_axis);
        let world_from_cam = DMat3::from_cols(right, forward.cross(right), forward);
        DAffine3::from_mat3_translation(world_from_cam, center).inverse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec2};
    use splat_core::camera_center;

    /// Cameras on a line to the right, that look ahead.
    fn cameras(world: DQuat) -> Vec<DAffine3> {
        let at = |i: usize| DVec3::new(0.1 * i as f64 - 0.5, 0.0, 1.0);
        let pose = |i| DAffine3::from_rotation_translation(world, world * at(i)).inverse();
        (0..11).map(pose).collect()
    }

    #[test]
    fn all_of_it_looks_at_the_focus_from_as_far_out_as_the_camera_went() {
        for world in [
            DQuat::IDENTITY,
            DQuat::from_scaled_axis(DVec3::new(0.3, 2.0, -1.0)),
        ] {
            let orbit = Orbit::around(&cameras(world), 4.0, 2.0).expect("a path");
            let focus = world * DVec3::new(0.0, 0.0, 5.0);
            for k in 0..40 {
                let share = f64::from(k) / 40.0;
                for pose in [orbit.ellipse(share), orbit.spiral(share)] {
                    let seen = pose.transform_point3(focus);
                    let off = DVec2::new(seen.x, seen.y).length();
                    assert!(seen.z > 3.0 && off < 1e-9, "{seen}");
                    // As upright as the cameras were.
                    let down = pose.transform_vector3(world * DVec3::Y);
                    assert!(down.x.abs() < 1e-9 && down.y > 0.9, "{down}");
                    let place = world.inverse() * camera_center(&pose);
                    // 0.5 and 0.02 · 4, twice.
                    let [x, y] = [place.x, place.y / 0.16];
                    assert!((x.hypot(y) - 1.0).abs() < 1e-9, "{place}");
                }
            }
        }
    }

    #[test]
    fn paths_close() {
        let orbit = Orbit::around(&cameras(DQuat::IDENTITY), 4.0, 1.0).expect("a path");
        assert!(orbit.ellipse(0.0).abs_diff_eq(orbit.ellipse(1.0), 1e-9));
        assert!(orbit.spiral(0.0).abs_diff_eq(orbit.spiral(1.0), 1e-9));
    }

    #[test]
    fn where_there_is_no_middle_there_is_none() {
        assert_eq!(Orbit::around(&[], 1.0, 1.0), None);
        let turn = |angle| DAffine3::from_quat(DQuat::from_rotation_y(angle));
        assert_eq!(Orbit::around(&[turn(0.0), turn(0.5 * TAU)], 1.0, 1.0), None);
        let lost = DAffine3::from_translation(DVec3::new(f64::NAN, 0.0, 0.0));
        assert_eq!(Orbit::around(&[lost], 1.0, 1.0), None);
        assert!(
            Orbit::around(&[turn(0.3)], 1.0, 1.0).is_some(),
            "it stood still"
        );
    }
}
