//! What shifts of frames in the image cannot be told from a scene that lies elsewhere: that is the scene's.

use crate::views::CameraView;
use burn::tensor::{DType, Device, Tensor, TensorData};
use glam::DVec3;
use splat_core::camera_center;

/// The shifts that N frames show if the scene lies elsewhere. Either all shift alike, or each by how far its camera stands
/// aside, as they do if every point is nearer by the same disparity.
#[derive(Clone, Debug)]
pub(crate) struct SceneShift {
    /// Where the cameras stand, right and down in their own axes, away from their mean; scene units: [N, 2].
    places: Tensor<2>,
}

impl SceneShift {
    /// Of frames that were seen so.
    pub(crate) fn of(views: &[CameraView], options: (&Device, DType)) -> Self {
        let centers: Vec<DVec3> = views
            .iter()
            .map(|v| camera_center(&v.cam_from_world))
            .collect();
        let mean = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
        let places = views.iter().zip(&centers).flat_map(|(view, center)| {
            let aside = view.cam_from_world.transform_vector3(center - mean);
            [aside.x, aside.y]
        });
        let places = TensorData::new(places.collect::<Vec<f64>>(), [views.len(), 2]);
        Self {
            places: Tensor::<2>::from_data(places, options).inner(),
        }
    }

    /// What of the frames' shifts [N, 2] is the scene's, by least squares over those that count (1 of [N, 1]); 0 in others.
    pub(crate) fn common(&self, shifts: Tensor<2>, counted: Tensor<2>) -> Tensor<2> {
        let (places, _) = centered(self.places.clone(), &counted);
        let (rest, mean) = centered(shifts, &counted);
        let total = |values: Tensor<2>| values.sum_dim(0).sum_dim(1);
        let disparity =
            total(rest * places.clone()) / total(places.clone().square()).clamp_min(LEAST);
        places * disparity + mean * counted
    }

    /// What of any numbers of the frames [N, C] is the same in all, or in proportion to where their cameras stand, right or down;
    /// counted as in [`Self::common`]. A scene that tilts, turns or grows with the camera's place looks like that.
    pub(crate) fn trend(&self, values: Tensor<2>, counted: Tensor<2>) -> Tensor<2> {
        let (places, _) = centered(self.places.clone(), &counted);
        let (right, down) = (places.clone().narrow(1, 0, 1), places.narrow(1, 1, 1));
        let down = down.clone() - along(&down, &right);
        let (rest, mean) = centered(values, &counted);
        along(&rest, &right) + along(&rest, &down) + mean * counted
    }
}

/// Below it a sum of squares is none.
const LEAST: f64 = 1e-12;

/// Values of the frames [N, C] less their mean over those that count, 0 in others; and that mean [1, C].
fn centered(values: Tensor<2>, counted: &Tensor<2>) -> (Tensor<2>, Tensor<2>) {
    let number = counted.clone().sum_dim(0).clamp_min(1.0);
    let mean = (values.clone() * counted.clone()).sum_dim(0) / number;
    ((values - mean.clone()) * counted.clone(), mean)
}

/// The part of `values` [N, C] that goes with `basis` [N, 1].
fn along(values: &Tensor<2>, basis: &Tensor<2>) -> Tensor<2> {
    let total = (values.clone() * basis.clone()).sum_dim(0);
    basis.clone() * (total / basis.clone().square().sum_dim(0).clamp_min(LEAST))
}

#[cfg(test)]
mod tests {
    use super::*;
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
        let scene_shift = SceneShift::of(&views, options_of(&Device::flex()));
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
        let counted = tensor(vec![1.0; views.len()], 1);
        let common = values(scene_shift.common(tensor(shifts.clone(), 2), counted.clone()));
        for (common, shift) in common.iter().zip(&shifts) {
            assert!((common - shift).abs() < 1e-12, "{common} {shift}");
        }

        // Of any shifts, what is not common has nothing in common.
        let any: Vec<f64> = (0..18).map(|k| (1.1 * f64::from(k) + 0.3).sin()).collect();
        let common = scene_shift.common(tensor(any.clone(), 2), counted.clone());
        let rest = tensor(any, 2) - common;
        for value in values(scene_shift.common(rest, counted)) {
            assert!(value.abs() < 1e-12, "{value}");
        }
    }

    #[test]
    fn frames_that_do_not_count_neither_shift_nor_tell() {
        let scene_shift = SceneShift::of(&views(), options_of(&Device::flex()));
        let mut shifts: Vec<f64> = (0..18).map(|k| (0.7 * f64::from(k)).cos()).collect();
        let mut counted = vec![1.0; 9];
        counted[4] = 0.0;
        let common = |shifts: &[f64]| {
            values(scene_shift.common(tensor(shifts.to_vec(), 2), tensor(counted.clone(), 1)))
        };
        let before = common(&shifts);
        assert_eq!(before[8..10], [0.0, 0.0]);
        shifts[8] = 100.0;
        assert_eq!(common(&shifts), before);
        let none = scene_shift.common(tensor(shifts.clone(), 2), tensor(vec![0.0; 9], 1));
        assert_eq!(values(none), vec![0.0; 18]);

        let trend = |shifts: &[f64]| {
            values(scene_shift.trend(tensor(shifts.to_vec(), 2), tensor(counted.clone(), 1)))
        };
        let before = trend(&shifts);
        assert_eq!(before[8..10], [0.0, 0.0]);
        shifts[9] = -100.0;
        assert_eq!(trend(&shifts), before);
        let none = scene_shift.trend(tensor(shifts, 2), tensor(vec![0.0; 9], 1));
        assert_eq!(values(none), vec![0.0; 18]);
    }

    #[test]
    fn a_trend_is_all_that_goes_with_the_cameras_place_and_nothing_is_left_of_it() {
        let views = views();
        let scene_shift = SceneShift::of(&views, options_of(&Device::flex()));
        let every = || tensor(vec![1.0; views.len()], 1);
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
        let trend = scene_shift.trend(numbers.clone(), every());
        for rest in values(numbers - trend) {
            assert!(rest.abs() < 1e-12, "{rest}");
        }

        let any: Vec<f64> = (0..27).map(|k| (1.1 * f64::from(k) + 0.3).sin()).collect();
        let any = tensor(any, 3);
        let rest = any.clone() - scene_shift.trend(any, every());
        assert!(values(rest.clone()).iter().any(|rest| rest.abs() > 0.1));
        for value in values(scene_shift.trend(rest, every())) {
            assert!(value.abs() < 1e-12, "{value}");
        }
    }
}
