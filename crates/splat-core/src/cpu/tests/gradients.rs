//! Gradients: against central differences, and where they must vanish.

use super::*;

/// Every entry of every input against central differences of a random linear loss over all channels.
fn check_gradients(case: &Case<f64>, seed: u64) {
    let mut r = Random(seed);
    let size = case.camera.num_pixels() * (5 + case.num_features);
    let v_output = r.fill(size, -1.0, 1.0);
    let loss = |case: &Case<f64>| -> f64 {
        case.render()
            .output
            .iter()
            .zip(&v_output)
            .map(|(o, v)| o * v)
            .sum()
    };
    let value = loss(case);
    let g = case.backward(&v_output);
    type Field = fn(&mut Case<f64>) -> &mut Vec<f64>;
    let pose = g.cam_from_world.to_vec();
    let inputs: [(&str, Field, &[f64]); 8] = [
        ("means", |c| &mut c.means, &g.means),
        ("quats", |c| &mut c.quats, &g.quats),
        ("left_rotations", |c| &mut c.left, &g.left_rotations),
        ("log_scales", |c| &mut c.log_scales, &g.log_scales),
        ("opacity_logits", |c| &mut c.logits, &g.opacity_logits),
        ("sh", |c| &mut c.sh, &g.sh),
        ("features", |c| &mut c.features, &g.features),
        ("cam_from_world", |c| &mut c.pose, &pose),
    ];
    for (name, field, analytic) in inputs {
        check_entries(name, analytic, value, [false, false], |k, delta| {
            let mut moved = case.clone();
            field(&mut moved)[k] += delta;
            loss(&moved)
        });
    }
}

#[test]
fn gradients_agree_with_central_differences_at_every_sh_degree() {
    for degree in 0..=3 {
        check_gradients(&random_case(10 + degree as u64, 8, degree, 1, 3), 5);
    }
}

#[test]
fn gradients_agree_with_central_differences_for_any_number_of_features() {
    for num_features in [0, 1, 2, 5] {
        check_gradients(&random_case(20, 6, 1, num_features, 0), 6);
    }
}

#[test]
fn gradients_agree_with_central_differences_on_small_gaussians() {
    let mut case = random_case(31, 24, 2, 1, 6);
    case.log_scales.iter_mut().for_each(|s| *s -= 2.0);
    case.logits.iter_mut().for_each(|o| *o += 2.0);
    check_gradients(&case, 7);
}

#[test]
fn stored_bands_over_the_active_degree_take_no_part() {
    let mut case = random_case(40, 6, 3, 0, 0);
    case.degree = 1;
    let before = case.render().output;
    let g = case.backward(&vec![1.0; before.len()]);
    for row in 0..6 {
        for b in 4..16 {
            for k in 0..3 {
                let at = (row * 16 + b) * 3 + k;
                assert_eq!(g.sh[at], 0.0, "gradient of band {b}");
                case.sh[at] += 1.0;
            }
        }
    }
    assert_eq!(before, case.render().output, "the image");
}

#[test]
fn screen_statistic_is_the_norm_of_the_mean_gradient_in_ndc() {
    // A camera that does not turn, in front of one Gaussian whose depth takes no part: moving the
    // mean by dx moves its image by fx / z dx.
    let case = one_ahead(0.5);
    let mut r = Random(3);
    let mut v_output = r.fill(5 * 5 * 5, -1.0, 1.0);
    v_output.chunks_exact_mut(5).for_each(|v| v[4] = 0.0);
    let g = case.backward(&v_output);
    // Here the Jacobian depends on x only through x/z, whose effect on the covariance vanishes to
    // first order on the axis.
    let px = [g.means[0] * 2.0 / 4.0, g.means[1] * 2.0 / 4.0];
    let expected = (px[0] * 2.5).hypot(px[1] * 2.5);
    assert!(
        (g.screen[0] - expected).abs() < 1e-12 * expected,
        "{} against {expected}",
        g.screen[0]
    );
}

#[test]
fn f32_gradients_agree_with_f64() {
    let case = random_case(80, 60, 3, 1, 10);
    let v_output = Random(11).fill(case.camera.num_pixels() * 6, -1.0, 1.0);
    let single: Vec<f32> = v_output.iter().map(|v| *v as f32).collect();
    let (a, b) = (
        case.backward(&v_output),
        case.cast::<f32>().backward(&single),
    );
    for (name, a, b) in [
        ("means", &a.means, &b.means),
        ("quats", &a.quats, &b.quats),
        ("left_rotations", &a.left_rotations, &b.left_rotations),
        ("log_scales", &a.log_scales, &b.log_scales),
        ("opacity_logits", &a.opacity_logits, &b.opacity_logits),
        ("sh", &a.sh, &b.sh),
        ("features", &a.features, &b.features),
        ("screen", &a.screen, &b.screen),
        (
            "pose",
            &a.cam_from_world.to_vec(),
            &b.cam_from_world.to_vec(),
        ),
    ] {
        let norm = a.iter().map(|v| v * v).sum::<f64>().sqrt();
        let error = a
            .iter()
            .zip(b)
            .map(|(a, b)| (a - f64::from(*b)).powi(2))
            .sum::<f64>()
            .sqrt();
        assert!(error < 2e-5 * norm, "{name}: {:e}", error / norm);
    }
}

#[test]
fn clamped_alpha_passes_no_gradient() {
    let mut case = one_ahead(0.5);
    case.camera = Camera::pinhole([1, 1], [4.0, 4.0], [0.5, 0.5]);
    case.logits[0] = 20.0;
    let output = case.render().output;
    assert!((output[3] - MAX_ALPHA).abs() < 1e-15, "alpha {}", output[3]);
    let g = case.backward(&[1.0, 1.0, 1.0, 1.0, 0.0]);
    assert_eq!(g.opacity_logits[0], 0.0, "opacity");
    assert_eq!(g.log_scales, [0.0; 3], "scales");
    assert!(g.sh[0] > 0.0, "the colour still has one");
}

#[test]
fn early_stop_hides_what_lies_behind() {
    let one = one_ahead(0.5);
    let mut case = one.clone();
    case.camera = Camera::pinhole([1, 1], [4.0, 4.0], [0.5, 0.5]);
    for k in 1..200 {
        case.means.extend([0.0, 0.0, 2.0 + 0.01 * f64::from(k)]);
        case.quats.extend(&one.quats);
        case.log_scales.extend(&one.log_scales);
        case.logits.extend(&one.logits);
        case.sh.extend(&one.sh);
    }
    let g = case.backward(&[1.0, 0.0, 0.0, 0.0, 0.0]);
    // 0.5^13 is the last transmittance above 1e-4.
    let drawn = g.sh.chunks_exact(3).filter(|v| v[0] != 0.0).count();
    assert_eq!(drawn, 13, "Gaussians with a gradient");
    let alpha = case.render().output[3];
    assert!(
        (alpha - (1.0 - 0.5_f64.powi(13))).abs() < 1e-12,
        "alpha {alpha}"
    );
}
