//! A lens without samples: Gaussians as large as out of focus they look, in one render.
//!
//! It is what others do whose scenes have a lens and no path. A disc is a Gaussian then, and what is sharp behind an edge that is
//! not is seen as far as grown Gaussians let it through.

use super::Lens;
use crate::tensors::rows_from;
use burn::tensor::{Tensor, activation::softplus};
use splat_core::{Splats, Viewpoint};

/// Variance of the rasteriser's low-pass filter, px².
const LOW_PASS: f64 = 0.3;
/// Logarithms of scales beyond this are as good as this: their squares' products are finite.
const LARGEST_LOG: f64 = 15.0;
/// Optical depth under which nothing is drawn.
const THINNEST: f64 = 1e-6;

/// Gaussians as the lens sees them from the middle of the exposure: their covariance grown by that of the disc at their depth, R²/4
/// along each axis for a disc of radius R, and their optical depth, -ln(1 - opacity), made smaller as their area in the image grows,
/// so that as much light is held back as before.
pub(super) fn grown(splats: Splats, view: &Viewpoint, lens: &Lens) -> Splats {
    let rotation = view.cam_from_world.clone().narrow(1, 0, 3);
    let place = view.cam_from_world.clone().narrow(1, 3, 1).transpose();
    let seen = splats.means.clone().matmul(rotation.clone().transpose()) + place; // [N, 3]
    let depth = seen.clone().narrow(1, 2, 1);
    let disc = lens.radius_at(depth.clone()).square() * 0.25; // [N, 1]
    let pixel = (depth * (1.0 / view.camera.fx)).square() * LOW_PASS;

    let variances = (splats.log_scales.clone())
        .clamp(-LARGEST_LOG, LARGEST_LOG)
        .mul_scalar(2.0)
        .exp(); // [N, 3]
    let toward = in_own_axes(&splats, seen.matmul(rotation));
    let area = |variances: Tensor<2>| area_along(&toward, variances);
    let share = (area(variances.clone() + pixel.clone())
        / area(variances.clone() + pixel + disc.clone()))
    .sqrt(); // [N, 1]
    let thickness = (softplus(splats.opacity_logits, 1.0) * share).clamp_min(THINNEST);
    Splats {
        log_scales: (variances + disc).log().mul_scalar(0.5),
        // The logit of 1 - e^-t is t + ln(1 - e^-t).
        opacity_logits: thickness.clone() + (-(-thickness).exp() + 1.0).log(),
        ..splats
    }
}

/// Directions in the world, [N, 3], in each Gaussian's own axes.
fn in_own_axes(splats: &Splats, directions: Tensor<2>) -> Tensor<2> {
    let directions = match &splats.left_rotations {
        Some(left) => {
            let moving = left.dims()[0];
            let turned = directions.clone().narrow(0, 0, moving);
            let turned = turned.reshape([moving, 1, 3]).matmul(left.clone());
            let resting = rows_from(&directions, moving);
            let all = [Some(turned.reshape([moving, 3])), resting];
            Tensor::cat(all.into_iter().flatten().collect(), 0)
        }
        None => directions,
    };
    let quats = splats.quats.clone();
    let length = quats.clone().square().sum_dim(1).clamp_min(1e-24).sqrt();
    let quats = quats / length;
    // Back by a turn (w, u): v - 2 w u × v + 2 u × (u × v).
    let (w, u) = (quats.clone().narrow(1, 0, 1), quats.narrow(1, 1, 3));
    let across = u.clone().cross(directions.clone(), 1);
    directions - across.clone() * w * 2.0 + u.cross(across, 1) * 2.0
}

/// Square of the area, but for a factor, of ellipsoids with these variances along their axes, [N, 3], as they are seen along a
/// direction, [N, 3], in these axes: det(Σ) vᵀ Σ⁻¹ v.
fn area_along(direction: &Tensor<2>, variances: Tensor<2>) -> Tensor<2> {
    // What stands in the camera is seen along no direction.
    let squares = direction.clone().square() + 1e-24;
    let part = |i: usize| {
        let of = |j: usize| variances.clone().narrow(1, j % 3, 1);
        squares.clone().narrow(1, i, 1) * of(i + 1) * of(i + 2)
    };
    part(0) + part(1) + part(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{DType, Device, TensorData};
    use capture::{Capture, samples};
    use splat_core::{Camera, Exposure, Extra, Transfer, expose, render};

    const SIZE: f64 = 4.0;
    const SIDE: usize = 64;

    fn tensor<const D: usize>(values: &[f64], shape: [usize; D]) -> Tensor<D> {
        let data = TensorData::new(values.to_vec(), shape);
        Tensor::from_data(data, (&Device::flex().autodiff(), DType::F64))
    }

    fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
        host::read(tensor.detach()).iter::<f64>().collect()
    }

    /// One Gaussian on the axis at a depth, turned by a quaternion and by what moves it.
    fn one(depth: f64, quat: [f64; 4], log_scales: [f64; 3], logit: f64) -> Splats {
        let (sin, cos) = 0.6_f64.sin_cos();
        Splats {
            means: tensor(&[0.0, 0.0, depth], [1, 3]),
            quats: tensor(&quat, [1, 4]),
            left_rotations: Some(tensor(
                &[cos, 0.0, sin, 0.0, 1.0, 0.0, -sin, 0.0, cos],
                [1, 3, 3],
            )),
            log_scales: tensor(&log_scales, [1, 3]),
            opacity_logits: tensor(&[logit], [1, 1]),
            sh: tensor(&[1.5; 3], [1, 3]),
        }
    }

    fn ahead() -> Viewpoint {
        Viewpoint {
            camera: Camera::pinhole([SIDE; 2], [60.0; 2], [SIDE as f64 / 2.0; 2]),
            cam_from_world: tensor(
                &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
                [3, 4],
            ),
            sh_degree: 0,
        }
    }

    fn lens(aperture: f64, focus: f64) -> Lens {
        Lens {
            aperture: tensor(&[aperture], [1, 1]),
            focus: tensor(&[focus], [1, 1]),
            size: SIZE,
        }
    }

    const SHAPES: [([f64; 4], [f64; 3]); 3] = [
        ([1.0, 0.0, 0.0, 0.0], [-3.0, -3.0, -3.0]),
        ([0.8, 0.3, -0.5, 0.4], [-2.2, -3.4, -6.0]),
        ([1.6, -0.6, 1.0, 0.8], [-4.5, -2.5, -2.9]),
    ];

    #[test]
    fn through_a_closed_lens_gaussians_are_what_they_are() {
        for (quat, scales) in SHAPES {
            for logit in [-4.0, 0.3, 5.0] {
                let splats = grown(one(3.0, quat, scales, logit), &ahead(), &lens(0.0, 1.3));
                assert!((values(splats.opacity_logits)[0] - logit).abs() < 1e-9);
                for (after, before) in values(splats.log_scales).iter().zip(scales) {
                    assert!((after - before).abs() < 1e-12);
                }
            }
        }
    }

    /// Light of a picture, its middle and its variances along both axes.
    fn moments(color: Tensor<3>) -> [f64; 5] {
        let light: Vec<f64> = values(color).into_iter().step_by(3).collect();
        let mean = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
            let each = light.iter().enumerate();
            each.map(|(i, v)| v * of((i % SIDE) as f64, (i / SIDE) as f64))
                .sum()
        };
        let all = mean(&|_, _| 1.0);
        let (x, y) = (mean(&|x, _| x) / all, mean(&|_, y| y) / all);
        let along = |v: f64| v / all;
        [
            all,
            x,
            y,
            along(mean(&|p, _| (p - x).powi(2))),
            along(mean(&|_, q| (q - y).powi(2))),
        ]
    }

    /// A Gaussian out of focus through 256 points of the lens, grown, and sharp.
    fn seen(splats: Splats, lens: &Lens) -> [[f64; 5]; 3] {
        let mut capture = Capture::still(1, 1, (&Device::flex().autodiff(), DType::F64));
        capture.aperture = lens.aperture.clone();
        capture.focus = lens.focus.clone();
        let view = ahead();
        let exposure = Exposure {
            poses: capture.poses(0, &view.cam_from_world, &samples(256, 0.0), SIZE),
            movers: None,
            transfer: Transfer::Linear,
        };
        let points = expose(splats.clone(), &view, exposure, None).expect("a picture");
        let render = |splats| {
            let rendered = render(splats, &view, Extra::default()).expect("a render");
            moments(rendered.color())
        };
        let grown = grown(splats.clone(), &view, lens);
        [moments(points.color), render(grown), render(splats)]
    }

    #[test]
    fn a_faint_gaussian_keeps_its_light_and_a_thick_one_becomes_as_wide_as_many_points_see_it() {
        for (depth, focus) in [(2.5, 1.0), (3.0, 0.9), (6.0, 1.2)] {
            for (quat, scales) in SHAPES {
                let lens = lens(0.08, focus);
                let [points, found, _] = seen(one(depth, quat, scales, -2.0), &lens);
                let at = format!("{depth}, {scales:?}: {found:?} for {points:?}");
                assert!((found[0] / points[0] - 1.0).abs() < 0.06, "{at}");
                for axis in [1, 2] {
                    assert!((found[axis] - points[axis]).abs() < 0.1, "{at}");
                }
                let [points, found, sharp] = seen(one(depth, quat, scales, 1.0), &lens);
                let width = |moments: [f64; 5]| moments[3] + moments[4];
                let [points, found, sharp] = [points, found, sharp].map(width);
                let at = format!("{depth}, {scales:?}: {found} for {points}, sharp {sharp}");
                assert!(points > 1.2 * sharp, "{at}");
                assert!((found - points).abs() < 0.25 * (points - sharp), "{at}");
            }
        }
    }

    #[test]
    fn what_is_not_finite_or_behind_the_camera_stays_a_number() {
        let extremes = [
            (-3.0, -3.0, 1.0),
            (0.0, -3.0, 1.0),
            (3.0, 200.0, 1.0),
            (3.0, -200.0, 90.0),
            (3.0, -3.0, -90.0),
            (1e6, -3.0, 1.0),
        ];
        for (depth, log_scale, logit) in extremes {
            let splats = one(depth, [0.0; 4], [log_scale; 3], logit);
            let splats = grown(splats, &ahead(), &lens(0.05, 1.0));
            let all = [values(splats.log_scales), values(splats.opacity_logits)].concat();
            assert!(all.iter().all(|v| v.is_finite()), "{depth}: {all:?}");
        }
    }
}
