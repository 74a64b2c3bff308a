//! What must not change a rendered image, and what its blending weights add up to: properties of the
//! splatting kernels, in f64 and in f32. (Tensors give the same bits: see splat_core/tensors.rs.)

use arbtest::arbitrary::{Result, Unstructured};
use glam::{DAffine3, DQuat, DVec2, DVec3};
use limpid_tests::{property, uniform};
use nalgebra::DMatrix;
use splat_core::Camera;
use splat_core::cpu::{Float, MIN_TRANSMITTANCE, SplatSlices, View, project, rasterize};

/// Gaussians and a view of them.
#[derive(Clone, Debug)]
struct Scene {
    camera: Camera,
    cam_from_world: DAffine3,
    means: Vec<DVec3>,
    quats: Vec<DQuat>,
    log_scales: Vec<DVec3>,
    logits: Vec<f64>,
    /// Coefficients [N, (degree + 1)², 3].
    sh: Vec<f64>,
    degree: usize,
}

/// What a scene is drawn from.
#[derive(Clone, Copy)]
struct Kind {
    /// Largest side of the image, in pixels.
    side: usize,
    /// How far means lie beside the image, in its sizes.
    beside: f64,
    /// Largest number of Gaussians.
    count: usize,
    depths: [f64; 2],
    log_scales: [f64; 2],
    logits: [f64; 2],
}

/// Every threshold is met: Gaussians under a pixel to wider than the image, invisible to clamped,
/// behind others that end the pixel, over the border, beside the image, and nearer than `NEAR`.
const ANY: Kind = Kind {
    side: 40,
    beside: 0.4,
    count: 40,
    depths: [0.5, 4.0],
    log_scales: [-5.0, 0.0],
    logits: [-7.0, 9.0],
};
/// No threshold is met, so that rounding changes little: standard deviations are over
/// 1.2 * 15 / 4 = 4.5 px and no pixel is farther than 11.4 px from a mean, so that every alpha is over
/// 0.26 exp(-3.2) = 0.01; five Gaussians of opacity 0.74 leave a transmittance of 0.001.
const CALM: Kind = Kind {
    side: 8,
    beside: 0.0,
    count: 5,
    depths: [1.2, 4.0],
    log_scales: [0.2, 1.0],
    logits: [-1.0, 1.0],
};
const NEAR: f64 = 1.0;

fn vector(u: &mut Unstructured<'_>, size: f64) -> Result<DVec3> {
    Ok(DVec3::new(
        uniform(u, -size, size)?,
        uniform(u, -size, size)?,
        uniform(u, -size, size)?,
    ))
}

fn rotation(u: &mut Unstructured<'_>) -> Result<DQuat> {
    let axis = vector(u, 1.0)?.try_normalize().unwrap_or(DVec3::Z);
    Ok(DQuat::from_axis_angle(axis, uniform(u, -3.2, 3.2)?))
}

/// A random order of so many things.
fn order(u: &mut Unstructured<'_>, count: usize) -> Result<Vec<usize>> {
    let mut order: Vec<usize> = (0..count).collect();
    for k in (1..count).rev() {
        order.swap(k, u.int_in_range(0..=k)?);
    }
    Ok(order)
}

fn scene(u: &mut Unstructured<'_>, kind: Kind, degree: usize) -> Result<Scene> {
    let (width, height) = (
        u.int_in_range(1..=kind.side)?,
        u.int_in_range(1..=kind.side)?,
    );
    let size = DVec2::new(width as f64, height as f64);
    let camera = Camera::pinhole(
        [width, height],
        [uniform(u, 15.0, 30.0)?, uniform(u, 15.0, 30.0)?],
        [uniform(u, 0.0, size.x)?, uniform(u, 0.0, size.y)?],
    )
    .with_near(NEAR);
    let cam_from_world = DAffine3::from_rotation_translation(rotation(u)?, vector(u, 2.0)?);
    let world_from_cam = cam_from_world.inverse();
    let count = u.int_in_range(1..=kind.count)?;
    let mut scene = Scene {
        camera,
        cam_from_world,
        means: Vec::new(),
        quats: Vec::new(),
        log_scales: Vec::new(),
        logits: Vec::new(),
        sh: Vec::new(),
        degree,
    };
    // Depths differ by far more than they are rounded.
    let [nearest, farthest] = kind.depths;
    for layer in order(u, count)? {
        let layer = layer as f64 + uniform(u, 0.0, 0.5)?;
        let depth = nearest + (farthest - nearest) * layer / count as f64;
        let pixel = DVec2::new(
            size.x * uniform(u, -kind.beside, 1.0 + kind.beside)?,
            size.y * uniform(u, -kind.beside, 1.0 + kind.beside)?,
        );
        let in_cam = scene.camera.unproject(pixel, depth);
        scene.means.push(world_from_cam.transform_point3(in_cam));
        scene.quats.push(rotation(u)? * uniform(u, 0.1, 3.0)?);
        let [low, high] = kind.log_scales;
        scene.log_scales.push(DVec3::new(
            uniform(u, low, high)?,
            uniform(u, low, high)?,
            uniform(u, low, high)?,
        ));
        scene
            .logits
            .push(uniform(u, kind.logits[0], kind.logits[1])?);
        for _ in 0..3 * (degree + 1) * (degree + 1) {
            scene.sh.push(uniform(u, -0.5, 0.5)?);
        }
    }
    Ok(scene)
}

impl Scene {
    fn len(&self) -> usize {
        self.means.len()
    }

    /// The image [H, W, 5 + F] in `T`, with features [N, F].
    fn image<T: Float>(&self, features: &[f64]) -> Vec<f64> {
        let cast = |values: Vec<f64>| -> Vec<T> { values.into_iter().map(T::from_f64).collect() };
        let flat = |vectors: &[DVec3]| {
            cast(
                vectors
                    .iter()
                    .flat_map(|v| v.to_array())
                    .collect::<Vec<_>>(),
            )
        };
        let quats = self.quats.iter().flat_map(|q| [q.w, q.x, q.y, q.z]);
        let view = View::new(&self.camera, &self.cam_from_world, self.degree);
        let projection = project(
            &SplatSlices {
                means: &flat(&self.means),
                quats: &cast(quats.collect()),
                left_rotations: &[],
                log_scales: &flat(&self.log_scales),
                opacity_logits: &cast(self.logits.clone()),
                sh: &cast(self.sh.clone()),
            },
            &view,
        )
        .expect("good input");
        let num_features = features.len() / self.len();
        let raster = rasterize(&projection, &cast(features.to_vec()), num_features);
        let output = raster.expect("good features").output;
        output.into_iter().map(T::into).collect()
    }

    /// The blending weights, [H, W, N], and alpha, [H, W].
    fn weights<T: Float>(&self) -> (Vec<Vec<f64>>, Vec<f64>) {
        let n = self.len();
        let one_hot: Vec<f64> = (0..n * n)
            .map(|i| f64::from(u8::from(i / n == i % n)))
            .collect();
        self.image::<T>(&one_hot)
            .chunks_exact(5 + n)
            .map(|pixel| (pixel[5..].to_vec(), pixel[3]))
            .unzip()
    }

    /// The Gaussians of these rows, in this order.
    fn rows(&self, rows: &[usize]) -> Self {
        let width = self.sh.len() / self.len();
        let sh = |row: usize| self.sh[row * width..(row + 1) * width].to_vec();
        Self {
            means: rows.iter().map(|&k| self.means[k]).collect(),
            quats: rows.iter().map(|&k| self.quats[k]).collect(),
            log_scales: rows.iter().map(|&k| self.log_scales[k]).collect(),
            logits: rows.iter().map(|&k| self.logits[k]).collect(),
            sh: rows.iter().flat_map(|&k| sh(k)).collect(),
            ..self.clone()
        }
    }

    /// Scene and camera moved together, with SH turned by `turn_sh`.
    fn moved(&self, turn: DQuat, shift: DVec3, turn_sh: impl Fn(&[f64]) -> Vec<f64>) -> Self {
        let motion = DAffine3::from_rotation_translation(turn, shift);
        let width = self.sh.len() / self.len();
        Self {
            cam_from_world: self.cam_from_world * motion.inverse(),
            means: self
                .means
                .iter()
                .map(|&m| motion.transform_point3(m))
                .collect(),
            quats: self.quats.iter().map(|&q| turn * q).collect(),
            sh: self.sh.chunks_exact(width).flat_map(turn_sh).collect(),
            ..self.clone()
        }
    }
}

fn assert_same(a: &[f64], b: &[f64], limit: f64, what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    for (k, (a, b)) in a.iter().zip(b).enumerate() {
        assert!((a - b).abs() <= limit, "{what}: entry {k} is {a}, then {b}");
    }
}

/// Images that should be the same. Coordinates are under 20 and go through half a dozen roundings: a
/// point moves by 1e-14 in f64 and by 5e-6 in f32, which is 30 px times that in the image at most.
/// Alpha changes by at most 1 per pixel in f64 (the low-pass filter sees to it), and by 0.1 where the
/// standard deviation is 4.5 px; depth moves as the point does, and colour by a few per radian of the
/// direction it is seen from.
fn assert_same_image(any: [&Scene; 2], calm: [&Scene; 2], what: &str) {
    let [a, b] = any.map(|scene| scene.image::<f64>(&[]));
    assert_same(&a, &b, 1e-12, what);
    let [a, b] = calm.map(|scene| scene.image::<f32>(&[]));
    assert_same(&a, &b, 1e-5, what);
}

#[test]
fn translating_scene_and_camera_together_changes_nothing_at_any_sh_degree() {
    property("translation", 400, |u| {
        for degree in 0..=3 {
            let shift = vector(u, 5.0)?;
            let (any, calm) = (scene(u, ANY, degree)?, scene(u, CALM, degree)?);
            let moved = |s: &Scene| s.moved(DQuat::IDENTITY, shift, <[f64]>::to_vec);
            assert_same_image(
                [&any, &moved(&any)],
                [&calm, &moved(&calm)],
                &format!("degree {degree}, shift {shift}"),
            );
        }
        Ok(())
    });
}

#[test]
fn rotating_scene_and_camera_together_changes_nothing_with_sh_rotated_too() {
    property("rotation", 400, |u| {
        for degree in 0..=3 {
            let (turn, shift) = (rotation(u)?, vector(u, 5.0)?);
            let (any, calm) = (scene(u, ANY, degree)?, scene(u, CALM, degree)?);
            let bands: Vec<DMatrix<f64>> = (0..=degree).map(|l| band_rotation(l, turn)).collect();
            let moved = |s: &Scene| s.moved(turn, shift, |sh| turned_sh(&bands, sh));
            assert_same_image(
                [&any, &moved(&any)],
                [&calm, &moved(&calm)],
                &format!("degree {degree}, turn {turn}, shift {shift}"),
            );
        }
        Ok(())
    });
}

/// The matrix that turns the coefficients of band `l`: fitted, so that the turned function has in the
/// turned direction the value that the function had.
fn band_rotation(l: usize, turn: DQuat) -> DMatrix<f64> {
    // 32 directions all over the sphere, along a spiral.
    let directions: Vec<DVec3> = (0..32)
        .map(|k| {
            let z = (2.0 * f64::from(k) + 1.0) / 32.0 - 1.0;
            let (sin, cos) = (2.4 * f64::from(k)).sin_cos();
            let r = (1.0 - z * z).sqrt();
            DVec3::new(r * cos, r * sin, z)
        })
        .collect();
    let sampled = |turn: DQuat| {
        let values: Vec<f64> = directions
            .iter()
            .flat_map(|&d| harmonics(l, turn * d))
            .collect();
        DMatrix::from_row_slice(directions.len(), 2 * l + 1, &values)
    };
    let (before, after) = (sampled(DQuat::IDENTITY), sampled(turn));
    let square = (after.transpose() * &after).cholesky();
    let square = square.expect("directions all over the sphere");
    let fitted = square.solve(&(after.transpose() * &before));
    let error = (after * &fitted - before).amax();
    assert!(error < 1e-14, "band {l} does not turn into itself: {error}");
    fitted
}

/// Coefficients [(degree + 1)², 3] of the turned function.
fn turned_sh(bands: &[DMatrix<f64>], sh: &[f64]) -> Vec<f64> {
    let mut turned = Vec::new();
    for (l, band) in bands.iter().enumerate() {
        let own = &sh[3 * l * l..3 * (l + 1) * (l + 1)];
        let product = band * DMatrix::from_row_slice(2 * l + 1, 3, own);
        turned.extend(product.transpose().iter());
    }
    turned
}

/// Band `l` of the real spherical harmonics, by their definition: orders -l to l, with the
/// Condon–Shortley phase.
fn harmonics(l: usize, d: DVec3) -> Vec<f64> {
    let azimuth = d.y.atan2(d.x);
    let factorial = |n: usize| (1..=n).map(|k| k as f64).product::<f64>();
    (0..=2 * l)
        .map(|k| {
            let m = k.abs_diff(l);
            let square = (2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - m)
                / factorial(l + m);
            let along = square.sqrt() * legendre(l, m, d);
            let (sin, cos) = (m as f64 * azimuth).sin_cos();
            match k.cmp(&l) {
                std::cmp::Ordering::Less => 2.0_f64.sqrt() * along * sin,
                std::cmp::Ordering::Equal => along,
                std::cmp::Ordering::Greater => 2.0_f64.sqrt() * along * cos,
            }
        })
        .collect()
}

/// The associated Legendre function of degree l and order m at d.z, with the Condon–Shortley phase.
fn legendre(l: usize, m: usize, d: DVec3) -> f64 {
    let root = d.truncate().length(); // sqrt(1 - z²), without its loss of digits near the poles
    let mut value: f64 = (1..=m).map(|k| -(2.0 * k as f64 - 1.0) * root).product();
    let mut before = 0.0;
    for n in m + 1..=l {
        let next =
            ((2 * n - 1) as f64 * d.z * value - (n + m - 1) as f64 * before) / (n - m) as f64;
        (before, value) = (value, next);
    }
    value
}

#[test]
fn the_order_of_rows_does_not_matter_when_depths_differ() {
    property("order", 1000, |u| {
        let scene = scene(u, ANY, 1)?;
        let order = order(u, scene.len())?;
        let feature: Vec<f64> = (0..scene.len())
            .map(|_| uniform(u, -1.0, 1.0))
            .collect::<Result<_>>()?;
        let moved_feature: Vec<f64> = order.iter().map(|&k| feature[k]).collect();
        let moved = scene.rows(&order);
        let [a, b] = [
            scene.image::<f64>(&feature),
            moved.image::<f64>(&moved_feature),
        ];
        assert_same(&a, &b, 0.0, "f64");
        let [a, b] = [
            scene.image::<f32>(&feature),
            moved.image::<f32>(&moved_feature),
        ];
        assert_same(&a, &b, 0.0, "f32");
        Ok(())
    });
}

#[test]
fn at_equal_depth_the_lower_row_is_in_front() {
    property("equal depth", 300, |u| {
        for (kind, single) in [(ANY, false), (CALM, true)] {
            let mut scene = scene(u, kind, 0)?;
            // A camera that only rolls: a mean's z alone is its depth, to the bit.
            let roll = DQuat::from_rotation_z(uniform(u, -3.2, 3.2)?);
            let depth = uniform(u, 1.2, 4.0)?;
            let shift = vector(u, 2.0)?.with_z(0.0);
            for mean in &mut scene.means {
                let in_cam = scene.cam_from_world.transform_point3(*mean);
                let there = in_cam * (depth / in_cam.z);
                *mean = (roll.inverse() * (there - shift)).with_z(depth);
            }
            scene.cam_from_world = DAffine3::from_rotation_translation(roll, shift);

            let weights = |scene: &Scene| {
                if single {
                    scene.weights::<f32>()
                } else {
                    scene.weights::<f64>()
                }
            };
            let alone: Vec<Vec<f64>> = (0..scene.len())
                .map(|row| weights(&scene.rows(&[row])).1)
                .collect();
            // An alpha of the calm scene comes back from 1 - (1 - a) off by 6e-8, and a weight is a
            // product of up to five such factors.
            let limit = if single { 1e-6 } else { 1e-14 };
            for (pixel, weights) in weights(&scene).0.iter().enumerate() {
                let mut transmittance = 1.0;
                for (row, &weight) in weights.iter().enumerate() {
                    let alpha = alone[row][pixel];
                    let after = transmittance * (1.0 - alpha);
                    if after <= MIN_TRANSMITTANCE {
                        transmittance = 0.0;
                    }
                    let expected = alpha * transmittance;
                    assert!(
                        (weight - expected).abs() <= limit,
                        "pixel {pixel}: row {row} weighs {weight}, not {expected}"
                    );
                    transmittance = after.min(transmittance);
                }
            }
        }
        Ok(())
    });
}

#[test]
fn two_equal_gaussians_at_one_place_have_twice_alpha_less_its_square() {
    let (mut drawn, mut ended) = (0, 0);
    property("two equal", 2000, |u| {
        let one = scene(u, ANY, 0)?.rows(&[0]);
        let two = one.rows(&[0, 0]);
        let images = [
            (one.image::<f64>(&[]), two.image::<f64>(&[]), 1e-15),
            // 1 - a, its square and 1 less that are rounded once each.
            (one.image::<f32>(&[]), two.image::<f32>(&[]), 3e-7),
        ];
        for (one, two, limit) in images {
            for (one, two) in one.chunks_exact(5).zip(two.chunks_exact(5)) {
                let a = one[3];
                let left = (1.0 - a) * (1.0 - a);
                if (left / MIN_TRANSMITTANCE - 1.0).abs() < 1e-4 {
                    continue; // it may end either way
                }
                // From an alpha of 0.99 on, below the clamp at 0.999, the pixel is at its end before
                // the second one.
                let expected = if left > MIN_TRANSMITTANCE {
                    drawn += usize::from(a > 0.0);
                    2.0 * a - a * a
                } else {
                    ended += 1;
                    a
                };
                assert!(
                    (two[3] - expected).abs() <= limit,
                    "alpha {a} became {}, not {expected}",
                    two[3]
                );
            }
        }
        Ok(())
    });
    assert!(
        drawn > 1000 && ended > 10,
        "pixels: {drawn} with both drawn, {ended} with one"
    );
}

#[test]
fn blending_weights_are_not_negative_and_sum_to_alpha_which_is_at_most_one() {
    property("weights", 1000, |u| {
        let scene = scene(u, ANY, 0)?;
        // In f32 each of 40 weights and of 40 factors of the transmittance is rounded.
        let images = [
            (scene.weights::<f64>(), 1e-14),
            (scene.weights::<f32>(), 80.0 * 6e-8),
        ];
        for ((weights, alphas), limit) in images {
            for (weights, alpha) in weights.iter().zip(alphas) {
                assert!(weights.iter().all(|w| *w >= 0.0), "weights {weights:?}");
                let sum: f64 = weights.iter().sum();
                assert!((sum - alpha).abs() <= limit, "{sum} is not alpha {alpha}");
                // The light that is left never falls to the limit.
                let largest = 1.0 - MIN_TRANSMITTANCE + 6e-8;
                assert!((0.0..=largest).contains(&alpha), "alpha {alpha}");
            }
        }
        Ok(())
    });
}
