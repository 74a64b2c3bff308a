//! What the given poses foretell of the means of the paths: a hand that turns round while the shutter is open has turned round
//! between the frames before and after, too. By how much more or less the paths themselves say.

use crate::scene_shift::Shared;
use crate::views::CameraView;
use burn::tensor::{DType, Device, Tensor, TensorData};
use capture::{RIGID, shift_in_image};
use glam::{DAffine3, DQuat};

/// Shifts whose squares come to less have nothing to say. The product of two such is a normal number in f32 as well.
const LEAST_SQUARE: f64 = 1e-18;
/// What is foretold is believed whole where it explains so much or more of what the scene cannot show of the means, and in
/// proportion to that below. (RESULTS.md, "Believed by how much they explain", has what was seen.)
const EXPLAINS: f64 = 0.5;

/// The frames' accelerations, by the poses before and after: turns (rad) and translations (scene sizes) per frame².
#[derive(Clone, Debug)]
pub(super) struct Accelerations {
    /// `None` where there is no frame before or none after.
    frames: Vec<Option<[f64; RIGID]>>,
}

/// How far they shift the means of paths in the image, up to one factor for all.
#[derive(Clone, Debug)]
pub(super) struct Foretold {
    /// Shifts per frame², [N, 2]; 0 where they are not known.
    shifts: Tensor<2>,
    /// What of them no scene that lies elsewhere shows, of the frames that tell.
    own: Tensor<2>,
    own_square: Tensor<1>,
    /// 1 at the shifts of frames that tell, 0 at others.
    told: Tensor<2>,
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
    pub(super) fn foretold(
        &self,
        told: &[bool],
        shared: &Shared,
        options: (&Device, DType),
    ) -> Foretold {
        let table = |values: Vec<f64>, columns: usize| {
            Tensor::<2>::from_data(TensorData::new(values, [told.len(), columns]), options)
        };
        let rows = self.frames.iter().zip(told);
        let rows = rows.flat_map(|(a, told)| a.filter(|_| *told).unwrap_or_default());
        let shifts = shift_in_image(table(rows.collect(), RIGID));
        let told = told.iter().flat_map(|told| [f64::from(u8::from(*told)); 2]);
        let told = table(told.collect(), 2);
        let own = shared.own_shifts(shifts.clone()) * told.clone();
        Foretold {
            own_square: square(&own),
            own,
            shifts,
            told,
            shared: shared.clone(),
        }
    }
}

impl Foretold {
    /// How far it is to be believed of means [N, 2]; [1, 1], from 0, where it explains nothing of what of them the scene cannot show,
    /// to 1.
    pub(super) fn belief(&self, means: Tensor<2>) -> Tensor<2> {
        let own = self.own_of(means);
        let product = (own.clone() * self.own.clone()).sum().clamp_min(0.0);
        let explained = product.square() / (self.own_square.clone() * square(&own));
        let belief = explained / EXPLAINS;
        belief.clamp_max(1.0).reshape([1, 1])
    }

    /// By how far means [N, 2] are not as foretold: with the factor, not negative, that fits best what of them the scene cannot
    /// show, times how far it is believed. A hand that the poses say nothing of is foretold to rest.
    pub(super) fn missed(&self, means: Tensor<2>, belief: Tensor<2>) -> Tensor<2> {
        let product = (self.own_of(means.clone()) * self.own.clone()).sum();
        let factor = product.clamp_min(0.0) / self.own_square.clone();
        means - self.shifts.clone() * (factor.reshape([1, 1]) * belief)
    }

    fn own_of(&self, means: Tensor<2>) -> Tensor<2> {
        self.shared.own_shifts(means) * self.told.clone()
    }
}

fn square(of: &Tensor<2>) -> Tensor<1> {
    of.clone().square().sum().clamp_min(LEAST_SQUARE)
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

    fn options_of(device: &Device) -> (&Device, DType) {
        (device, DType::F64)
    }

    fn values(tensor: Tensor<2>) -> Vec<f64> {
        tensor.try_into_vec_as::<f64>().expect("f64")
    }

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

    /// What is foretold of such frames, and what they share.
    fn foretold(views: &[CameraView], device: &Device) -> (Foretold, Shared) {
        let accelerations = Accelerations::of(views, 2.0);
        let told = accelerations.known(&[true; 9]);
        let shared = SceneShift::of(views).among(&[true; 9], &told, options_of(device));
        let foretold = accelerations.foretold(&told, &shared, options_of(device));
        (foretold, shared)
    }

    fn any(device: &Device) -> Tensor<2> {
        let any: Vec<f64> = (0..18).map(|k| 0.01 * (f64::from(k) + 0.3).sin()).collect();
        Tensor::from_data(TensorData::new(any, [9, 2]), options_of(device))
    }

    fn missed(foretold: &Foretold, means: Tensor<2>) -> Tensor<2> {
        foretold.missed(means.clone(), foretold.belief(means))
    }

    #[test]
    fn the_scene_cannot_take_what_the_poses_foretell_of_paths() {
        let device = Device::flex();
        let (foretold, shared) = foretold(&views(shaking), &device);
        for factor in [0.0, 0.04, 0.3] {
            // As foretold, but for a scene that lies elsewhere, and for the ends, of which nothing is.
            let truth = foretold.shifts.clone() * factor;
            let moved = truth.clone() + shared.of_shifts(any(&device));
            let mut ends = vec![0.0; 18];
            (ends[1], ends[16]) = (0.02, -0.03);
            let ends = Tensor::<2>::from_data(TensorData::new(ends, [9, 2]), options_of(&device));
            let means = moved.clone() + ends.clone();
            let held = means.clone() - shared.of_shifts(missed(&foretold, means.clone()));
            let off = |means: Tensor<2>| -> f64 {
                let off = values(means - truth.clone() - ends.clone());
                off.into_iter().fold(0.0, |most, v| most.max(v.abs()))
            };
            assert!(off(means) > 1e-3, "{factor}: something is moved");
            assert!(off(held) < 1e-12, "{factor}");
        }
    }

    /// Where a hand does more than the poses say, they are believed whole as long as that is no more than what they do say.
    #[test]
    fn the_poses_are_believed_by_how_much_they_explain() {
        let device = Device::flex();
        let (foretold, shared) = foretold(&views(shaking), &device);
        let norm = |of: &Tensor<2>| values(of.clone().square()).iter().sum::<f64>().sqrt();
        let own = foretold.own.clone() / norm(&foretold.own);
        // What nothing foretells and the scene cannot show either.
        let other = shared.own_shifts(any(&device)) * foretold.told.clone();
        let along: f64 = values(other.clone() * own.clone()).iter().sum();
        let other = other - own * along;
        let other = other.clone() / norm(&other);
        // Of means with so many times as much of that they explain 1, 0.8, 0.5, 0.2 and 0.1.
        for (times, believed) in [(0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (2.0, 0.4), (3.0, 0.2)] {
            let factor = 0.04;
            let own_means = factor * norm(&foretold.own);
            let means = foretold.shifts.clone() * factor + other.clone() * (times * own_means);
            let expected = means.clone() - foretold.shifts.clone() * (factor * believed);
            let off = values(missed(&foretold, means) - expected);
            assert!(off.iter().all(|v| v.abs() < 1e-15), "{times}: {off:?}");
        }
    }

    #[test]
    fn where_nothing_is_foretold_means_are_held_to_none() {
        // A GPU may take less for 0, and 0 / 0 would be in every path.
        assert!(((LEAST_SQUARE * LEAST_SQUARE) as f32).is_normal());
        let device = Device::flex();
        let all = values(any(&device));
        let still = views(|_| (DVec3::ZERO, DVec3::ZERO));
        assert_eq!(
            values(missed(&foretold(&still, &device).0, any(&device))),
            all
        );
        assert_eq!(
            Accelerations::of(&still[..2], 2.0).known(&[true; 2]),
            [true; 2]
        );
        // Nor where they go against it.
        let foretold = foretold(&views(shaking), &device).0;
        let against = foretold.shifts.clone() * -0.1;
        assert_eq!(values(missed(&foretold, against.clone())), values(against));
    }
}
