//! What the given poses foretell of the means of the paths: a hand that turns round while the shutter is open has turned round
//! between the frames before and after, too. By how much more or less the paths themselves say.

use crate::scene_shift::Shared;
use crate::views::CameraView;
use capture::{RIGID, shift_of};
use glam::{DAffine3, DQuat};

/// Shifts whose squares come to less have nothing to say.
const LEAST_SQUARE: f64 = 1e-18;
/// What is foretold is believed whole where it explains so much or more of what the scene cannot show of the means, and in
/// proportion to that below. (RESULTS.md, "Believed by how much they explain", has what was seen.)
const EXPLAINS: f64 = 0.5;

/// Where the scene could show all but such a share of what is foretold (of its square), nothing is foretold: the rest would be told
/// by noise, times a hundred. (RESULTS.md, "Believed by how much they explain", has what was seen.)
const LEAST_OWN: f64 = 0.01;

/// The frames' accelerations, by the poses before and after: turns (rad) and translations (scene sizes) per frame².
#[derive(Clone, Debug)]
pub(super) struct Accelerations {
    /// `None` where there is no frame before or none after.
    frames: Vec<Option<[f64; RIGID]>>,
}

/// How far they shift the means of paths in the image, up to one factor for all.
#[derive(Clone, Debug)]
pub(super) struct Foretold {
    /// Shifts of each frame, per frame²; 0 where they are not known.
    shifts: Vec<[f64; 2]>,
    /// What of them no scene that lies elsewhere shows, of the frames that tell.
    own: Vec<[f64; 2]>,
    own_square: f64,
    /// Frames that tell.
    told: Vec<bool>,
    /// What such a scene shows.
    pub(super) shared: Shared,
}

impl Accelerations {
    /// Of frames in the order of time.
    pub(super) fn of(views: &[CameraView], size: f64) -> Self {
        let frame = |i: usize| {
            let [before, at, after] = [i.checked_sub(1)?, i, i + 1].map(|k| views.get(k));
            let (before, at, after) = (before?, at?, after?);
            let ahead = f64::from(after.time) - f64::from(at.time);
            let back = f64::from(at.time) - f64::from(before.time);
            if ahead.min(back) <= 0.0 {
                return None;
            }
            let [to, from] = [after, before]
                .map(|view| motion(&(view.cam_from_world * at.cam_from_world.inverse()), size));
            let second = |k: usize| 2.0 * (to[k] / ahead + from[k] / back) / (ahead + back);
            Some(std::array::from_fn(second))
        };
        Self {
            frames: (0..views.len()).map(frame).collect(),
        }
    }

    /// Of which of the frames that count something is foretold; of all of them where nothing is of any.
    pub(super) fn known(&self, counted: &[bool]) -> Vec<bool> {
        let frames = self.frames.iter().zip(counted);
        let known: Vec<bool> = frames.map(|(a, counts)| *counts && a.is_some()).collect();
        if known.contains(&true) {
            known
        } else {
            counted.to_vec()
        }
    }

    /// What is foretold of some frames, which are those that tell of what is `shared`.
    pub(super) fn foretold(&self, told: Vec<bool>, shared: Shared) -> Foretold {
        let frames = self.frames.iter().zip(&told);
        let shift = |(a, told): (&Option<[f64; RIGID]>, &bool)| {
            a.filter(|_| *told).map(shift_of).unwrap_or_default()
        };
        let shifts: Vec<_> = frames.map(shift).collect();
        let mut own = own_of(&told, &shared, &shifts);
        let mut own_square = product(&own, &own);
        if own_square < LEAST_OWN * product(&shifts, &shifts) {
            own.fill([0.0; 2]);
            own_square = 0.0;
        }
        Foretold {
            own_square: own_square.max(LEAST_SQUARE),
            own,
            shifts,
            told,
            shared,
        }
    }
}

impl Foretold {
    /// How far it is to be believed of means: from 0, where it explains nothing of what of them the scene cannot show, to 1.
    pub(super) fn belief(&self, means: &[[f64; 2]]) -> f64 {
        let own = self.own_of(means);
        let along = product(&own, &self.own).max(0.0);
        let explained = along * along / (self.own_square * product(&own, &own).max(LEAST_SQUARE));
        (explained / EXPLAINS).min(1.0)
    }

    /// By how far means are not as foretold: with the factor, not negative, that fits best what of them the scene cannot show, times
    /// how far it is believed. A hand that the poses say nothing of is foretold to rest.
    pub(super) fn missed(&self, means: &[[f64; 2]], belief: f64) -> Vec<[f64; 2]> {
        let along = product(&self.own_of(means), &self.own).max(0.0);
        let factor = belief * along / self.own_square;
        let each = means.iter().zip(&self.shifts);
        each.map(|(mean, shift)| [0, 1].map(|axis| mean[axis] - factor * shift[axis]))
            .collect()
    }

    fn own_of(&self, means: &[[f64; 2]]) -> Vec<[f64; 2]> {
        own_of(&self.told, &self.shared, means)
    }
}

/// What of shifts no scene that lies elsewhere shows; 0 of frames that do not tell.
fn own_of(told: &[bool], shared: &Shared, shifts: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let own = shared.own_shifts(shifts).into_iter().zip(told);
    own.map(|(own, told)| if *told { own } else { [0.0; 2] })
        .collect()
}

fn product(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| a * b).sum()
}

/// A small rigid motion as a turn (rad) and a translation in units of `size`.
fn motion(moved: &DAffine3, size: f64) -> [f64; RIGID] {
    let turn = DQuat::from_mat3(&moved.matrix3).to_scaled_axis();
    let shift = moved.translation / size;
    [turn.x, turn.y, turn.z, shift.x, shift.y, shift.z]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_shift::SceneShift;
    use glam::DVec3;
    use splat_core::Camera;

    const TIMES: [f32; 9] = [0.0, 1.0, 2.0, 3.5, 4.0, 5.0, 6.0, 8.0, 9.0];

    /// Cameras that stand and look as `of` a time says.
    fn views(of: impl Fn(f64) -> (DVec3, DVec3)) -> Vec<CameraView> {
        let view = |(k, time): (usize, f32)| {
            let (turn, shift) = of(time.into());
            CameraView {
                name: k.to_string(),
                camera: Camera::pinhole([64, 36], [50.0; 2], [32.0, 18.0]),
                cam_from_world: DAffine3::from_rotation_translation(
                    DQuat::from_scaled_axis(turn),
                    shift,
                ),
                time,
            }
        };
        TIMES.into_iter().enumerate().map(view).collect()
    }

    #[test]
    fn a_camera_that_is_accelerated_evenly_is_so_in_all_frames_but_the_first_and_the_last() {
        let (turn, shift) = (DVec3::new(2e-4, -1e-4, 3e-4), DVec3::new(0.02, -0.01, 0.03));
        let speed = 1e-3;
        let evenly = |t: f64| (0.5 * t * t * turn, 0.5 * t * t * shift + speed * t);
        let found = Accelerations::of(&views(evenly), 2.0).frames;
        assert!(found[0].is_none() && found[8].is_none());
        for frame in &found[1..8] {
            let frame = frame.expect("frames on both sides");
            let expected = [
                turn.x,
                turn.y,
                turn.z,
                shift.x / 2.0,
                shift.y / 2.0,
                shift.z / 2.0,
            ];
            for (found, expected) in frame.iter().zip(expected) {
                // Turns of a few hundredths do not quite add up.
                assert!((found - expected).abs() < 5e-4, "{found} {expected}");
            }
        }
        let still = |_| (DVec3::ZERO, DVec3::ZERO);
        let mut at_once = views(still);
        at_once[3].time = at_once[2].time;
        let found = Accelerations::of(&at_once, 2.0).frames;
        assert!(found[2].is_none() && found[3].is_none() && found[4].is_some());
    }

    /// A hand that shakes, and walks so that there is a scene to drift.
    fn shaking(t: f64) -> (DVec3, DVec3) {
        let turn = 0.02 * DVec3::new((2.1 * t).sin(), (1.3 * t).cos(), 0.0);
        (turn, DVec3::new(-0.3 * t, 0.05 * (0.4 * t).sin(), 0.0))
    }

    /// What is foretold of such frames.
    fn foretold(views: &[CameraView]) -> Foretold {
        let accelerations = Accelerations::of(views, 2.0);
        let told = accelerations.known(&[true; 9]);
        let shared = SceneShift::of(views).among(&[true; 9], &told);
        accelerations.foretold(told, shared)
    }

    fn any() -> Vec<[f64; 2]> {
        let any = |k: usize| 0.01 * (k as f64 + 0.3).sin();
        (0..9).map(|k| [any(2 * k), any(2 * k + 1)]).collect()
    }

    /// The sum of two lists of shifts, the second times a factor.
    fn sum(a: &[[f64; 2]], times: f64, b: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let each = a.iter().zip(b);
        each.map(|(a, b)| [0, 1].map(|axis| a[axis] + times * b[axis]))
            .collect()
    }

    /// NaN where one is.
    fn largest(of: &[[f64; 2]]) -> f64 {
        let all = of.as_flattened().iter().map(|v| v.abs());
        all.max_by(f64::total_cmp).unwrap_or(0.0)
    }

    fn missed(foretold: &Foretold, means: &[[f64; 2]]) -> Vec<[f64; 2]> {
        foretold.missed(means, foretold.belief(means))
    }

    #[test]
    fn the_scene_cannot_take_what_the_poses_foretell_of_paths() {
        let foretold = foretold(&views(shaking));
        let shared = &foretold.shared;
        for factor in [0.0, 0.04, 0.3] {
            // As foretold, but for a scene that lies elsewhere, and for the ends, of which nothing is.
            let mut truth = sum(&[[0.0; 2]; 9], factor, &foretold.shifts);
            truth[0][1] += 0.02;
            truth[8][0] -= 0.03;
            let means = sum(&truth, 1.0, &shared.of_shifts(&any()));
            let scenes = shared.of_shifts(&missed(&foretold, &means));
            let held = sum(&means, -1.0, &scenes);
            let off = |means: &[[f64; 2]]| largest(&sum(means, -1.0, &truth));
            assert!(off(&means) > 1e-3, "{factor}: something is moved");
            assert!(off(&held) < 1e-12, "{factor}");
        }
    }

    /// Where a hand does more than the poses say, they are believed whole as long as that is no more than what they do say.
    #[test]
    fn the_poses_are_believed_by_how_much_they_explain() {
        let foretold = foretold(&views(shaking));
        let of_length_one = |of: &[[f64; 2]]| {
            let length = product(of, of).sqrt();
            (sum(&[[0.0; 2]; 9], length.recip(), of), length)
        };
        let (own, length) = of_length_one(&foretold.own);
        // What nothing foretells and the scene cannot show either.
        let other = foretold.own_of(&any());
        let (other, _) = of_length_one(&sum(&other, -product(&other, &own), &own));
        // Of means with so many times as much of that they explain 1, 0.8, 0.5, 0.2 and 0.1.
        for (times, believed) in [(0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (2.0, 0.4), (3.0, 0.2)] {
            let factor = 0.04;
            let others = sum(&[[0.0; 2]; 9], times * factor * length, &other);
            let means = sum(&others, factor, &foretold.shifts);
            let expected = sum(&means, -factor * believed, &foretold.shifts);
            let off = largest(&sum(&missed(&foretold, &means), -1.0, &expected));
            assert!(off < 1e-15, "{times}: {off}");
        }
    }

    #[test]
    fn where_nothing_is_foretold_means_are_held_to_none() {
        let still = views(|_| (DVec3::ZERO, DVec3::ZERO));
        assert_eq!(missed(&foretold(&still), &any()), any());
        assert_eq!(
            Accelerations::of(&still[..2], 2.0).known(&[true; 2]),
            [true; 2]
        );
        // Nor where the scene could show all of it but for what turns add up to.
        let evenly = views(|t| {
            (
                2e-4 * t * t * DVec3::new(1.0, -0.5, 0.0),
                DVec3::X * 0.1 * t,
            )
        });
        assert!(product(&foretold(&evenly).shifts, &any()).abs() > 1e-6);
        assert_eq!(missed(&foretold(&evenly), &any()), any());
        // Nor where they go against it.
        let foretold = foretold(&views(shaking));
        let against = sum(&[[0.0; 2]; 9], -0.1, &foretold.shifts);
        assert_eq!(missed(&foretold, &against), against);
    }
}
