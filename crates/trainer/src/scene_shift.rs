//! What shifts of frames in the image cannot be told from a scene that lies elsewhere: that is the scene's.

use crate::columns::Columns;
use crate::views::CameraView;
use burn::tensor::{DType, Device, Tensor, TensorData};
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
    pub(crate) fn among(&self, counted: &[bool], tell: &[bool]) -> Shared {
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
        let both = tell.iter().flat_map(|tells| [*tells; 2]).collect();
        Shared {
            shifts: Columns::told_by(both, shifts),
            trends: Columns::spanning(trends),
        }
    }
}

impl Shared {
    /// What of the frames' shifts is the scene's, by least squares: all shift alike, and each by how far its camera stands aside, as
    /// they do if every point is nearer by the same disparity; and slow waves, where it may drift.
    pub(crate) fn of_shifts(&self, shifts: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let part = self.shifts.part_of(shifts.as_flattened());
        let each = part.chunks_exact(2);
        each.map(|shift| [shift[0], shift[1]]).collect()
    }

    /// What of the frames' shifts is not the scene's.
    pub(crate) fn own_shifts(&self, shifts: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let scenes = self.of_shifts(shifts);
        let each = shifts.iter().zip(scenes);
        each.map(|(shift, scenes)| [0, 1].map(|axis| shift[axis] - scenes[axis]))
            .collect()
    }

    /// [`Self::of_shifts`] of N frames on a device: the matrix [2 N, 2 N] that takes shifts, one below the other, to the scene's.
    pub(crate) fn of_shifts_on(&self, options: (&Device, DType)) -> Tensor<2> {
        let matrix = self.shifts.projection();
        let rows = matrix.len().isqrt();
        Tensor::<2>::from_data(TensorData::new(matrix, [rows, rows]), options).inner()
    }

    /// What of any numbers of the frames, one each, is the same in all, or in proportion to where their cameras stand, right or down,
    /// by least squares. A scene that tilts, turns or grows with the camera's place looks like that. Where it may drift, slow waves
    /// are the scene's as well.
    pub(crate) fn of_any(&self, numbers: &[f64]) -> Vec<f64> {
        self.trends.part_of(numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DQuat};
    use host::product;
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

    /// Two numbers of each of so many frames.
    fn any(frames: usize) -> Vec<[f64; 2]> {
        let any = |k: usize| (1.1 * k as f64 + 0.3).sin();
        (0..frames).map(|k| [any(2 * k), any(2 * k + 1)]).collect()
    }

    fn all_told(scene_shift: &SceneShift) -> Shared {
        let all = vec![true; scene_shift.places.len()];
        scene_shift.among(&all, &all)
    }

    /// By how much two lists of shifts are apart where most; NaN where one is.
    fn apart(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
        assert_eq!(a.len(), b.len());
        let pairs = a.as_flattened().iter().zip(b.as_flattened());
        let apart = pairs.map(|(a, b)| (a - b).abs());
        apart.max_by(f64::total_cmp).unwrap_or(0.0)
    }

    #[test]
    fn a_scene_that_lies_elsewhere_is_all_that_is_common_and_nothing_is_left_of_it() {
        let views = views();
        let scene_shift = SceneShift::of(&views);
        let centers = views.iter().map(|v| camera_center(&v.cam_from_world));
        let mean = centers.sum::<DVec3>() / views.len() as f64;
        // Points ahead, seen alike from the mean place and nearer by a disparity: they shift in a frame by how far it stands aside.
        let (disparity, all) = (0.004, DVec3::new(0.003, -0.001, 0.0));
        let shifts = views.iter().map(|view| {
            let aside = view
                .cam_from_world
                .transform_vector3(camera_center(&view.cam_from_world) - mean);
            let ahead = |inverse: f64| -aside * inverse;
            let shift = ahead(1.0 / 5.0 + disparity) - ahead(1.0 / 5.0) + all;
            [shift.x, shift.y]
        });
        let shifts: Vec<_> = shifts.collect();
        let shared = all_told(&scene_shift);
        let off = apart(&shared.of_shifts(&shifts), &shifts);
        assert!(off < 1e-12, "{off}");

        // Of any shifts, what is not common has nothing in common.
        let rest = shared.own_shifts(&any(9));
        let left = apart(&shared.of_shifts(&rest), &[[0.0; 2]; 9]);
        assert!(left < 1e-12, "{left}");
    }

    #[test]
    fn a_device_finds_the_same() {
        let mut told = [true; 9];
        told[3] = false;
        let shared = SceneShift::of(&views()).drifting().among(&[true; 9], &told);
        let device = Device::flex();
        let options = (&device, DType::F64);
        let shifts = TensorData::new(any(9).concat(), [18, 1]);
        let found = product(
            shared.of_shifts_on(options),
            Tensor::from_data(shifts, options),
        );
        let found = found.try_into_vec_as::<f64>().expect("f64");
        let expected = shared.of_shifts(&any(9)).concat();
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
    }

    #[test]
    fn frames_that_do_not_count_neither_shift_nor_tell() {
        let scene_shift = SceneShift::of(&views());
        let mut shifts = any(9);
        let mut counted = [true; 9];
        counted[4] = false;
        let some = scene_shift.among(&counted, &counted);
        let none = scene_shift.among(&[false; 9], &[false; 9]);
        let right = |shifts: &[[f64; 2]]| -> Vec<f64> { shifts.iter().map(|s| s[0]).collect() };
        let found = |shifts: &[[f64; 2]]| (some.of_shifts(shifts), some.of_any(&right(shifts)));
        let before = found(&shifts);
        assert_eq!((before.0[4], before.1[4]), ([0.0; 2], 0.0));
        shifts[4] = [100.0, -100.0];
        assert_eq!(found(&shifts), before);
        assert_eq!(none.of_shifts(&shifts), [[0.0; 2]; 9]);
        assert_eq!(none.of_any(&right(&shifts)), [0.0; 9]);
    }

    #[test]
    fn frames_that_do_not_tell_follow_the_others() {
        let scene_shift = SceneShift::of(&views());
        let mut tell = [true; 9];
        (tell[0], tell[8]) = (false, false);
        let common = all_told(&scene_shift).of_shifts(&any(9));
        let mut shifts = common.clone();
        (shifts[0][0], shifts[8][1]) = (100.0, -100.0);
        let told = scene_shift.among(&[true; 9], &tell);
        let off = apart(&told.of_shifts(&shifts), &common);
        assert!(off < 1e-12, "{off}");
    }

    #[test]
    fn cameras_in_a_row_or_in_one_place_have_fewer_columns_in_common() {
        let mut views = views();
        for view in &mut views {
            // On a line that leans, and all turned alike.
            let center = DVec3::new(1.0, 2.0, 0.0) * f64::from(view.time);
            view.cam_from_world = DAffine3::from_translation(-center);
        }
        for _ in 0..2 {
            let shared = all_told(&SceneShift::of(&views));
            let numbers = any(9).iter().map(|n| n[0]).collect::<Vec<_>>();
            let once = shared.of_any(&numbers);
            for (once, twice) in once.iter().zip(shared.of_any(&once)) {
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
        let numbers: Vec<f64> = (0..frames).map(|i| of(i as f64)).collect();
        let both: Vec<[f64; 2]> = numbers.iter().map(|v| [*v, -2.0 * v]).collect();
        [still.clone().drifting(), still].map(|shift| {
            let shared = all_told(&shift);
            let any = shared.of_any(&numbers);
            for (any, shifts) in any.iter().zip(shared.of_shifts(&both)) {
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
        let shared = all_told(&scene_shift);
        let centers: Vec<DVec3> = views
            .iter()
            .map(|v| camera_center(&v.cam_from_world))
            .collect();
        let mean = centers.iter().sum::<DVec3>() / views.len() as f64;
        let rest_of = |numbers: &[f64]| -> Vec<f64> {
            let scenes = shared.of_any(numbers);
            numbers.iter().zip(scenes).map(|(n, s)| n - s).collect()
        };
        // A number for all, and so much for each unit right and down.
        for [all, right, down] in [[0.3, 0.01, -0.02], [-2.0, 0.0, 0.5], [0.0, 1e-4, 0.0]] {
            let numbers = views.iter().zip(&centers).map(|(view, center)| {
                let aside = view.cam_from_world.transform_vector3(center - mean);
                all + right * aside.x + down * aside.y
            });
            for rest in rest_of(&numbers.collect::<Vec<_>>()) {
                assert!(rest.abs() < 1e-12, "{rest}");
            }
        }

        for axis in [0, 1] {
            let rest = rest_of(&any(9).iter().map(|n| n[axis]).collect::<Vec<_>>());
            assert!(rest.iter().any(|rest| rest.abs() > 0.1));
            for value in shared.of_any(&rest) {
                assert!(value.abs() < 1e-12, "{value}");
            }
        }
    }
}
