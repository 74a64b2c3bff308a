//! Exposures: against renders that are averaged one by one, and gradients against central differences.

use super::*;

/// A case whose Gaussians and camera move while the shutter is open.
#[derive(Clone)]
struct Moving<T> {
    case: Case<T>,
    poses: Vec<T>,
    means: Vec<T>,
    left: Vec<T>,
    transfer: Transfer,
}

impl<T: Real + Float> Moving<T> {
    fn with<R>(&self, run: impl FnOnce(&Exposure<'_, T>) -> R) -> R {
        run(&Exposure {
            splats: self.case.slices(),
            middle: &self.case.view(),
            poses: &self.poses,
            moving_means: &self.means,
            left_rotations: &self.left,
            transfer: self.transfer,
        })
    }

    fn picture(&self) -> Vec<T> {
        self.with(|exposure| expose(exposure).unwrap().color)
    }

    fn backward(&self, v_color: &[T]) -> ExposureGradients<T> {
        self.with(|exposure| {
            let state = expose(exposure).unwrap().state;
            expose_backward(exposure, &state, v_color, true).unwrap()
        })
    }

    fn cast<U: Real>(&self) -> Moving<U> {
        let c = |v: &[T]| v.iter().map(|x| U::of(x.to_f64())).collect();
        Moving {
            case: self.case.cast(),
            poses: c(&self.poses),
            means: c(&self.means),
            left: c(&self.left),
            transfer: self.transfer,
        }
    }
}

/// `samples` poses around that of the case, sheared as points of a lens are; rows [0, `moving`) move.
fn moving(mut case: Case<f64>, samples: usize, moving: usize, transfer: Transfer) -> Moving<f64> {
    let mut r = Random(77);
    let mut poses = Vec::new();
    for _ in 0..samples {
        poses.extend(case.pose.iter().map(|v| v + r.uniform(-0.03, 0.03)));
    }
    let (mut means, mut left) = (Vec::new(), Vec::new());
    for _ in 0..samples {
        means.extend(
            case.means[..3 * moving]
                .iter()
                .map(|v| v + r.uniform(-0.05, 0.05)),
        );
        for _ in 0..moving {
            let mut matrix = r.fill(9, -0.1, 0.1);
            (0..3).for_each(|k| matrix[4 * k] += 1.0);
            left.extend(matrix);
        }
    }
    case.left.clear();
    Moving {
        case,
        poses,
        means,
        left,
        transfer,
    }
}

fn srgb(value: f64) -> f64 {
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

fn inverse_srgb(light: f64) -> f64 {
    if light <= 0.04045 / 12.92 {
        light * 12.92
    } else {
        1.055 * light.powf(1.0 / 2.4) - 0.055
    }
}

#[test]
fn a_picture_is_the_mean_light_of_its_samples() {
    // Without bands over 0 no colour depends on the direction, and renders one by one are the same to rounding.
    let moving = moving(random_case(3, 40, 0, 0, 0), 5, 17, Transfer::Srgb);
    let mut light = vec![0.0; moving.case.camera.num_pixels() * 3];
    for i in 0..5 {
        let mut case = moving.case.clone();
        case.pose
            .copy_from_slice(&moving.poses[12 * i..12 * (i + 1)]);
        case.means[..51].copy_from_slice(&moving.means[51 * i..51 * (i + 1)]);
        case.left = moving.left[153 * i..153 * (i + 1)].to_vec();
        for (sum, value) in light.iter_mut().zip(case.render().color().flatten()) {
            *sum += srgb(value) / 5.0;
        }
    }
    let expected: Vec<f64> = light.into_iter().map(inverse_srgb).collect();
    assert!(expected.iter().any(|v| *v > 0.2), "there is a picture");
    let error = largest_difference(&moving.picture(), &expected);
    // The two branches of the standard's curve meet to eight digits.
    assert!(error < 1e-8, "{error:e}");
}

#[test]
fn a_picture_without_a_way_back_is_the_same_to_the_bit() {
    for samples in [1, 8, 19] {
        let moving = moving(random_case(3, 40, 0, 0, 0), samples, 17, Transfer::Srgb);
        let (color, radii) = moving.with(|exposure| take_picture(exposure).unwrap());
        let whole = moving.with(|exposure| expose(exposure).unwrap());
        assert!(whole.color.iter().any(|v| *v > 0.2), "there is a picture");
        assert_eq!((color, radii), (whole.color, whole.radii), "{samples}");
    }
}

#[test]
fn one_sample_where_the_camera_stands_is_a_render() {
    for degree in [0, 3] {
        let case = random_case(4, 30, degree, 0, 0);
        let sharp: Vec<f64> = case.render().color().flatten().collect();
        let poses = case.pose.clone();
        let still = Moving {
            case,
            poses,
            means: vec![],
            left: vec![],
            transfer: Transfer::Linear,
        };
        assert_eq!(still.picture(), sharp, "degree {degree}");
    }
}

/// Every entry of every input against central differences of a random linear loss.
fn check_gradients(moving: &Moving<f64>, seed: u64) {
    let v_color = Random(seed).fill(moving.case.camera.num_pixels() * 3, -1.0, 1.0);
    let loss = |moving: &Moving<f64>| -> f64 {
        let picture = moving.picture();
        picture.iter().zip(&v_color).map(|(o, v)| o * v).sum()
    };
    let value = loss(moving);
    let g = moving.backward(&v_color);
    type Field = fn(&mut Moving<f64>) -> &mut Vec<f64>;
    let pose = g.middle.cam_from_world.to_vec();
    let inputs: [(&str, Field, &[f64]); 9] = [
        ("means", |m| &mut m.case.means, &g.middle.means),
        ("quats", |m| &mut m.case.quats, &g.middle.quats),
        (
            "log_scales",
            |m| &mut m.case.log_scales,
            &g.middle.log_scales,
        ),
        (
            "opacity_logits",
            |m| &mut m.case.logits,
            &g.middle.opacity_logits,
        ),
        ("sh", |m| &mut m.case.sh, &g.middle.sh),
        ("cam_from_world", |m| &mut m.case.pose, &pose),
        ("poses", |m| &mut m.poses, &g.poses),
        ("moving_means", |m| &mut m.means, &g.moving_means),
        ("left_rotations", |m| &mut m.left, &g.left_rotations),
    ];
    for (name, field, analytic) in inputs {
        // Without bands over 0 no colour depends on where the middle is. The pose there counts for colours alone: its
        // gradient is small against the rounding of the differences.
        let undirected = moving.case.degree == 0 && name == "cam_from_world";
        check_entries(name, analytic, value, [undirected, true], |k, delta| {
            let mut moved = moving.clone();
            field(&mut moved)[k] += delta;
            loss(&moved)
        });
    }
}

#[test]
fn gradients_agree_with_central_differences() {
    for (seed, degree) in [(50, 0), (51, 1), (52, 3)] {
        let case = random_case(seed, 8, degree, 0, 0);
        check_gradients(&moving(case, 3, 5, Transfer::Srgb), 5);
    }
}

#[test]
fn gradients_agree_with_central_differences_without_movers_and_with_a_gamma() {
    let case = random_case(60, 6, 1, 0, 0);
    check_gradients(&moving(case, 2, 0, Transfer::Power(2.2)), 6);
}

#[test]
fn f32_agrees_with_f64() {
    let double = moving(random_case(80, 60, 3, 0, 0), 4, 10, Transfer::Srgb);
    let single = double.cast::<f32>();
    let widened = |v: &[f32]| v.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    let error = largest_difference(&double.picture(), &widened(&single.picture()));
    assert!(error < 5e-6, "picture {error:e}");
    let v_color = Random(11).fill(double.case.camera.num_pixels() * 3, -1.0, 1.0);
    let v_single: Vec<f32> = v_color.iter().map(|v| *v as f32).collect();
    let (a, b) = (double.backward(&v_color), single.backward(&v_single));
    for (name, a, b) in [
        ("means", &a.middle.means, &b.middle.means),
        ("quats", &a.middle.quats, &b.middle.quats),
        ("log_scales", &a.middle.log_scales, &b.middle.log_scales),
        (
            "opacity_logits",
            &a.middle.opacity_logits,
            &b.middle.opacity_logits,
        ),
        ("sh", &a.middle.sh, &b.middle.sh),
        ("screen", &a.middle.screen, &b.middle.screen),
        ("poses", &a.poses, &b.poses),
        ("moving_means", &a.moving_means, &b.moving_means),
        ("left_rotations", &a.left_rotations, &b.left_rotations),
    ] {
        let norm = a.iter().map(|v| v * v).sum::<f64>().sqrt();
        let squares = a.iter().zip(b).map(|(a, b)| (a - f64::from(*b)).powi(2));
        let error = squares.sum::<f64>().sqrt();
        assert!(error < 2e-5 * norm, "{name}: {:e}", error / norm);
    }
}

#[test]
fn what_is_not_usable_is_refused_by_name() {
    let good = moving(random_case(9, 12, 0, 0, 0), 2, 3, Transfer::Srgb);
    let refused = |edit: fn(&mut Moving<f64>)| {
        let mut bad = good.clone();
        edit(&mut bad);
        bad.with(|exposure| expose(exposure).unwrap_err().to_string())
    };
    for (edit, tensor) in [
        ((|m| m.poses.clear()) as fn(&mut Moving<f64>), "poses"),
        (|m| m.poses.truncate(23), "poses"),
        (|m| m.means.truncate(17), "moving_means"),
        (|m| m.left.truncate(53), "left_rotations"),
        (|m| m.means[4] = f64::NAN, "moving_means"),
        (|m| m.left[9 * 3 + 1] = f64::INFINITY, "left_rotations"),
        (|m| m.poses[13] = f64::NAN, "cam_from_world"),
        (|m| m.case.sh[7] = f64::NAN, "sh"),
    ] {
        let message = refused(edit);
        assert!(message.contains(tensor), "{tensor}: {message}");
    }
}
