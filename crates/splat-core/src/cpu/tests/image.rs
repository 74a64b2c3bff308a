//! The image: against a textbook renderer, and its symmetries.

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::*;

/// The image by the textbook: every pixel on its own, covariances as matrices, conics inverted.
fn reference_image(case: &Case<f64>) -> Vec<f64> {
    let p = &case.pose;
    let w = DMat3::from_cols_array(&[p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]]);
    let t = DVec3::new(p[3], p[7], p[11]);
    let c = &case.camera;
    let v3 = |v: &[f64], k: usize| DVec3::new(v[3 * k], v[3 * k + 1], v[3 * k + 2]);
    let mut list = Vec::new();
    for k in 0..case.len() {
        let point = w * v3(&case.means, k) + t;
        if point.z <= c.near {
            continue;
        }
        let q = &case.quats[4 * k..];
        let mut rotation = DMat3::from_quat(DQuat::from_xyzw(q[1], q[2], q[3], q[0]).normalize());
        if 9 * k < case.left.len() {
            let l: [f64; 9] = std::array::from_fn(|i| case.left[9 * k + i]);
            rotation = DMat3::from_cols_array(&l).transpose() * rotation;
        }
        let m = w * rotation * DMat3::from_diagonal(v3(&case.log_scales, k).exp());
        let sigma = m * m.transpose();
        let clamp = |s: f64, size: usize, f: f64, centre: f64| {
            let margin = 0.15 * size as f64 / f;
            s.clamp(-centre / f - margin, (size as f64 - centre) / f + margin)
        };
        let tx = clamp(point.x / point.z, c.width, c.fx, c.cx);
        let ty = clamp(point.y / point.z, c.height, c.fy, c.cy);
        let j0 = DVec3::new(c.fx / point.z, 0.0, -c.fx * tx / point.z);
        let j1 = DVec3::new(0.0, c.fy / point.z, -c.fy * ty / point.z);
        let (xx, xy, yy) = (
            j0.dot(sigma * j0) + 0.3,
            j0.dot(sigma * j1),
            j1.dot(sigma * j1) + 0.3,
        );
        let det = xx * yy - xy * xy;
        let centre = -(w.transpose() * t);
        let d = (v3(&case.means, k) - centre).normalize_or_zero();
        let basis = sh::basis(case.degree, d.to_array());
        let b = case.sh.len() / (3 * case.len());
        let color: [f64; 3] = std::array::from_fn(|ch| {
            let sum: f64 = (0..sh::num_coefficients(case.degree))
                .map(|i| basis[i] * case.sh[(k * b + i) * 3 + ch])
                .sum();
            (sum + 0.5).max(0.0)
        });
        let opacity = 1.0 / (1.0 + (-case.logits[k]).exp());
        let mean = c.project(point);
        list.push((
            point.z,
            k,
            mean,
            [yy / det, -xy / det, xx / det],
            opacity,
            color,
        ));
    }
    list.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let f = case.num_features;
    let mut image = Vec::new();
    for y in 0..c.height {
        for x in 0..c.width {
            let mut pixel = vec![0.0; 5 + f];
            let mut transmittance = 1.0;
            for (z, k, mean, conic, opacity, color) in &list {
                let (dx, dy) = (x as f64 + 0.5 - mean.x, y as f64 + 0.5 - mean.y);
                let sigma = 0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) + conic[1] * dx * dy;
                let alpha = (opacity * (-sigma).exp()).min(MAX_ALPHA);
                if alpha < MIN_ALPHA {
                    continue;
                }
                let next = transmittance * (1.0 - alpha);
                if next <= MIN_TRANSMITTANCE {
                    break;
                }
                let weight = alpha * transmittance;
                for ch in 0..3 {
                    pixel[ch] += weight * color[ch];
                }
                pixel[4] += weight * z;
                for ch in 0..f {
                    pixel[5 + ch] += weight * case.features[k * f + ch];
                }
                transmittance = next;
            }
            pixel[3] = 1.0 - transmittance;
            image.extend(pixel);
        }
    }
    image
}

#[test]
fn image_agrees_with_the_textbook_renderer() {
    for (seed, count) in [(1, 12), (2, 300), (3, 3000)] {
        let mut case = random_case(seed, count, 3, 2, 4);
        if count > 100 {
            // Small and opaque: thresholds, early stops and culling all happen.
            case.log_scales.iter_mut().for_each(|s| *s -= 2.5);
            case.logits.iter_mut().for_each(|o| *o *= 4.0);
        }
        let error = largest_difference(&case.render().output, &reference_image(&case));
        assert!(error < 1e-12, "{count} Gaussians: {error:e}");
        let single = case.cast::<f32>().render().output;
        let single: Vec<f64> = single.into_iter().map(f64::from).collect();
        let error = largest_difference(&single, &reference_image(&case));
        // A pixel whose alpha is at the threshold may fall either way in f32.
        assert!(
            error < 2.0 / 255.0 * 6.0,
            "{count} Gaussians in f32: {error:e}"
        );
    }
}

#[test]
fn order_of_rows_does_not_matter_when_depths_differ() {
    let case = random_case(60, 200, 2, 1, 0);
    let mut order: Vec<usize> = (0..200).collect();
    let mut r = Random(9);
    for k in (1..200).rev() {
        order.swap(k, r.uniform(0.0, k as f64 + 1.0) as usize);
    }
    let moved = case.permuted(&order);
    assert_eq!(case.render().output, moved.render().output, "the image");
    let v_output = vec![0.5; case.camera.num_pixels() * 6];
    let (a, b) = (case.backward(&v_output), moved.backward(&v_output));
    for (to, from) in order.iter().enumerate() {
        assert_eq!(
            a.means[3 * from..3 * from + 3],
            b.means[3 * to..3 * to + 3],
            "gradient of row {from}"
        );
    }
}

#[test]
fn at_equal_depth_the_lower_row_is_in_front() {
    let one = one_ahead(0.6);
    // Red and green alone: a coefficient of -10 is clamped to black.
    let colors = [[1.0, -10.0, -10.0], [-10.0, 1.0, -10.0]];
    for (first, second) in [(0, 1), (1, 0)] {
        let mut case = one.clone();
        case.means.extend(one.means.clone());
        case.quats.extend(one.quats.clone());
        case.log_scales.extend(one.log_scales.clone());
        case.logits.extend(one.logits.clone());
        case.sh = [colors[first], colors[second]].concat();
        let output = case.render().output;
        let middle = &output[(2 * 5 + 2) * 5..][..5];
        assert!(
            (middle[first] / middle[second] - 2.5).abs() < 1e-12,
            "row 0 weighs 1 / (1 - 0.6) times row 1: {middle:?}"
        );
    }
}

#[test]
fn two_equal_gaussians_cover_two_a_minus_a_squared() {
    let one = one_ahead(0.7);
    let mut two = one.clone();
    for (to, from) in [
        (&mut two.means, &one.means),
        (&mut two.quats, &one.quats),
        (&mut two.log_scales, &one.log_scales),
        (&mut two.logits, &one.logits),
        (&mut two.sh, &one.sh),
    ] {
        to.extend_from_slice(from);
    }
    let (one, two) = (one.render().output, two.render().output);
    for (a, b) in one.chunks_exact(5).zip(two.chunks_exact(5)) {
        let a = a[3];
        assert!(
            (b[3] - (2.0 * a - a * a)).abs() < 1e-14,
            "{} from {a}",
            b[3]
        );
    }
    let middle = one[(2 * 5 + 2) * 5 + 3];
    assert!((middle - 0.7).abs() < 1e-14, "alpha at the mean: {middle}");
}

#[test]
fn moving_scene_and_camera_together_changes_nothing() {
    // SH of degree 0 only: higher bands live in the world's axes and would have to be turned too.
    let case = random_case(70, 40, 0, 1, 0);
    let motion = DAffine3::from_rotation_translation(
        DQuat::from_euler(glam::EulerRot::XYZ, 1.0, -0.4, 2.0),
        DVec3::new(3.0, -1.0, 0.5),
    );
    let turn = DQuat::from_mat3(&motion.matrix3);
    let mut moved = case.clone();
    for k in 0..case.len() {
        let m = DVec3::from_slice(&case.means[3 * k..]);
        moved.means[3 * k..3 * k + 3].copy_from_slice(&motion.transform_point3(m).to_array());
        let q = &case.quats[4 * k..4 * k + 4];
        let q = turn * DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
        moved.quats[4 * k..4 * k + 4].copy_from_slice(&[q.w, q.x, q.y, q.z]);
    }
    let p = &case.pose;
    let pose = DAffine3::from_mat3_translation(
        DMat3::from_cols_array(&[p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]]),
        DVec3::new(p[3], p[7], p[11]),
    );
    moved.pose = pose_rows(&(pose * motion.inverse())).to_vec();
    let error = largest_difference(&case.render().output, &moved.render().output);
    assert!(error < 1e-11, "{error:e}");
}

#[test]
fn thin_needles_keep_their_digits_in_f32() {
    // Ten thousand pixels long and under a pixel wide: a determinant from the products of the
    // covariance's entries would be noise in f32.
    let mut case = one_ahead(0.9);
    case.camera = Camera::pinhole([32, 32], [30.0, 30.0], [16.0, 16.0]);
    case.quats = vec![0.9, 0.1, 0.2, 0.3];
    case.log_scales = vec![(1e3_f64).ln(), (1e-3_f64).ln(), (1e-3_f64).ln()];
    let exact = case.render().output;
    let single: Vec<f64> = case
        .cast::<f32>()
        .render()
        .output
        .into_iter()
        .map(f64::from)
        .collect();
    let error = largest_difference(&exact, &single);
    assert!(error < 1e-3, "{error:e}");
}

#[test]
fn random_scenes_agree_with_the_textbook_renderer() {
    for seed in 0..1000 {
        let mut r = Random(seed);
        let mut case = random_case(seed, r.uniform(1.0, 41.0) as usize, 1, 1, 0);
        case.camera = Camera::pinhole(
            [r.uniform(1.0, 41.0) as usize, r.uniform(1.0, 41.0) as usize],
            [r.uniform(5.0, 60.0), r.uniform(5.0, 60.0)],
            [r.uniform(-10.0, 50.0), r.uniform(-10.0, 50.0)],
        );
        let shrink = r.uniform(0.0, 4.0);
        case.log_scales.iter_mut().for_each(|s| *s -= shrink);
        let error = largest_difference(&case.render().output, &reference_image(&case));
        assert!(error < 1e-11, "seed {seed}: {error:e}");
    }
}
