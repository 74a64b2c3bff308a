//! Generated scenes, from a single Gaussian to lists of several batches a tile, with thin, huge, hidden and faint Gaussians
//! among them.

use burn::tensor::{DType, Device, Tensor};
use limpid_tests::{noise, tensor};
use splat_core::{Camera, Splats, Viewpoint};

/// A scene's inputs as matrices, by name.
pub(crate) type Inputs = Vec<(&'static str, [usize; 2], Vec<f64>)>;

/// Sizes of a case.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Case {
    pub(crate) rows: usize,
    pub(crate) moving: usize,
    pub(crate) samples: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) sh_degree: usize,
    pub(crate) features: usize,
}

pub(crate) const CASES: [Case; 5] = [
    Case {
        rows: 1,
        moving: 1,
        samples: 1,
        width: 1,
        height: 1,
        sh_degree: 0,
        features: 0,
    },
    Case {
        rows: 5,
        moving: 0,
        samples: 2,
        width: 19,
        height: 17,
        sh_degree: 1,
        features: 1,
    },
    // As many features as a GPU blends.
    Case {
        rows: 200,
        moving: 7,
        samples: 1,
        width: 40,
        height: 24,
        sh_degree: 0,
        features: 8,
    },
    Case {
        rows: 333,
        moving: 40,
        samples: 3,
        width: 50,
        height: 35,
        sh_degree: 2,
        features: 2,
    },
    Case {
        rows: 3001,
        moving: 1000,
        samples: 5,
        width: 33,
        height: 49,
        sh_degree: 3,
        features: 0,
    },
];

impl Case {
    pub(crate) fn camera(&self) -> Camera {
        let (w, h) = (self.width as f64, self.height as f64);
        Camera::pinhole(
            [self.width, self.height],
            [w, 0.9 * w],
            [0.45 * w, 0.55 * h],
        )
    }

    /// Every eighth Gaussian is thin, huge, behind the camera or faint; scales shrink with their number.
    pub(crate) fn inputs(&self) -> Inputs {
        let n = self.rows;
        let scaled = |count, seed, scale: f64, shift: f64| -> Vec<f64> {
            let noise = noise(count, seed);
            noise.iter().map(|v| v * scale + shift).collect()
        };
        let mut means = scaled(3 * n, 1, 1.5, 0.0);
        means.iter_mut().skip(2).step_by(3).for_each(|z| *z += 4.0);
        let mut log_scales = scaled(3 * n, 2, 0.7, -0.6 - (n as f64).ln() / 3.0);
        let mut logits = scaled(n, 3, 2.0, 0.5);
        for row in 1..n {
            match row % 32 {
                1 => log_scales[3 * row + 1] -= 5.0,
                9 => log_scales[3 * row] += 2.5,
                17 => means[3 * row + 2] = -1.0,
                25 => logits[row] = -7.0,
                _ => {}
            }
        }
        let (s, c) = 0.1_f64.sin_cos();
        let pose = vec![c, 0.0, s, 0.1, 0.0, 1.0, 0.0, -0.2, -s, 0.0, c, 0.3];
        let around = |values: &[f64], count: usize, seed, scale: f64| -> Vec<f64> {
            let noise = noise(count * values.len(), seed);
            let moved = noise.iter().zip(values.iter().cycle());
            moved.map(|(noise, v)| v + scale * noise).collect()
        };
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0].repeat(self.moving);
        let moving = &means[..3 * self.moving];
        let bands = (self.sh_degree + 1).pow(2) * 3;
        let mut sh = scaled(n * bands, 4, 0.2, 0.0);
        sh.chunks_exact_mut(bands)
            .for_each(|row| row[..3].iter_mut().for_each(|v| *v += 0.6));
        vec![
            ("quats", [n, 4], scaled(4 * n, 5, 1.3, 0.1)),
            ("log_scales", [n, 3], log_scales),
            ("opacity_logits", [n, 1], logits),
            ("sh", [n, bands], sh),
            ("features", [n, self.features], noise(n * self.features, 6)),
            (
                "poses",
                [self.samples, 12],
                around(&pose, self.samples, 7, 0.02),
            ),
            (
                "moving_means",
                [self.samples, 3 * self.moving],
                around(moving, self.samples, 8, 0.05),
            ),
            (
                "left_rotations",
                [self.samples, 9 * self.moving],
                around(&identity, self.samples, 9, 0.1),
            ),
            ("cam_from_world", [3, 4], pose),
            ("means", [n, 3], means),
        ]
    }

    /// The Gaussians and their view, tracked.
    pub(crate) fn scene(
        &self,
        inputs: &Inputs,
        device: &Device,
        dtype: DType,
    ) -> (Splats, Viewpoint) {
        let of = |name: &str| tracked(inputs, name, device, dtype);
        let splats = Splats {
            means: of("means"),
            quats: of("quats"),
            left_rotations: None,
            log_scales: of("log_scales"),
            opacity_logits: of("opacity_logits"),
            sh: of("sh"),
        };
        let view = Viewpoint {
            camera: self.camera(),
            cam_from_world: of("cam_from_world"),
            sh_degree: self.sh_degree,
        };
        (splats, view)
    }
}

/// An input, tracked.
pub(crate) fn tracked(inputs: &Inputs, name: &str, device: &Device, dtype: DType) -> Tensor<2> {
    let named = inputs.iter().find(|input| input.0 == name);
    let (_, shape, values) = named.expect("an input");
    tensor(values, *shape, device, dtype).require_grad()
}
