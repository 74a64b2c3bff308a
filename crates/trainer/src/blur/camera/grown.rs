//! A lens without samples: Gaussians as large as out of focus they look, in one render.
//!
//! It is what others do whose scenes have a lens and no path. A disc is a Gaussian then, and what is sharp behind an edge that is
//! not is seen as far as grown Gaussians let it through.

use super::Lens;
use crate::tensors::rows_from;
use burn::tensor::{Tensor, activation::softplus};
use host::{product, products};
use splat_core::cpu::LOW_PASS;
use splat_core::{Splats, Viewpoint};

/// Logarithms of scales beyond this are as good as this: their squares' products are finite.
const LARGEST_LOG: f64 = 15.0;
/// Optical depth under which nothing is drawn.
const THINNEST: f64 = 1e-6;
/// Square of a distance, scene units², that is nothing.
const NOTHING: f64 = 1e-24;

/// Gaussians as the lens sees them from the middle of the exposure: their covariance grown by that of a ball which looks as large as
/// the disc at their depth, R²/4 along each axis on the optical axis for a disc of radius R, and their optical depth,
/// -ln(1 - opacity), made smaller as their area in the image grows.
///
/// What is kept is optical depth over the image, so that a closed surface stays closed and a faint Gaussian keeps its light; a thick
/// one by itself gains some.
pub(super) fn grown(splats: Splats, view: &Viewpoint, lens: &Lens) -> Splats {
    let rotation = view.cam_from_world.clone().narrow(1, 0, 3);
    let place = view.cam_from_world.clone().narrow(1, 3, 1).transpose();
    let seen = product(splats.means.clone(), rotation.clone().transpose()) + place; // [N, 3]
    let depth = seen.clone().narrow(1, 2, 1);
    // Aside of the axis a ball looks longer, outwards from the middle, than a disc that faces the lens.
    let distance = seen.clone().square().sum_dim(1) + NOTHING;
    let facing = ((depth.clone().square() + NOTHING) / distance).sqrt();
    let disc = lens.radius_at(depth.clone()).square() * 0.25 * facing; // [N, 1]
    let pixel = (depth * (1.0 / view.camera.fx)).square() * LOW_PASS;

    let variances = (splats.log_scales.clone())
        .clamp(-LARGEST_LOG, LARGEST_LOG)
        .mul_scalar(2.0)
        .exp(); // [N, 3]
    let toward = in_own_axes(&splats, product(seen, rotation));
    // By logarithms, since areas of small scenes have squares that are nothing in f32.
    let area = |variances: Tensor<2>| area_along(&toward, variances).log();
    let before = area(variances.clone() + pixel.clone());
    let share = ((before - area(variances.clone() + pixel + disc.clone())) * 0.5).exp(); // [N, 1]
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
            let turned = products(turned.reshape([moving, 1, 3]), left.clone());
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
    let squares = direction.clone().square() + NOTHING;
    let part = |i: usize| {
        let of = |j: usize| variances.clone().narrow(1, j % 3, 1);
        squares.clone().narrow(1, i, 1) * of(i + 1) * of(i + 2)
    };
    part(0) + part(1) + part(2)
}

#[cfg(test)]
mod tests {
    use super::super::lens::examples::{ahead, lens, tensor, through_points, values};
    use super::*;
    use splat_core::{Extra, Transfer, render};

    const SIDE: usize = 64;

    /// One Gaussian on the axis at a depth, turned by a quaternion and by what moves it.
    fn one(depth: f64, quat: [f64; 4], log_scales: [f64; 3], logit: f64) -> Splats {
        let (sin, cos) = 0.6_f64.sin_cos();
        Splats {
            means: tensor([0.0, 0.0, depth], [1, 3]),
            quats: tensor(quat, [1, 4]),
            left_rotations: Some(tensor(
                [cos, 0.0, sin, 0.0, 1.0, 0.0, -sin, 0.0, cos],
                [1, 3, 3],
            )),
            log_scales: tensor(log_scales, [1, 3]),
            opacity_logits: tensor([logit], [1, 1]),
            sh: tensor([1.5; 3], [1, 3]),
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
                let splats = grown(one(3.0, quat, scales, logit), &ahead(SIDE), &lens(0.0, 1.3));
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
        let view = ahead(SIDE);
        let points = through_points(splats.clone(), &view, lens, Transfer::Linear);
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

    /// One that moves and one that does not.
    fn two() -> Splats {
        let (sin, cos) = 0.4_f64.sin_cos();
        Splats {
            means: tensor([0.3, -0.2, 2.5, -0.6, 0.4, 5.0], [2, 3]),
            quats: tensor([0.8, 0.3, -0.5, 0.4, 1.1, -0.2, 0.3, 0.6], [2, 4]),
            left_rotations: Some(tensor(
                [cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0],
                [1, 3, 3],
            )),
            log_scales: tensor([-2.2, -3.4, -4.0, -3.0, -2.5, -3.5], [2, 3]),
            opacity_logits: tensor([0.7, -1.2], [2, 1]),
            sh: tensor([1.5; 6], [2, 3]),
        }
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        let loss = |splats: &Splats, lens: &Lens| {
            let grown = grown(splats.clone(), &ahead(SIDE), lens);
            let weights = tensor([0.7, -1.1, 0.4, 0.9, 1.3, -0.6], [2, 3]);
            let logits = grown.opacity_logits * tensor([1.2, -0.8], [2, 1]);
            (grown.log_scales * weights).sum() + logits.sum()
        };
        type Field = fn(&mut Splats, &mut Lens) -> Tensor<2>;
        type Put = fn(&mut Splats, &mut Lens, Tensor<2>);
        let fields: [(&str, Field, Put); 6] = [
            ("means", |s, _| s.means.clone(), |s, _, t| s.means = t),
            ("quats", |s, _| s.quats.clone(), |s, _, t| s.quats = t),
            (
                "log_scales",
                |s, _| s.log_scales.clone(),
                |s, _, t| s.log_scales = t,
            ),
            (
                "logits",
                |s, _| s.opacity_logits.clone(),
                |s, _, t| s.opacity_logits = t,
            ),
            (
                "aperture",
                |_, l| l.aperture.clone(),
                |_, l, t| l.aperture = t,
            ),
            ("focus", |_, l| l.focus.clone(), |_, l, t| l.focus = t),
        ];
        for (name, field, put) in fields {
            let (mut splats, mut at) = (two(), lens(0.08, 1.3));
            let leaf = field(&mut splats, &mut at).require_grad();
            put(&mut splats, &mut at, leaf.clone());
            let grads = loss(&splats, &at).backward();
            let found = values(Tensor::<2>::from_inner(
                leaf.grad(&grads).expect("a gradient"),
            ));
            let (start, shape) = (values(leaf.clone()), leaf.dims());
            for (k, found) in found.iter().enumerate() {
                let value = |delta: f64| {
                    let mut numbers = start.clone();
                    numbers[k] += delta;
                    let (mut splats, mut at) = (two(), lens(0.08, 1.3));
                    put(&mut splats, &mut at, tensor(numbers, shape));
                    values(loss(&splats, &at))[0]
                };
                let numeric = (value(1e-6) - value(-1e-6)) / 2e-6;
                let off = (found - numeric).abs();
                assert!(
                    off < 1e-6 * (1.0 + numeric.abs()),
                    "{name} {k}: {found} {numeric}"
                );
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
            let splats = grown(splats, &ahead(SIDE), &lens(0.05, 1.0));
            let all = [values(splats.log_scales), values(splats.opacity_logits)].concat();
            assert!(all.iter().all(|v| v.is_finite()), "{depth}: {all:?}");
        }
    }
}
