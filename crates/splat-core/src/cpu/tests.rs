//! Properties of the slice kernels as a whole.

use super::*;
use crate::{Camera, SplatError};
use glam::{DAffine3, DMat3, DQuat, DVec3};

/// SplitMix64.
struct Random(u64);

impl Random {
    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        low + (high - low) * ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn fill(&mut self, count: usize, low: f64, high: f64) -> Vec<f64> {
        (0..count).map(|_| self.uniform(low, high)).collect()
    }
}

/// Everything that goes into a render.
#[derive(Clone)]
struct Case<T> {
    means: Vec<T>,
    quats: Vec<T>,
    left: Vec<T>,
    log_scales: Vec<T>,
    logits: Vec<T>,
    sh: Vec<T>,
    features: Vec<T>,
    pose: Vec<T>,
    num_features: usize,
    degree: usize,
    camera: Camera,
}

impl<T: Real> Case<T> {
    fn slices(&self) -> SplatSlices<'_, T> {
        SplatSlices {
            means: &self.means,
            quats: &self.quats,
            left_rotations: &self.left,
            log_scales: &self.log_scales,
            opacity_logits: &self.logits,
            sh: &self.sh,
        }
    }

    fn view(&self) -> View<T> {
        View {
            camera: self.camera.clone(),
            cam_from_world: std::array::from_fn(|k| self.pose[k]),
            sh_degree: self.degree,
        }
    }

    fn project(&self) -> Projection<T> {
        project(&self.slices(), &self.view()).unwrap()
    }

    fn render(&self) -> Raster<T> {
        rasterize(&self.project(), &self.features, self.num_features).unwrap()
    }

    fn backward(&self, v_output: &[T]) -> Gradients<T> {
        let projection = self.project();
        let raster = rasterize(&projection, &self.features, self.num_features).unwrap();
        backward(
            &self.slices(),
            &projection,
            &self.features,
            &raster.state,
            v_output,
            BackwardOptions::default(),
        )
        .unwrap()
    }

    fn len(&self) -> usize {
        self.logits.len()
    }

    fn cast<U: Real>(&self) -> Case<U> {
        let c = |v: &[T]| v.iter().map(|x| U::of(x.to_f64())).collect();
        Case {
            means: c(&self.means),
            quats: c(&self.quats),
            left: c(&self.left),
            log_scales: c(&self.log_scales),
            logits: c(&self.logits),
            sh: c(&self.sh),
            features: c(&self.features),
            pose: c(&self.pose),
            num_features: self.num_features,
            degree: self.degree,
            camera: self.camera.clone(),
        }
    }

    /// The rows in another order; only without left rotations.
    fn permuted(&self, order: &[usize]) -> Self {
        assert!(
            self.left.is_empty(),
            "left rotations belong to the first rows"
        );
        let rows = |v: &[T], width: usize| -> Vec<T> {
            order
                .iter()
                .flat_map(|r| v[r * width..(r + 1) * width].to_vec())
                .collect()
        };
        Self {
            means: rows(&self.means, 3),
            quats: rows(&self.quats, 4),
            log_scales: rows(&self.log_scales, 3),
            logits: rows(&self.logits, 1),
            sh: rows(&self.sh, self.sh.len() / self.len()),
            features: rows(&self.features, self.num_features),
            ..self.clone()
        }
    }
}

fn pose_of(rotation: DQuat, translation: DVec3) -> Vec<f64> {
    crate::pose_rows(&DAffine3::from_rotation_translation(rotation, translation)).to_vec()
}

/// `count` Gaussians in front of a camera that looks roughly along z: off-centre principal point,
/// pixels that are not square, a turned camera, left rotations that are not quite rotations.
fn random_case(
    seed: u64,
    count: usize,
    degree: usize,
    num_features: usize,
    left: usize,
) -> Case<f64> {
    let mut r = Random(seed);
    let camera = Camera::pinhole(37, 21, 30.0, 26.0, 16.2, 12.1);
    let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.2, -0.3, 0.4);
    let translation = DVec3::new(0.3, -0.2, 0.5);
    let world_from_cam = DAffine3::from_rotation_translation(rotation, translation).inverse();
    let mut means = Vec::new();
    for k in 0..count {
        let z = r.uniform(2.0, 6.0);
        // Every fourth one far off the axis, where the Jacobian is clamped.
        let reach = if k % 4 == 3 { 1.0 } else { 0.4 };
        let (x, y) = (r.uniform(-reach, reach), r.uniform(-reach, reach));
        means.extend(
            world_from_cam
                .transform_point3(DVec3::new(x * z, y * z, z))
                .to_array(),
        );
    }
    let b = sh::num_coefficients(degree);
    let mut sh = r.fill(count * b * 3, -0.3, 0.3);
    for row in 0..count {
        for k in 0..3 {
            sh[row * b * 3 + k] += 1.0;
        }
    }
    let mut left_rotations = r.fill(9 * left, -0.2, 0.2);
    for f in 0..left {
        for k in 0..3 {
            left_rotations[9 * f + 4 * k] += 1.0;
        }
    }
    Case {
        means,
        quats: r.fill(4 * count, -1.5, 1.5),
        left: left_rotations,
        log_scales: r.fill(3 * count, -1.5, 0.3),
        logits: r.fill(count, -1.5, 1.5),
        sh,
        features: r.fill(count * num_features, -1.0, 1.0),
        pose: pose_of(rotation, translation),
        num_features,
        degree,
        camera,
    }
}

/// A single Gaussian straight ahead at the middle of the image, wide as the image.
fn one_ahead(opacity: f64) -> Case<f64> {
    Case {
        means: vec![0.0, 0.0, 2.0],
        quats: vec![1.0, 0.0, 0.0, 0.0],
        left: vec![],
        log_scales: vec![0.0; 3],
        logits: vec![(opacity / (1.0 - opacity)).ln()],
        sh: vec![1.0, 0.5, 0.0],
        features: vec![],
        pose: pose_of(DQuat::IDENTITY, DVec3::ZERO),
        num_features: 0,
        degree: 0,
        camera: Camera::pinhole(5, 5, 4.0, 4.0, 2.5, 2.5),
    }
}

fn with_threads<R: Send>(threads: usize, run: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap()
        .install(run)
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "lengths");
    a.iter().zip(b).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
}

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
        let d = (v3(&case.means, k) - centre).normalize();
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
        let (mut square, mut norm) = (0.0, 0.0);
        for k in 0..analytic.len() {
            let step = 1e-6;
            let at = |delta: f64| {
                let mut moved = case.clone();
                field(&mut moved)[k] += delta;
                loss(&moved)
            };
            let (low, high) = (at(-step), at(step));
            // Where a pixel crosses a cut-off, the loss jumps and the one-sided differences disagree
            // by the jump divided by the step.
            assert!(
                (high - 2.0 * value + low).abs() / step < 0.05,
                "entry {k} of {name} crosses a cut-off: take another seed"
            );
            let numeric = (high - low) / (2.0 * step);
            square += (numeric - analytic[k]).powi(2);
            norm += numeric * numeric;
        }
        assert!(
            analytic.is_empty() || norm > 0.0,
            "gradient of {name} is zero: the check says nothing"
        );
        assert!(
            square.sqrt() <= 1e-7 * norm.sqrt(),
            "gradient of {name}: relative L2 error {:e}",
            (square / norm).sqrt()
        );
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
fn same_bits_with_one_and_two_threads() {
    let mut case = random_case(50, 3000, 3, 1, 700).cast::<f32>();
    case.log_scales.iter_mut().for_each(|s| *s -= 1.5);
    case.camera = Camera::pinhole(150, 90, 120.0, 110.0, 70.0, 50.0);
    let v_output: Vec<f32> = Random(8)
        .fill(150 * 90 * 6, -1.0, 1.0)
        .into_iter()
        .map(|v| v as f32)
        .collect();
    let run = || {
        let g = case.backward(&v_output);
        let mut all = case.render().output;
        for part in [
            &g.means,
            &g.quats,
            &g.left_rotations,
            &g.log_scales,
            &g.opacity_logits,
            &g.sh,
            &g.features,
            &g.screen,
            &g.cam_from_world.to_vec(),
        ] {
            all.extend_from_slice(part);
        }
        all.into_iter().map(f32::to_bits).collect::<Vec<_>>()
    };
    let one = with_threads(1, run);
    for threads in [2, 3] {
        assert!(one == with_threads(threads, run), "{threads} threads");
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
    moved.pose = crate::pose_rows(&(pose * motion.inverse())).to_vec();
    let error = largest_difference(&case.render().output, &moved.render().output);
    assert!(error < 1e-11, "{error:e}");
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
fn extremes_stay_finite() {
    // Scales 1e-8 to 1e4 in every mixture, opacity logits of ±40, a zero and a huge quaternion, means
    // on the camera plane, at the near plane, behind and 1e6 away, a mean at the camera's centre.
    let camera = Camera::pinhole(20, 18, 30.0, 30.0, 10.0, 9.0);
    let far = [
        [0.0, 0.0, 2.0],
        [0.3, -0.2, 0.0],
        [0.0, 0.0, 0.010_001],
        [5.0, 5.0, 0.010_1],
        [0.0, 0.0, -3.0],
        [1e6, 0.0, 1e6],
        [0.0, 0.0, 1e6],
        [1e6, 1e6, 1.0],
        [0.0, 0.0, 0.0],
        [0.1, 0.1, 1.0],
    ];
    let scales = [1e-8_f64, 1e-3, 1.0, 1e4];
    let quats = [
        [1.0, 0.0, 0.0, 0.0],
        [0.0; 4],
        [1e15, -1e15, 1e15, 2e15],
        [1e-20, 2e-20, -1e-20, 0.0],
        [0.3, 0.5, -0.2, 0.7],
    ];
    let logits = [-40.0, 0.0, 40.0];
    let mut case = Case {
        means: vec![],
        quats: vec![],
        left: vec![],
        log_scales: vec![],
        logits: vec![],
        sh: vec![],
        features: vec![],
        pose: pose_of(DQuat::IDENTITY, DVec3::ZERO),
        num_features: 1,
        degree: 1,
        camera,
    };
    for mean in far {
        for a in scales {
            for b in scales {
                for quat in quats {
                    for logit in logits {
                        case.means.extend(mean);
                        case.quats.extend(quat);
                        case.log_scales.extend([a.ln(), b.ln(), a.ln()]);
                        case.logits.push(logit);
                        case.sh.extend([0.4; 12]);
                        case.features.push(1.0);
                    }
                }
            }
        }
    }
    let single = case.cast::<f32>();
    // All together, and each by itself so that none hides behind another.
    let rows: Vec<Vec<usize>> = std::iter::once((0..single.len()).collect())
        .chain((0..single.len()).map(|k| vec![k]))
        .collect();
    for rows in rows {
        let case = single.permuted(&rows);
        let output = case.render().output;
        assert!(output.iter().all(|v| v.is_finite()), "image of {rows:?}");
        let g = case.backward(&vec![1.0; output.len()]);
        for (name, part) in [
            ("means", &g.means),
            ("quats", &g.quats),
            ("log_scales", &g.log_scales),
            ("opacity_logits", &g.opacity_logits),
            ("sh", &g.sh),
            ("screen", &g.screen),
            ("pose", &g.cam_from_world.to_vec()),
        ] {
            assert!(
                part.iter().all(|v| v.is_finite()),
                "{name} of {rows:?}: mean {:?}, quat {:?}, scale {:?}, logit {:?}: {part:?}",
                &case.means[..3],
                &case.quats[..4],
                &case.log_scales[..3],
                case.logits[0],
            );
        }
    }
}

#[test]
fn thin_needles_keep_their_digits_in_f32() {
    // Ten thousand pixels long and under a pixel wide: a determinant from the products of the
    // covariance's entries would be noise in f32.
    let mut case = one_ahead(0.9);
    case.camera = Camera::pinhole(32, 32, 30.0, 30.0, 16.0, 16.0);
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
fn clamped_alpha_passes_no_gradient() {
    let mut case = one_ahead(0.5);
    case.camera = Camera::pinhole(1, 1, 4.0, 4.0, 0.5, 0.5);
    case.logits[0] = 20.0;
    let output = case.render().output;
    assert!((output[3] - MAX_ALPHA).abs() < 1e-15, "alpha {}", output[3]);
    let g = case.backward(&[1.0, 1.0, 1.0, 1.0, 0.0]);
    assert_eq!(g.opacity_logits[0], 0.0, "opacity");
    assert_eq!(g.log_scales, [0.0; 3], "scales");
    assert!(g.sh[0] > 0.0, "the colour still has one");
}

#[test]
fn what_is_not_drawn_has_no_radius_and_no_gradient() {
    let mut case = random_case(90, 6, 1, 0, 0);
    case.logits[1] = -10.0; // under alpha 1/255 everywhere
    case.logits[2] = 3.0;
    let camera_z: [f64; 3] = [case.pose[8], case.pose[9], case.pose[10]];
    for k in 0..3 {
        case.means[6 + k] -= 20.0 * camera_z[k]; // behind the camera
    }
    let projection = case.project();
    let g = case.backward(&vec![1.0; case.camera.num_pixels() * 5]);
    for row in [1, 2] {
        assert_eq!(projection.radii()[row], 0.0, "radius of row {row}");
        assert_eq!(
            g.means[3 * row..3 * row + 3],
            [0.0; 3],
            "gradient of row {row}"
        );
    }
    assert!(projection.radii()[0] > 0.0, "radius of row 0");
    assert_eq!(projection.num_visible(), 4, "visible");
}

#[test]
fn early_stop_hides_what_lies_behind() {
    let one = one_ahead(0.5);
    let mut case = one.clone();
    case.camera = Camera::pinhole(1, 1, 4.0, 4.0, 0.5, 0.5);
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

#[test]
fn no_gaussian_gives_a_black_image() {
    let mut case = one_ahead(0.5);
    for part in [
        &mut case.means,
        &mut case.quats,
        &mut case.log_scales,
        &mut case.logits,
        &mut case.sh,
    ] {
        part.clear();
    }
    let output = case.render().output;
    assert_eq!(output, vec![0.0; 125], "the image");
    let g = case.backward(&output);
    assert!(
        g.means.is_empty() && g.cam_from_world == [0.0; 12],
        "gradients"
    );
}

#[test]
fn what_is_not_finite_is_named_with_its_row() {
    let case = random_case(95, 600, 1, 2, 5);
    type Field = fn(&mut Case<f64>) -> &mut Vec<f64>;
    let inputs: [(&str, Field, usize, usize); 7] = [
        ("means", |c| &mut c.means, 3, 599),
        ("quats", |c| &mut c.quats, 4, 513),
        ("left_rotations", |c| &mut c.left, 9, 4),
        ("log_scales", |c| &mut c.log_scales, 3, 0),
        ("opacity_logits", |c| &mut c.logits, 1, 77),
        ("sh", |c| &mut c.sh, 12, 300),
        ("cam_from_world", |c| &mut c.pose, 4, 2),
    ];
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for (tensor, field, width, row) in inputs {
            let mut bad = case.clone();
            field(&mut bad)[row * width + width - 1] = value;
            let error = project(&bad.slices(), &bad.view()).unwrap_err();
            assert_eq!(error, SplatError::NotFinite { tensor, row }, "{value}");
        }
        let mut bad = case.clone();
        bad.features[2 * 31] = value;
        let error = rasterize(&case.project(), &bad.features, 2).unwrap_err();
        let expected = SplatError::NotFinite {
            tensor: "features",
            row: 31,
        };
        assert_eq!(error, expected, "{value}");
    }
}

#[test]
fn wrong_lengths_degrees_and_cameras_are_errors() {
    let case = random_case(96, 5, 1, 0, 0);
    let fails = |case: &Case<f64>| {
        project(&case.slices(), &case.view())
            .unwrap_err()
            .to_string()
    };
    let mut bad = case.clone();
    bad.quats.pop();
    assert!(fails(&bad).contains("quats"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.sh.truncate(5 * 3 * 3);
    assert!(fails(&bad).contains("sh"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.degree = 2;
    assert!(fails(&bad).contains("degree 2"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.left = vec![0.0; 9 * 6];
    assert!(fails(&bad).contains("left_rotations"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.camera.width = 0;
    assert!(fails(&bad).contains("camera"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.camera.fx = f64::NAN;
    assert!(fails(&bad).contains("fx"), "{}", fails(&bad));
}

#[test]
fn random_scenes_agree_with_the_textbook_renderer() {
    arbtest::arbtest(|u| {
        let mut case = random_case(u.arbitrary()?, u.int_in_range(0..=40)?, 1, 1, 0);
        case.camera = Camera::pinhole(
            u.int_in_range(1..=40)?,
            u.int_in_range(1..=40)?,
            f64::from(u.int_in_range(5..=60)?),
            f64::from(u.int_in_range(5..=60)?),
            f64::from(u.int_in_range(-10..=50)?),
            f64::from(u.int_in_range(-10..=50)?),
        );
        let shrink = f64::from(u.int_in_range(0..=40)?) * 0.1;
        case.log_scales.iter_mut().for_each(|s| *s -= shrink);
        if case.len() > 0 {
            let error = largest_difference(&case.render().output, &reference_image(&case));
            assert!(error < 1e-11, "{error:e}");
        }
        Ok(())
    });
}
