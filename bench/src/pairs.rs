//! How many pairs of a pixel and a Gaussian a render needs: counted in f64, Gaussian by Gaussian, from the
//! textbook's formulas.

use glam::{DMat3, DQuat, DVec2, DVec3};
use splat_core::cpu::{LOW_PASS, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE};
use splat_core::{Camera, CameraModel, Gaussians};

/// Pairs whose alpha counts, seen from the origin along +z.
#[must_use]
pub fn count_pairs(gaussians: &Gaussians, camera: &Camera) -> usize {
    let mut order: Vec<usize> = (0..gaussians.len()).collect();
    order.sort_by(|&a, &b| gaussians.means[a][2].total_cmp(&gaussians.means[b][2]));
    let (width, height) = (camera.width, camera.height);
    let mut transmittance = vec![1.0_f64; width * height];
    let mut pairs = 0;
    for i in order {
        let Some((mean, [xx, xy, yy], opacity)) = project(gaussians, camera, i) else {
            continue;
        };
        let det = xx * yy - xy * xy;
        let reach = |variance: f64| (2.0 * (opacity / MIN_ALPHA).ln() * variance).sqrt();
        let range = |middle: f64, reach: f64, count: usize| {
            let from = (middle - reach - 0.5).ceil().max(0.0) as usize;
            let to = (middle + reach + 0.5).floor().clamp(0.0, count as f64) as usize;
            from..to
        };
        for y in range(mean.y, reach(yy), height) {
            for x in range(mean.x, reach(xx), width) {
                let d = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - mean;
                let mahalanobis = (yy * d.x * d.x - 2.0 * xy * d.x * d.y + xx * d.y * d.y) / det;
                let alpha = (opacity * (-0.5 * mahalanobis).exp()).min(MAX_ALPHA);
                let before = &mut transmittance[y * width + x];
                if alpha < MIN_ALPHA || *before == 0.0 {
                    continue;
                }
                let after = *before * (1.0 - alpha);
                if after > MIN_TRANSMITTANCE {
                    pairs += 1;
                    *before = after;
                } else {
                    *before = 0.0;
                }
            }
        }
    }
    pairs
}

/// Mean and covariance in the image, and opacity; `None` for what cannot be seen.
fn project(g: &Gaussians, camera: &Camera, i: usize) -> Option<(DVec2, [f64; 3], f64)> {
    let opacity = 1.0 / (1.0 + (-f64::from(g.opacity_logits[i])).exp());
    let mean = DVec3::from(g.means[i].map(f64::from));
    if opacity < MIN_ALPHA || mean.z <= camera.near {
        return None;
    }
    let [w, x, y, z] = g.quats[i].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scale = DVec3::from(g.log_scales[i].map(|s| f64::from(s).exp()));
    let factor = rotation * DMat3::from_diagonal(scale);
    let CameraModel::Pinhole = camera.model;
    let (fx, fy) = (camera.fx / mean.z, camera.fy / mean.z);
    let rows = [
        DVec3::new(fx, 0.0, -fx * mean.x / mean.z),
        DVec3::new(0.0, fy, -fy * mean.y / mean.z),
    ]
    .map(|row| factor.transpose() * row);
    let center = DVec2::new(fx * mean.x + camera.cx, fy * mean.y + camera.cy);
    let covariance = [
        rows[0].length_squared() + LOW_PASS,
        rows[0].dot(rows[1]),
        rows[1].length_squared() + LOW_PASS,
    ];
    Some((center, covariance, opacity))
}

#[cfg(test)]
mod tests {
    use crate::workload::{Blur, Workload};

    #[test]
    fn as_many_as_another_rasterizer_counts() {
        // 1.43 million for this distribution, drawn by another generator.
        let workload = Workload {
            width: 256,
            height: 144,
            gaussians: 20_000,
            blur: Blur::Off,
            kernel_size: 9,
        };
        let pairs = super::count_pairs(&workload.gaussians(), &workload.camera());
        assert!((1.40e6..1.46e6).contains(&(pairs as f64)), "{pairs} pairs");
    }
}
