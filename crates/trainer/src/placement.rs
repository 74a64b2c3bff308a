//! Where static Gaussians start: random static pixels, lifted by depth, or the sparse points.

use crate::neighbors::mean_neighbor_distances;
use crate::random::{Purpose, generator, sample};
use crate::settings::GaussianSettings;
use crate::views::pixel_center;
use glam::DVec3;
use io::{Frame, Map, Scene};
use splat_core::CameraModel;
use unseen_views::depth_edges;

/// Gaussians before they are tensors: isotropic, without rotation.
#[derive(Clone, Debug, Default)]
pub(crate) struct Seeds {
    /// Means in the world, scene units.
    pub means: Vec<DVec3>,
    /// RGB in [0, 1].
    pub colors: Vec<[f32; 3]>,
    /// Scales, scene units.
    pub scales: Vec<f64>,
}

impl Seeds {
    /// These and then the others.
    pub(crate) fn followed_by(mut self, others: Self) -> Self {
        self.means.extend(others.means);
        self.colors.extend(others.colors);
        self.scales.extend(others.scales);
        self
    }
}

/// Static Gaussians of a scene with depth: pixels outside the grown mask and off depth edges, the
/// same number from each frame; scale from the three nearest neighbours, at least half a pixel.
pub(crate) fn place_static(scene: &Scene, settings: &GaussianSettings, seed: u64) -> Seeds {
    let total = most_at_first(scene, settings);
    let with_depth = scene
        .frames
        .iter()
        .filter(|f| f.depth.is_some())
        .count()
        .max(1);
    let (mut means, mut colors, mut half_pixels) = (Vec::new(), Vec::new(), Vec::new());
    for (index, frame) in scene.frames.iter().enumerate() {
        let Some(depth) = &frame.depth else { continue };
        let candidates = static_pixels(frame, depth, settings);
        let mut rng = generator(seed, Purpose::Placement, index as u64);
        for j in sample(&mut rng, candidates.len(), total.div_ceil(with_depth)) {
            let i = candidates[j];
            let z = f64::from(depth.values[i]);
            means.push(lift(frame, i, z));
            colors.push(pixel_color(frame, i));
            half_pixels.push(match frame.view.camera.model {
                CameraModel::Pinhole => 0.5 * z / frame.view.camera.fx,
            });
        }
    }
    with_neighbor_scales(means, colors, &half_pixels)
}

/// Static Gaussians of a scene without depth: the sparse points, or as many of them as there may be.
pub(crate) fn place_points(scene: &Scene, settings: &GaussianSettings, seed: u64) -> Seeds {
    let mut rng = generator(seed, Purpose::Placement, 0);
    let total = most_at_first(scene, settings);
    let chosen = sample(&mut rng, scene.points.len(), total);
    let points = || chosen.iter().map(|i| &scene.points[*i]);
    let means: Vec<DVec3> = points().map(|p| p.position).collect();
    let colors = points().map(|p| p.color).collect();
    let half_pixels = vec![1e-9; means.len()];
    with_neighbor_scales(means, colors, &half_pixels)
}

/// So many static Gaussians at the start, or fewer.
fn most_at_first(scene: &Scene, settings: &GaussianSettings) -> usize {
    let first = scene.frames.first();
    let pixels = first.map_or(0, |frame| frame.view.camera.num_pixels());
    let of_pixels = (settings.initial_static_per_pixel * pixels as f64) as usize;
    settings.max_initial_static.min(of_pixels).max(1)
}

fn with_neighbor_scales(means: Vec<DVec3>, colors: Vec<[f32; 3]>, floors: &[f64]) -> Seeds {
    let distances = mean_neighbor_distances(&means);
    let scales = distances
        .iter()
        .zip(floors)
        .map(|(&d, &floor)| d.max(floor))
        .collect();
    Seeds {
        means,
        colors,
        scales,
    }
}

/// The world point of pixel `i` (row-major) at z-depth `z`.
pub(crate) fn lift(frame: &Frame, i: usize, z: f64) -> DVec3 {
    let camera = &frame.view.camera;
    let center = pixel_center(camera, i);
    frame
        .view
        .cam_from_world
        .inverse()
        .transform_point3(camera.unproject(center, z))
}

/// The colour of pixel `i` (row-major).
pub(crate) fn pixel_color(frame: &Frame, i: usize) -> [f32; 3] {
    let p = &frame.view.image.pixels;
    [p[3 * i], p[3 * i + 1], p[3 * i + 2]]
}

/// Pixels that certainly show the static scene.
fn static_pixels(frame: &Frame, depth: &Map, settings: &GaussianSettings) -> Vec<usize> {
    let margin = pixels_at_256(settings.mask_margin, depth.width);
    let moving = frame.mask.as_ref().map(|m| dilate(m, margin, 0.02));
    let edge = depth_edges(&depth.values, depth.width, settings.depth_edge);
    let chosen = (0..depth.values.len())
        .filter(|&i| depth.values[i] > 0.0 && !edge[i] && moving.as_ref().is_none_or(|m| !m[i]));
    chosen.collect()
}

/// A length given in pixels of a picture 256 wide, at another width, rounded up.
pub(crate) fn pixels_at_256(length: f64, width: usize) -> usize {
    (length * width as f64 / 256.0).ceil() as usize
}

/// Pixels within `radius` (a square window) of a pixel above `threshold`.
pub(crate) fn dilate(map: &Map, radius: usize, threshold: f32) -> Vec<bool> {
    let (w, h) = (map.width, map.height);
    let mut rows = vec![false; w * h];
    for y in 0..h {
        for x in 0..w {
            if map.values[y * w + x] > threshold {
                rows[y * w + x.saturating_sub(radius)..=y * w + (x + radius).min(w - 1)].fill(true);
            }
        }
    }
    let mut out = vec![false; w * h];
    for y in 0..h {
        for v in y.saturating_sub(radius)..=(y + radius).min(h - 1) {
            for x in 0..w {
                out[y * w + x] |= rows[v * w + x];
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(width: usize, height: usize, values: Vec<f32>) -> Map {
        Map {
            width,
            height,
            values,
        }
    }

    #[test]
    fn dilation_grows_by_a_square() {
        let mut values = vec![0.0; 49];
        values[3 * 7 + 3] = 1.0;
        let grown = dilate(&map(7, 7, values), 2, 0.5);
        for y in 0..7_usize {
            for x in 0..7_usize {
                assert_eq!(grown[y * 7 + x], x.abs_diff(3) <= 2 && y.abs_diff(3) <= 2);
            }
        }
    }
}
