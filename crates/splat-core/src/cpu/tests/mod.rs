//! Properties of the slice kernels as a whole; here the random cases that the tests share.

mod contracts;
mod exposure;
mod gradients;
mod image;

use super::real::Real;
use super::*;
use crate::camera::{Camera, pose_rows};
use glam::{DAffine3, DQuat, DVec3};

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

impl<T: Real + Float> Case<T> {
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

    fn view(&self) -> View {
        View {
            camera: self.camera.clone(),
            cam_from_world: std::array::from_fn(|k| self.pose[k].to_f64()),
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
        let forward = Forward {
            splats: &self.slices(),
            projection: &projection,
            features: &self.features,
            state: &raster.state,
        };
        backward(&forward, v_output, BackwardOptions::default()).unwrap()
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
    pose_rows(&DAffine3::from_rotation_translation(rotation, translation)).to_vec()
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
    let camera = Camera::pinhole([37, 21], [30.0, 26.0], [16.2, 12.1]);
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
        camera: Camera::pinhole([5, 5], [4.0, 4.0], [2.5, 2.5]),
    }
}

/// NaN where one is: it is the largest of all.
fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "lengths");
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    differences.max_by(f64::total_cmp).unwrap_or(0.0)
}

/// Every entry of an input's gradient against central differences; `at` is the loss where entry `k` is moved, `value` that
/// where none is. The flags: the gradient may be zero everywhere; it may be off by the rounding of the differences too.
fn check_entries(
    name: &str,
    analytic: &[f64],
    value: f64,
    [may_vanish, may_round]: [bool; 2],
    at: impl Fn(usize, f64) -> f64,
) {
    let (mut square, mut norm) = (0.0, 0.0);
    for k in 0..analytic.len() {
        let step = 1e-6;
        let (low, high) = (at(k, -step), at(k, step));
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
        analytic.is_empty() || may_vanish || norm > 0.0,
        "gradient of {name} is zero: the check says nothing"
    );
    // The differences themselves are rounded to some 1e-9.
    let rounding = if may_round { 1e-8 } else { 0.0 };
    assert!(
        square.sqrt() <= 1e-7 * norm.sqrt() + rounding,
        "gradient of {name}: relative L2 error {:e}",
        (square / norm).sqrt()
    );
}
