//! What is done for stability, each measured against doing without.

use crate::{largest, noise, tensor, values};
use burn::tensor::{DType, Device, Tensor, activation::softmax};
use glam::DAffine3;
use host::{Real, Vectors};
use motion_bases::{gram_schmidt, means_acceleration};
use pulp::{Arch, Simd, WithSimd};
use splat_core::Camera;
use splat_core::cpu::{SplatSlices, View, project};
use trainer::adam::{AdamState, AdamStep, LearningRate, adam_step};
use trainer::losses::intensity_penalty;

/// One measure and the f32 errors without and with it; NaN where nothing usable comes out.
#[derive(Clone, Debug)]
pub struct Measure {
    /// Where it is taken.
    pub place: &'static str,
    /// What is done, and what the error is of.
    pub what: &'static str,
    /// The error without.
    pub without: f64,
    /// The error with it.
    pub with: f64,
}

/// All measures.
#[must_use]
pub fn measures() -> Vec<Measure> {
    vec![
        kernel_softmax(),
        thin_ellipse(),
        exponential(),
        huge_vectors(),
        parallel_vectors(),
        length_at_rest(),
        overflowing_square(),
        order_of_sums(),
    ]
}

fn largest_error(found: &[f64], exact: &[f64]) -> f64 {
    assert_eq!(found.len(), exact.len(), "lengths");
    largest(found.iter().zip(exact).map(|(a, b)| (a - b).abs()))
}

/// The largest is subtracted before the exponential (log-sum-exp).
fn kernel_softmax() -> Measure {
    let logits: Vec<f32> = noise(81, 1).iter().map(|v| (200.0 * v) as f32).collect();
    let exact: Vec<f64> = {
        let largest = logits.iter().fold(f32::MIN, |m, v| m.max(*v));
        let exp: Vec<f64> = logits
            .iter()
            .map(|v| f64::from(v - largest).exp())
            .collect();
        let sum: f64 = exp.iter().sum();
        exp.iter().map(|e| e / sum).collect()
    };
    let plain: Vec<f32> = logits.iter().map(|v| v.exp()).collect();
    let sum: f32 = plain.iter().sum();
    let plain: Vec<f64> = plain.iter().map(|e| f64::from(e / sum)).collect();
    let wide: Vec<f64> = logits.iter().map(|v| f64::from(*v)).collect();
    let ours = softmax(tensor::<2>(&wide, [1, 81], &Device::flex(), DType::F32), 1);
    Measure {
        place: "blur kernels, motion weights",
        what: "softmax with the largest logit taken out; logits up to 200",
        without: largest_error(&plain, &exact),
        with: largest_error(&values(ours), &exact),
    }
}

/// The two rows whose Gram matrix and low-pass are the covariance of an ellipse of 1000 x 1 px at 45°.
const THIN: [[f64; 3]; 2] = [[1000.0, 0.7, 0.1], [1000.0, -0.7, 0.2]];

/// l11, l21 and l22 of that ellipse as splatting projects it in f32: sigma = (l11 dx + l21 dy)² + (l22 dy)².
fn thin_falloff() -> [f32; 3] {
    // A pixel is a unit at the depth of 1, so that the rows are those of the Gaussian's own axes.
    let view = View::new(
        &Camera::pinhole([2, 2], [1.0; 2], [1.0; 2]),
        &DAffine3::IDENTITY,
        0,
    );
    let axes = [THIN[0], THIN[1], [0.0, 0.0, 1.0]].map(|row| row.map(|v| v as f32));
    let splats = SplatSlices {
        means: &[0.0_f32, 0.0, 1.0],
        quats: &[1.0, 0.0, 0.0, 0.0],
        left_rotations: axes.as_flattened(),
        log_scales: &[0.0; 3],
        opacity_logits: &[0.0],
        sh: &[0.0; 3],
    };
    let stages = project(&splats, &view).expect("a Gaussian").stages();
    let seen = stages.projected[0].expect("it is in the image");
    seen.falloff.map(|v| v as f32)
}

/// Half the squared Mahalanobis distance over an ellipse of 1000 x 1 px at 45°, as a sum of squares and by the conic.
fn thin_ellipse() -> Measure {
    fn dot<T: Real>(a: [T; 3], b: [T; 3]) -> T {
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    }
    fn exactly(dx: f64, dy: f64) -> f64 {
        let [r0, r1] = THIN;
        let yy = dot(r1, r1) + 0.3;
        let rho = dot(r0, r1) / yy;
        let residual: [f64; 3] = std::array::from_fn(|k| r0[k] - rho * r1[k]);
        let e = dot(residual, residual) + 0.3 + rho * rho * 0.3;
        let p = dx - rho * dy;
        0.5 * (p * p / e + dy * dy / yy)
    }
    fn by_conic(dx: f32, dy: f32) -> f32 {
        let [r0, r1] = THIN.map(|row| row.map(|v| v as f32));
        let (xx, xy, yy) = (dot(r0, r0) + 0.3, dot(r0, r1), dot(r1, r1) + 0.3);
        let determinant = xx * yy - xy * xy;
        0.5 * (yy * dx * dx + xx * dy * dy) / determinant - xy * dx * dy / determinant
    }
    let points: Vec<[f32; 2]> = (0..40)
        .map(|k| {
            let along = 20.0 * (k as f32 - 20.0);
            [along + 0.5, along - 0.75]
        })
        .collect();
    let exact: Vec<f64> = points
        .iter()
        .map(|p| exactly(f64::from(p[0]), f64::from(p[1])))
        .collect();
    let error = |sigma: &dyn Fn(f32, f32) -> f32| {
        let found: Vec<f64> = points
            .iter()
            .map(|p| f64::from(sigma(p[0], p[1])))
            .collect();
        largest_error(&found, &exact)
    };
    let [l11, l21, l22] = thin_falloff();
    let by_squares = |dx: f32, dy: f32| (l11 * dx + l21 * dy).powi(2) + (l22 * dy).powi(2);
    Measure {
        place: "splatting, forward and backward",
        what: "an ellipse of 1000 x 1 px as a sum of squares, not by its conic; sigma near its long axis",
        without: error(&by_conic),
        with: error(&by_squares),
    }
}

/// The vectorised exponential of the inner loops against the library's, both relative to f64.
fn exponential() -> Measure {
    struct ExpNeg<'a>(&'a mut [f32]);
    impl WithSimd for ExpNeg<'_> {
        type Output = ();
        fn with_simd<S: Simd>(self, simd: S) {
            for x in f32::vectors_mut::<S>(self.0) {
                *x = f32::exp_neg(simd, *x);
            }
        }
    }

    // A multiple of any vector's length.
    let x: Vec<f32> = (0..200_064).map(|k| k as f32 * 3.998e-4).collect();
    let mut results = x.clone();
    Arch::new().dispatch(ExpNeg(&mut results));
    let off = |(x, y): (&f32, f32)| f64::from(y) / (-f64::from(*x)).exp() - 1.0;
    let library = x.iter().map(|x| off((x, (-x).exp())));
    let ours = x.iter().zip(results).map(off);
    Measure {
        place: "splatting, inner loops",
        what: "an exponential of our own that vectorises (\"without\": the library's); relative, from 0 to -80",
        without: largest(library),
        with: largest(ours),
    }
}

/// 6D vectors of 1e30, whose squares are no f32 numbers.
fn huge_vectors() -> Measure {
    let six: Vec<f64> = noise(6, 9)
        .iter()
        .map(|v| f64::from((v * 1e30) as f32))
        .collect();
    let (without, with) = orthonormal_defects(&six);
    Measure {
        place: "motion, 6D rotations",
        what: "entries clamped to 1e9; departure from orthonormal at entries of 1e30",
        without,
        with,
    }
}

/// Two vectors with a sine of 1e-5 between them.
fn parallel_vectors() -> Measure {
    let six = [0.3, 0.1, -0.2, 0.6, 0.2 + 1e-5, -0.4].map(|v: f64| f64::from(v as f32));
    let (without, with) = orthonormal_defects(&six);
    Measure {
        place: "motion, 6D rotations",
        what: "orthogonalised twice; departure from orthonormal at a sine of 1e-5",
        without,
        with,
    }
}

/// How far Gram–Schmidt is from orthonormal in f32: as in the textbook, and ours.
fn orthonormal_defects(six: &[f64]) -> (f64, f64) {
    let defect = |columns: [[f64; 3]; 3]| {
        let dot = |a: [f64; 3], b: [f64; 3]| -> f64 { (0..3).map(|k| a[k] * b[k]).sum() };
        let pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
        let errors = pairs.map(|(i, j)| dot(columns[i], columns[j]) - f64::from(u8::from(i == j)));
        largest_error(&errors, &[0.0; 6])
    };
    let a: Vec<f32> = six.iter().map(|v| *v as f32).collect();
    let unit = |v: [f32; 3]| {
        let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        v.map(|x| x / norm)
    };
    let x = unit([a[0], a[1], a[2]]);
    let along = x[0] * a[3] + x[1] * a[4] + x[2] * a[5];
    let y = unit(std::array::from_fn(|k| a[3 + k] - along * x[k]));
    let z = [
        x[1] * y[2] - x[2] * y[1],
        x[2] * y[0] - x[0] * y[2],
        x[0] * y[1] - x[1] * y[0],
    ];
    let r = values(gram_schmidt(tensor(
        six,
        [1, 6],
        &Device::flex(),
        DType::F32,
    )));
    let ours = [0, 1, 2].map(|j| [r[j], r[3 + j], r[6 + j]]);
    (defect([x, y, z].map(|v| v.map(f64::from))), defect(ours))
}

/// The length of an acceleration of zero has no derivative; with a floor under the root it is zero.
fn length_at_rest() -> Measure {
    let device = Device::flex().autodiff();
    let rest = || Tensor::<2>::ones([2, 3], (&device, DType::F32)).require_grad();
    let (a, b, c) = (rest(), rest(), rest());
    let steepest = |loss: Tensor<1>, leaf: &Tensor<2>| {
        let gradient = leaf.grad(&loss.backward()).expect("a gradient");
        largest(values(gradient))
    };
    let plain = (b.clone() * 2.0 - a.clone() - c.clone())
        .powi_scalar(2)
        .sum_dim(1)
        .sqrt()
        .sum();
    Measure {
        place: "smoothness of motion",
        what: "a floor under the root; gradient of an acceleration of zero",
        without: steepest(plain, &b),
        with: steepest(means_acceleration([&a, &b, &c], 1.0), &b),
    }
}

/// A gradient of 1e30, then 200,000 of 1: the share of the way that is lost.
fn overflowing_square() -> Measure {
    const STEPS: usize = 200_000;
    const RATE: f64 = 1e-3;
    let gradient = |step: usize| if step == 0 { 1e30 } else { 1.0 };
    let way = STEPS as f64 * RATE;
    // Adam in f64, but for the square.
    let (mut m, mut v, mut plain) = (0.0, 0.0, 0.0);
    for step in 0..STEPS {
        let g: f64 = gradient(step);
        m = 0.9 * m + 0.1 * g;
        v = 0.999 * v + 0.001 * f64::from(g as f32 * g as f32);
        let t = step as i32 + 1;
        let (m_hat, v_hat) = (m / (1.0 - 0.9_f64.powi(t)), v / (1.0 - 0.999_f64.powi(t)));
        plain += RATE * m_hat / (v_hat.sqrt() + 1e-15);
    }
    let (device, rate) = (Device::flex(), &LearningRate::Uniform(RATE));
    let mut p = Tensor::<2>::zeros([1, 1], (&device, DType::F32));
    let mut state = AdamState::new(&p);
    for step in 0..STEPS {
        let g = tensor(&[gradient(step)], [1, 1], &device, DType::F32);
        adam_step(&mut p, g, &mut state, &AdamStep { rate, drawn: &[] });
    }
    Measure {
        place: "Adam",
        what: "a gradient counts up to 1e15; share of its way that a parameter loses, of 200,000 steps after one gradient of 1e30",
        without: 1.0 - plain / way,
        with: 1.0 + values(p)[0] / way,
    }
}

/// Ten million numbers in one row of additions, and by rows as losses are.
fn order_of_sums() -> Measure {
    let numbers: Vec<f32> = noise(10_000_000, 5)
        .iter()
        .map(|v| (v + 1.0) as f32)
        .collect();
    let wide: Vec<f64> = numbers.iter().map(|v| f64::from(*v)).collect();
    let exact: f64 = wide.iter().sum();
    let one: f32 = numbers.iter().fold(0.0, |s, v| s + v);
    // A loss that is the mean of its input.
    let rows = tensor::<2>(&wide, [2_500, 4_000], &Device::flex(), DType::F32);
    let mean = values(intensity_penalty(rows))[0];
    let error = |sum: f64| (sum / exact - 1.0).abs();
    Measure {
        place: "losses, partial gradients",
        what: "summed in fixed pieces, then the pieces; relative error of ten million terms",
        without: error(f64::from(one)),
        with: error(mean * numbers.len() as f64),
    }
}
