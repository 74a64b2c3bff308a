//! What shifts of frames in the image cannot be told from a scene that lies elsewhere: that is the scene's.

use crate::columns::Columns;
use crate::views::CameraView;
use burn::tensor::{DType, Device, Tensor};
use glam::DVec3;
use splat_core::camera_center;
use std::f64::consts::PI;

/// Frames to a half wave of the quickest drift.
const FRAMES: usize = 8;

/// Where the cameras of N frames stand, right and down in their own axes, away from their mean; scene units.
#[derive(Clone, Debug)]
pub(crate) struct SceneShift {
    places: Vec<[f64; 2]>,
    /// Slow waves over the frames, each of one number a frame.
    waves: Vec<Vec<f64>>,
}

/// What numbers of the frames that count show if the scene lies elsewhere: a sum of a few known columns.
#[derive(Clone, Debug)]
pub(crate) struct Shared {
    /// Of shifts of N frames, one below the other: [2 N, 3 + 2 W], with W waves.
    shifts: Columns,
    /// Of any number of N frames: [N, 3 + W].
    trends: Columns,
}

/// What changes slowly over so many frames: the cosines of up to a half wave for every eight of them. None of fewer frames, of
/// which nothing says what is slow.
fn slow_waves(frames: usize) -> Vec<Vec<f64>> {
    let half_wave = PI / frames as f64;
    let wave = |k: usize| {
        let angles = (0..frames).map(|i| half_wave * k as f64 * (i as f64 + 0.5));
        angles.map(f64::cos).collect()
    };
    (1..=frames / FRAMES).map(wave).collect()
}

impl SceneShift {
    /// Of frames that were seen so.
    pub(crate) fn of(views: &[CameraView]) -> Self {
        let centers: Vec<DVec3> = views
            .iter()
            .map(|v| camera_center(&v.cam_from_world))
            .collect();
        let mean = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
        let places = views.iter().zip(&centers).map(|(view, center)| {
            let aside = view.cam_from_world.transform_vector3(center - mean);
            [aside.x, aside.y]
        });
        Self {
            places: places.collect(),
            waves: Vec::new(),
        }
    }

    /// The same of a scene that may drift as well: slowly along the video, so that what each frame shows of it shifts by a sum of slow
    /// waves.
    pub(crate) fn drifting(self) -> Self {
        Self {
            waves: slow_waves(self.places.len()),
            ..self
        }
    }

    /// What frames have in common of which those count: others neither tell of it nor are told. Of shifts only those among them that
    /// `tell` do.
    pub(crate) fn among(
        &self,
        counted: &[bool],
        tell: &[bool],
        options: (&Device, DType),
    ) -> Shared {
        let of_counted = |value: &dyn Fn(&[f64; 2]) -> f64| -> Vec<f64> {
            let frames = self.places.iter().zip(counted);
            frames
                .map(|(place, counts)| if *counts { value(place) } else { 0.0 })
                .collect()
        };
        let [ones, right, down] = [
            of_counted(&|_| 1.0),
            of_counted(&|[x, _]| *x),
            of_counted(&|[_, y]| *y),
        ];
        let none = vec![0.0; ones.len()];
        let interleaved = |x: &[f64], y: &[f64]| -> Vec<f64> {
            x.iter().zip(y).flat_map(|(x, y)| [*x, *y]).collect()
        };
        let mut shifts = vec![
            interleaved(&ones, &none),
            interleaved(&none, &ones),
            interleaved(&right, &down),
        ];
        let mut trends = vec![ones.clone(), right, down];
        for wave in &self.waves {
            let wave: Vec<f64> = wave.iter().zip(&ones).map(|(w, one)| w * one).collect();
            shifts.push(interleaved(&wave, &none));
            shifts.push(interleaved(&none, &wave));
            trends.push(wave);
        }
        let both: Vec<bool> = tell.iter().flat_map(|tells| [*tells; 2]).collect();
        Shared {
            shifts: Columns::told_by(&both, shifts, options),
            trends: Columns::spanning(trends, options),
        }
    }
}

impl Shared {
    /// What of the frames' shifts [N, 2] is the scene's, by least squares: all shift alike, and each by how far its camera stands
    /// aside, as they do if every point is nearer by the same disparity; and slow waves, where it may drift.
    pub(crate) fn of_shifts(&self, shifts: Tensor<2>) -> Tensor<2> {
        let shape = shifts.dims();
        let all = shifts.reshape([shape[0] * shape[1], 1]);
        self.shifts.part_of(all).reshape(shape)
    }

    /// What of the frames' shifts [N, 2] is not the scene's.
    pub(crate) fn own_shifts(&self, shifts: Tensor<2>) -> Tensor<2> {
        shifts.clone() - self.of_shifts(shifts)
    }

    /// What of any numbers of the frames [N, C] is the same in all, or in proportion to where their cameras stand, right or down, by
    /// least squares. A scene that tilts, turns or grows with the camera's place looks like that. Where it may drift, slow waves
    /// are the scene's as well.
    pub(crate) fn of_any(&self, values: Tensor<2>) -> Tensor<2> {
        self.trends.part_of(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;
    use glam::{DAffine3, DQuat};
    use splat_core::Camera;

    fn views() -> Vec<CameraView> {
        let view = |k: usize| {
            let t = k as f64;
            let turn = DQuat::from_scaled_axis(
                0.03 * DVec3::new(t.sin(), (2.0 * t).cos(), (3.0 * t).sin()),
            );
            let center = DVec3::new(0.2 * t - 0.4, 0.1 * (1.7 * t).sin(), 0.3 * (0.9 * t).cos());
            CameraView {
                name: k.to_string(),
                camera: Camera::pinhole([64, 36], [50.0; 2], [32.0, 18.0]),
                cam_from_world: DAffine3::from_rotation_translation(turn, turn * -center),
                time: k as f32,
            }
        };
        (0..9).map(view).collect()
    }

    fn tensor(values: Vec<f64>, columns: usize) -> Tensor<2> {
        let rows = values.len() / columns;
        Tensor::from_data(
            TensorData::new(values, [rows, columns]),
            options_of(&Device::flex()),
        )
    }

    fn options_of(device: &Device) -> (&Device, DType) {
        (device, DType::F64)
    }

    fn values(tensor: Tensor<2>) -> Vec<f64> {
        tensor.try_into_vec_as::<f64>().expect("f64")
    }

    #[test]
    fn a_scene_that_lies_elsewhere_is_all_that_is_common_and_nothing_is_left_of_it() {
        let views = views();
        let scene_shift = SceneShift::of(&views);
        let centers = views.iter().map(|v| camera_center(&v.cam_from_world));
        let mean = centers.sum::<DVec3>() / views.len() as f64;
        // Points ahead, seen alike from the mean place and nearer by a disparity: they shift in a frame by how far it stands aside.
        let (disparity, all) = (0.004, DVec3::new(0.003, -0.001, 0.0));
        let shifts = views.iter().flat_map(|view| {
            let aside = view
                .cam_from_world
                .transform_vector3(camera_center(&view.cam_from_world) - mean);
            let ahead = |inverse: f64| -aside * inverse;
            let shift = ahead(1.0 / 5.0 + disparity) - ahead(1.0 / 5.0) + all;
            [shift.x, shift.y]
        });
        let shifts = shifts.collect::<Vec<f64>>();
        let shared = scene_shift.among(&[true; 9], &[true; 9], options_of(&Device::flex()));
        let common = values(shared.of_shifts(tensor(shifts.clone(), 2)));
        for (common, shift) in common.iter().zip(&shifts) {
            assert!((common - shift).abs() < 1e-12, "{common} {shift}");
        }

        // Of any shifts, what is not common has nothing in common.
        let any: Vec<f64> = (0..18).map(|k| (1.1 * f64::from(k) + 0.3).sin()).collect();
        let common = shared.of_shifts(tensor(any.clone(), 2));
        let rest = tensor(any, 2) - common;
        for value in values(shared.of_shifts(rest)) {
            assert!(value.abs() < 1e-12, "{value}");
        }
    }

    #[test]
    fn frames_that_do_not_count_neither_shift_nor_tell() {
        let scene_shift = SceneShift::of(&views());
        let mut shifts: Vec<f64> = (0..18).map(|k| (0.7 * f64::from(k)).cos()).collect();
        let mut counted = [true; 9];
        counted[4] = false;
        let device = Device::flex();
        let some = scene_shift.among(&counted, &counted, options_of(&device));
        let none = scene_shift.among(&[false; 9], &[false; 9], options_of(&device));
        let common = |shifts: &[f64]| values(some.of_shifts(tensor(shifts.to_vec(), 2)));
        let trend = |shifts: &[f64]| values(some.of_any(tensor(shifts.to_vec(), 2)));
        let before = (common(&shifts), trend(&shifts));
        assert_eq!(before.0[8..10], [0.0, 0.0]);
        assert_eq!(before.1[8..10], [0.0, 0.0]);
        shifts[8] = 100.0;
        shifts[9] = -100.0;
        assert_eq!((common(&shifts), trend(&shifts)), before);
        let shifts = tensor(shifts, 2);
        assert_eq!(values(none.of_shifts(shifts.clone())), vec![0.0; 18]);
        assert_eq!(values(none.of_any(shifts)), vec![0.0; 18]);
    }

    #[test]
    fn frames_that_do_not_tell_follow_the_others() {
        let scene_shift = SceneShift::of(&views());
        let device = Device::flex();
        let options = options_of(&device);
        let mut tell = [true; 9];
        (tell[0], tell[8]) = (false, false);
        let any: Vec<f64> = (0..18).map(|k| (0.7 * f64::from(k)).cos()).collect();
        let all = scene_shift.among(&[true; 9], &[true; 9], options);
        let common = values(all.of_shifts(tensor(any, 2)));
        let mut shifts = common.clone();
        (shifts[0], shifts[17]) = (100.0, -100.0);
        let told = scene_shift.among(&[true; 9], &tell, options);
        let found = values(told.of_shifts(tensor(shifts, 2)));
        for (found, common) in found.iter().zip(&common) {
            assert!((found - common).abs() < 1e-12, "{found} {common}");
        }
    }

    #[test]
    fn cameras_in_a_row_or_in_one_place_have_fewer_columns_in_common() {
        let mut views = views();
        for view in &mut views {
            // On a line that leans, and all turned alike.
            let center = DVec3::new(1.0, 2.0, 0.0) * f64::from(view.time);
            view.cam_from_world = DAffine3::from_translation(-center);
        }
        let any: Vec<f64> = (0..18).map(|k| (1.1 * f64::from(k) + 0.3).sin()).collect();
        for _ in 0..2 {
            let shared =
                SceneShift::of(&views).among(&[true; 9], &[true; 9], options_of(&Device::flex()));
            let once = shared.of_any(tensor(any.clone(), 2));
            let twice = values(shared.of_any(once.clone()));
            for (once, twice) in values(once).iter().zip(twice) {
                assert!((once - twice).abs() < 1e-12, "{once} {twice}");
            }
            for view in &mut views {
                view.cam_from_world = DAffine3::IDENTITY;
            }
        }
    }

    /// What is the scene's of numbers that are `of` each of so many frames, all seen from one place: where it may drift, and where not.
    fn of_one_place(frames: usize, of: impl Fn(f64) -> f64) -> [Vec<f64>; 2] {
        let mut view = views().swap_remove(0);
        view.cam_from_world = DAffine3::IDENTITY;
        let still = SceneShift::of(&vec![view; frames]);
        let numbers = tensor((0..frames).map(|i| of(i as f64)).collect(), 1);
        let both: Vec<f64> = values(numbers.clone())
            .iter()
            .flat_map(|v| [*v, -2.0 * v])
            .collect();
        [still.clone().drifting(), still].map(|shift| {
            let (device, all) = (Device::flex(), vec![true; frames]);
            let options = options_of(&device);
            let shared = shift.among(&all, &all, options);
            let any = values(shared.of_any(numbers.clone()));
            let shifts = values(shared.of_shifts(tensor(both.clone(), 2)));
            for (any, shifts) in any.iter().zip(shifts.chunks(2)) {
                let off = (shifts[0] - any).abs() + (shifts[1] + 2.0 * any).abs();
                assert!(off < 1e-12, "shifts are told as anything is: {off}");
            }
            any
        })
    }

    #[test]
    fn a_slow_swing_may_be_a_drift_and_a_hand_that_turns_round_is_none() {
        let frames = 24;
        for waves in [1, 2, 3, 4, 11, 23] {
            let swing = |i: f64| (PI * f64::from(waves) * (i + 0.5) / frames as f64).cos();
            let [drifting, still] = of_one_place(frames, swing);
            for (i, (drifting, still)) in drifting.iter().zip(still).enumerate() {
                let expected = if waves > 3 { 0.0 } else { swing(i as f64) };
                assert!(
                    (drifting - expected).abs() < 1e-12,
                    "{waves}: {drifting} {expected}"
                );
                assert!(still.abs() < 1e-12, "{waves}: {still}");
            }
        }
    }

    /// Of so few frames nothing says which of their numbers are slow.
    #[test]
    fn a_handful_of_frames_does_not_drift() {
        let [drifting, _] = of_one_place(7, |i| i - 3.0);
        assert!(drifting.iter().all(|v| v.abs() < 1e-12), "{drifting:?}");
    }

    #[test]
    fn a_trend_is_all_that_goes_with_the_cameras_place_and_nothing_is_left_of_it() {
        let views = views();
        let scene_shift = SceneShift::of(&views);
        let shared = scene_shift.among(&[true; 9], &[true; 9], options_of(&Device::flex()));
        let centers: Vec<DVec3> = views
            .iter()
            .map(|v| camera_center(&v.cam_from_world))
            .collect();
        let mean = centers.iter().sum::<DVec3>() / views.len() as f64;
        // Three numbers a frame: each a number for all, and so much for each unit right and down.
        let numbers = views.iter().zip(&centers).flat_map(|(view, center)| {
            let aside = view.cam_from_world.transform_vector3(center - mean);
            [[0.3, 0.01, -0.02], [-2.0, 0.0, 0.5], [0.0, 1e-4, 0.0]]
                .map(|[all, right, down]| all + right * aside.x + down * aside.y)
        });
        let numbers = tensor(numbers.collect(), 3);
        let trend = shared.of_any(numbers.clone());
        for rest in values(numbers - trend) {
            assert!(rest.abs() < 1e-12, "{rest}");
        }

        let any: Vec<f64> = (0..27).map(|k| (1.1 * f64::from(k) + 0.3).sin()).collect();
        let any = tensor(any, 3);
        let rest = any.clone() - shared.of_any(any);
        assert!(values(rest.clone()).iter().any(|rest| rest.abs() > 0.1));
        for value in values(shared.of_any(rest)) {
            assert!(value.abs() < 1e-12, "{value}");
        }
    }
}
