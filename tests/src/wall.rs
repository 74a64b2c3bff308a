//! A textured wall with things before it, as Gaussians: what a camera's path and lens blur in different ways.

use crate::{noise, tensor};
use burn::tensor::{DType, Device};
use splat_core::Splats;

/// A textured wall at depth 4, and things before it at 2.5.
#[must_use]
pub fn splats(device: &Device) -> Splats {
    let (across, down) = (28, 20);
    let count = across * down + 80;
    let shift = noise(2 * count, 1);
    let mut means = Vec::new();
    for k in 0..across * down {
        let (x, y) = ((k % across) as f64, (k / across) as f64);
        let depth = 4.0;
        means.extend([
            (x - 13.5 + 0.4 * shift[2 * k]) / 28.0 * 4.4,
            (y - 9.5 + 0.4 * shift[2 * k + 1]) / 20.0 * 3.2,
            depth,
        ]);
    }
    for k in across * down..count {
        means.extend([1.0 * shift[2 * k], 0.7 * shift[2 * k + 1], 2.5]);
    }
    let sh = noise(3 * count, 2)
        .iter()
        .map(|v| 1.6 * v)
        .collect::<Vec<_>>();
    let f32s = |values: &[f64], shape| tensor(values, shape, device, DType::F32);
    Splats {
        means: f32s(&means, [count, 3]),
        quats: f32s(&[1.0, 0.0, 0.0, 0.0].repeat(count), [count, 4]),
        left_rotations: None,
        log_scales: f32s(&vec![0.05_f64.ln(); 3 * count], [count, 3]),
        opacity_logits: f32s(&vec![3.0; count], [count, 1]),
        sh: f32s(&sh, [count, 3]),
    }
}
