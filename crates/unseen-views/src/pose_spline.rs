//! A smooth path through given poses: Catmull–Rom with uneven spacing, on centres and on quaternions.

use glam::{DAffine3, DQuat, DVec3};

/// A camera's place at a moment of the path.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Knot {
    at: f64,
    center: DVec3,
    /// World from camera; of the two of a rotation the one nearer to the knot before.
    rotation: DQuat,
}

/// Poses at moments, and the path through them. Where two neighbours are the same, the path rests.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseSpline {
    knots: Vec<Knot>,
}

impl PoseSpline {
    /// Through poses (`cam_from_world`) at increasing moments.
    ///
    /// `None` where there is none, where moments do not increase, and where a number is none.
    #[must_use]
    pub fn new(poses: impl IntoIterator<Item = (f64, DAffine3)>) -> Option<Self> {
        let mut knots: Vec<Knot> = Vec::new();
        for (at, cam_from_world) in poses {
            let pose = cam_from_world.inverse();
            let mut rotation = DQuat::from_mat3(&pose.matrix3).normalize();
            let increases = match knots.last() {
                Some(last) if rotation.dot(last.rotation) < 0.0 => {
                    rotation = -rotation;
                    at > last.at
                }
                Some(last) => at > last.at,
                None => at.is_finite(),
            };
            let center = pose.translation;
            if !increases || !at.is_finite() || !center.is_finite() || !rotation.is_finite() {
                return None;
            }
            knots.push(Knot {
                at,
                center,
                rotation,
            });
        }
        (!knots.is_empty()).then_some(Self { knots })
    }

    /// The pose (`cam_from_world`) at a moment; before the first and after the last that one's.
    #[must_use]
    pub fn pose(&self, at: f64) -> DAffine3 {
        let last = self.knots.len() - 1;
        let next = self.knots.partition_point(|knot| knot.at <= at);
        let (a, b) = (next.saturating_sub(1), next.min(last));
        let Knot {
            at: begin,
            center,
            rotation,
        } = self.knots[a];
        if a == b {
            return DAffine3::from_rotation_translation(rotation, center).inverse();
        }
        let end = self.knots[b];
        let length = end.at - begin;
        let s = ((at - begin) / length).clamp(0.0, 1.0);
        // Hermite's polynomials of the two ends and of their tangents.
        let of_end = s * s * (3.0 - 2.0 * s);
        let [of_tangent, of_end_tangent] =
            [s * (1.0 - s) * (1.0 - s), s * s * (s - 1.0)].map(|v| v * length);
        let [(v, w), (v_end, w_end)] = [a, b].map(|i| self.tangent(i));
        let center =
            center + (end.center - center) * of_end + v * of_tangent + v_end * of_end_tangent;
        let straight = rotation * (1.0 - of_end) + end.rotation * of_end;
        let curved = straight + w * of_tangent + w_end * of_end_tangent;
        // Half a turn and more between two neighbours: the short way round, without a curve.
        let rotation = if curved.length() > 0.1 {
            curved.normalize()
        } else {
            rotation.slerp(end.rotation, s)
        };
        DAffine3::from_rotation_translation(rotation, center).inverse()
    }

    /// How centre and quaternion change at a knot.
    fn tangent(&self, i: usize) -> (DVec3, DQuat) {
        let (before, after) = (i.saturating_sub(1), (i + 1).min(self.knots.len() - 1));
        let (a, b) = (self.knots[before], self.knots[after]);
        let is_same = |j: usize| {
            let (knot, other) = (self.knots[i], self.knots[j]);
            j != i && (knot.center, knot.rotation) == (other.center, other.rotation)
        };
        if is_same(before) || is_same(after) {
            return (DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0));
        }
        let length = b.at - a.at;
        (
            (b.center - a.center) / length,
            (b.rotation - a.rotation) * (1.0 / length),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_core::camera_center;

    fn at(x: f64, turn: f64) -> DAffine3 {
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(turn), DVec3::X * x).inverse()
    }

    #[test]
    fn it_goes_through_its_poses_and_stays_at_its_ends() {
        let poses = [
            (1.0, at(0.0, 0.0)),
            (2.0, at(3.0, 1.0)),
            (5.0, at(1.0, 3.0)),
            (6.0, at(1.0, 6.0)),
        ];
        let spline = PoseSpline::new(poses).expect("a path");
        for (moment, pose) in poses {
            assert!(spline.pose(moment).abs_diff_eq(pose, 1e-9), "{moment}");
        }
        assert!(spline.pose(-3.0).abs_diff_eq(poses[0].1, 1e-9));
        assert!(spline.pose(9.0).abs_diff_eq(poses[3].1, 1e-9));
    }

    #[test]
    fn even_motion_stays_even_and_speed_never_jumps() {
        let poses = [0.0, 1.0, 4.0, 5.0].map(|t| (t, at(2.0 * t, 0.0)));
        let spline = PoseSpline::new(poses).expect("a path");
        for k in 0..=50 {
            let t = f64::from(k) / 10.0;
            let x = camera_center(&spline.pose(t)).x;
            assert!((x - 2.0 * t).abs() < 1e-9, "{t}: {x}");
        }
        let bent = [
            (0.0, at(0.0, 0.0)),
            (1.0, at(1.0, 0.5)),
            (3.0, at(0.0, 0.2)),
        ];
        let spline = PoseSpline::new(bent).expect("a path");
        let step = 1e-6;
        let speed = |t: f64| {
            let [a, b] = [t, t + step].map(|t| spline.pose(t).inverse());
            (b.translation - a.translation) / step
        };
        assert!((speed(1.0 - 2.0 * step) - speed(1.0)).length() < 1e-4);
    }

    #[test]
    fn between_equal_poses_it_rests() {
        let poses = [
            (0.0, at(0.0, 0.0)),
            (1.0, at(1.0, 0.4)),
            (2.0, at(1.0, 0.4)),
            (3.0, at(5.0, 0.0)),
        ];
        let spline = PoseSpline::new(poses).expect("a path");
        for t in [1.0, 1.3, 1.9] {
            assert!(spline.pose(t).abs_diff_eq(poses[1].1, 1e-9), "{t}");
        }
    }

    #[test]
    fn every_pose_on_it_is_rigid() {
        let poses = [
            (0.0, at(0.0, 0.0)),
            (1.0, at(1.0, 3.1)),
            (2.0, at(1.0, -3.1)),
            (2.5, at(0.0, 0.0)),
        ];
        let spline = PoseSpline::new(poses).expect("a path");
        for k in 0..100 {
            let m = spline.pose(f64::from(k) / 40.0).matrix3;
            assert!((m.determinant() - 1.0).abs() < 1e-9);
            assert!((m * m.transpose()).abs_diff_eq(glam::DMat3::IDENTITY, 1e-9));
        }
    }

    #[test]
    fn what_is_no_path_is_none() {
        assert_eq!(PoseSpline::new([]), None);
        assert_eq!(
            PoseSpline::new([(1.0, at(0.0, 0.0)), (1.0, at(1.0, 0.0))]),
            None
        );
        assert_eq!(PoseSpline::new([(f64::NAN, at(0.0, 0.0))]), None);
        assert_eq!(PoseSpline::new([(0.0, at(f64::NAN, 0.0))]), None);
    }
}
