//! Where the camera was at any moment of the video: between its frames, and, where the blur model knows that, while its
//! shutter was open.

use crate::model::Model;
use crate::run::Run;
use crate::views::CameraView;
use glam::{DAffine3, DQuat, DVec3};
use splat_core::camera_center;

/// Moments of an exposure at which the path of a frame is looked up.
const MOMENTS: i32 = 16;

/// A place of the camera.
#[derive(Clone, Copy, Debug)]
struct Knot {
    time: f64,
    /// World from camera.
    rotation: DQuat,
    center: DVec3,
}

impl Knot {
    fn new(time: f64, cam_from_world: &DAffine3) -> Self {
        Self {
            time,
            rotation: DQuat::from_mat3(&cam_from_world.matrix3.transpose()).normalize(),
            center: camera_center(cam_from_world),
        }
    }

    /// The place at a time between two others.
    fn between(&self, next: &Self, time: f64) -> Self {
        let share = ((time - self.time) / (next.time - self.time)).clamp(0.0, 1.0);
        Self {
            time,
            rotation: self.rotation.slerp(next.rotation, share),
            center: self.center.lerp(next.center, share),
        }
    }

    fn cam_from_world(&self) -> DAffine3 {
        DAffine3::from_rotation_translation(self.rotation, self.center).inverse()
    }
}

/// The camera's places, in the order of their times.
#[derive(Debug)]
pub(crate) struct Trajectory {
    knots: Vec<Knot>,
}

impl Trajectory {
    /// Of poses at their times, of which there is at least one. Of several at one time the first counts.
    fn new(poses: impl IntoIterator<Item = (f64, DAffine3)>) -> Self {
        let mut knots: Vec<Knot> = poses
            .into_iter()
            .map(|(time, pose)| Knot::new(time, &pose))
            .collect();
        knots.sort_by(|a, b| a.time.total_cmp(&b.time));
        knots.dedup_by(|a, b| a.time <= b.time);
        Self { knots }
    }

    /// The pose at a time; before the first and after the last place those.
    pub(crate) fn pose(&self, time: f64) -> DAffine3 {
        let next = self.knots.partition_point(|knot| knot.time < time);
        let [before, after] = [next.saturating_sub(1), next.min(self.knots.len() - 1)];
        let (before, after) = (&self.knots[before], &self.knots[after]);
        if after.time <= before.time {
            return after.cam_from_world();
        }
        before.between(after, time).cam_from_world()
    }
}

impl Run {
    /// The camera as it was at a time (training frames, may be fractional): on the learned path while a frame's shutter was
    /// open, else between the frames; before the first frame and after the last where it was then.
    #[must_use]
    pub fn view_at(&self, time: f32) -> CameraView {
        self.view_on(&self.trajectory(), time)
    }

    /// The same at each of several times.
    #[must_use]
    pub fn views_at(&self, times: &[f32]) -> Vec<CameraView> {
        let trajectory = self.trajectory();
        let view = |time: &f32| self.view_on(&trajectory, *time);
        times.iter().map(view).collect()
    }

    /// The same on its trajectory.
    pub(crate) fn view_on(&self, trajectory: &Trajectory, time: f32) -> CameraView {
        let nearest = self.views().train.iter().min_by(|a, b| {
            let away = |view: &CameraView| (view.time - time).abs();
            away(a).total_cmp(&away(b))
        });
        let nearest = nearest.expect("a run has at least one frame");
        CameraView {
            name: format!("at {time}"),
            camera: nearest.camera.clone(),
            cam_from_world: trajectory.pose(f64::from(time)),
            time,
        }
    }

    /// All of it.
    pub(crate) fn trajectory(&self) -> Trajectory {
        let views = &self.views().train;
        let times: Vec<f64> = views.iter().map(|view| f64::from(view.time)).collect();
        let mut poses = Vec::new();
        for (frame, view) in views.iter().enumerate() {
            let time = times[frame];
            // Exposures that would overlap end half-way.
            let others = times.iter().map(|other| (other - time).abs());
            let room = 0.5
                * others
                    .filter(|gap| *gap > 0.0)
                    .fold(f64::INFINITY, f64::min);
            // The middle first: it stays where the shutter is open for no time.
            let moments = (0..=MOMENTS).flat_map(|k| [k, -k]);
            let moments = moments.map(|k| 0.5 * f64::from(k) / f64::from(MOMENTS));
            let Model {
                blur, corrections, ..
            } = self.model();
            let middle = corrections.pose(frame, &view.cam_from_world);
            let taken = blur.taken(frame, &middle, moments);
            let taken = taken.unwrap_or_else(|| vec![(0.0, middle)]);
            let inside = taken.into_iter().filter(|(after, _)| after.abs() <= room);
            poses.extend(inside.map(|(after, pose)| (time + after, pose)));
        }
        Trajectory::new(poses)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    fn at(x: f64, turn: f64) -> DAffine3 {
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(turn), DVec3::X * x).inverse()
    }

    fn center_x(trajectory: &Trajectory, time: f64) -> f64 {
        camera_center(&trajectory.pose(time)).x
    }

    #[test]
    fn between_two_places_it_goes_straight_and_turns_evenly() {
        let trajectory = Trajectory::new([(3.0, at(2.0, FRAC_PI_2)), (1.0, at(1.0, 0.0))]);
        for (time, x) in [
            (-5.0, 1.0),
            (1.0, 1.0),
            (1.5, 1.25),
            (2.0, 1.5),
            (3.0, 2.0),
            (9.0, 2.0),
        ] {
            assert!((center_x(&trajectory, time) - x).abs() < 1e-12, "{time}");
        }
        let halfway = trajectory.pose(2.0).inverse().transform_vector3(DVec3::Z);
        let expected = DQuat::from_rotation_y(0.5 * FRAC_PI_2) * DVec3::Z;
        assert!((halfway - expected).length() < 1e-12, "{halfway}");
    }

    #[test]
    fn one_place_is_where_the_camera_always_is() {
        let trajectory = Trajectory::new([(4.0, at(1.0, 0.3)), (4.0, at(1.0, 0.3))]);
        for time in [0.0, 4.0, 8.0] {
            assert!((center_x(&trajectory, time) - 1.0).abs() < 1e-12);
        }
    }
}
