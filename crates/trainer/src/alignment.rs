//! Depth against the sparse points: a frame's disparity is known up to a scale and a shift, which the points tell.

use crate::views::pixel_of;
use glam::DAffine3;
use io::{Frame, Map, SparsePoint};

/// Fewer sparse points than this in a frame say too little about its depth.
pub(crate) const MIN_POINTS: usize = 20;

/// Points whose disparity differs by more than this share from a frame's depth are hidden there.
const HIDDEN: f64 = 0.05;

/// The sparse points that a frame sees from a pose: index of the pixel, and z-depth; hidden ones as well.
pub(crate) fn points_from<'a>(
    frame: &'a Frame,
    cam_from_world: &'a DAffine3,
    points: &'a [SparsePoint],
) -> impl Iterator<Item = (usize, f64)> + 'a {
    points.iter().filter_map(move |point| {
        let c = cam_from_world.transform_point3(point.position);
        Some((pixel_of(&frame.view.camera, c)?, c.z))
    })
}

/// The points that a frame sees where nothing moves.
fn still_points<'a>(
    frame: &'a Frame,
    points: &'a [SparsePoint],
) -> impl Iterator<Item = (usize, f64)> + 'a {
    let moves = |i: usize| frame.mask.as_ref().is_some_and(|m| m.values[i] > 0.0);
    points_from(frame, &frame.view.cam_from_world, points).filter(move |(i, _)| !moves(*i))
}

/// z-depth of the sparse points in a frame, 0 where there is none, [H, W]; without those that its own depth, aligned to
/// them, hides. `None` where there are too few.
pub(crate) fn point_depths(frame: &Frame, points: &[SparsePoint]) -> Option<Vec<f32>> {
    let depth = frame.depth.as_ref()?;
    let mut map = vec![0.0; depth.values.len()];
    for (i, z) in still_points(frame, points) {
        let away = z / f64::from(depth.values[i]) - 1.0;
        if away.abs() < HIDDEN {
            map[i] = z as f32;
        }
    }
    let count = map.iter().filter(|z| **z > 0.0).count();
    (count >= MIN_POINTS).then_some(map)
}

/// What turns a frame's disparity into that of the points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DisparityFit {
    pub(crate) scale: f64,
    pub(crate) shift: f64,
}

impl DisparityFit {
    /// Robust scale and shift from disparities (given, of the points), of which there is at least one: least absolute differences
    /// by re-weighted least squares. Where given disparity falls as that of the points grows, the scale is not over zero.
    pub(crate) fn of(pairs: &[(f64, f64)]) -> Self {
        let floor = 1e-3 * pairs.iter().map(|p| p.1).sum::<f64>() / pairs.len() as f64;
        let (mut scale, mut shift) = (1.0, 0.0);
        let mut weights = vec![1.0; pairs.len()];
        for _ in 0..20 {
            let (mut w0, mut x0, mut y0, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for ((x, y), w) in pairs.iter().zip(&weights) {
                w0 += w;
                x0 += w * x;
                y0 += w * y;
                xx += w * x * x;
                xy += w * x * y;
            }
            let determinant = w0 * xx - x0 * x0;
            if determinant <= 1e-12 * w0 * xx {
                // All points at one depth: only a scale can be told.
                (scale, shift) = (y0 / x0, 0.0);
            } else {
                scale = (w0 * xy - x0 * y0) / determinant;
                shift = (y0 - scale * x0) / w0;
            }
            for (w, (x, y)) in weights.iter_mut().zip(pairs) {
                *w = 1.0 / (scale * x + shift - y).abs().max(floor);
            }
        }
        Self { scale, shift }
    }

    /// Whether near stays near.
    pub(crate) fn is_upright(self) -> bool {
        self.scale > 0.0 && self.scale.is_finite() && self.shift.is_finite()
    }

    /// The depth that a given one stands for; 0 where its disparity is no longer positive.
    pub(crate) fn depth(self, z: f64) -> f64 {
        let disparity = self.scale / z + self.shift;
        if disparity > 1e-9 * self.scale {
            1.0 / disparity
        } else {
            0.0
        }
    }

    /// Applies it to a whole map; where the fitted disparity is no longer positive, depth becomes missing.
    pub(crate) fn apply(self, depth: &mut Map) {
        for z in depth.values.iter_mut().filter(|z| **z > 0.0) {
            *z = self.depth(f64::from(*z)) as f32;
        }
    }
}

/// How a frame's depth is aligned to the points; `None` where there are too few of them.
pub(crate) fn fit_to_points(frame: &Frame, points: &[SparsePoint]) -> Option<DisparityFit> {
    let depth = frame.depth.as_ref()?;
    let pairs = still_points(frame, points).filter_map(|(i, point)| {
        let z = f64::from(depth.values[i]);
        (z > 0.0).then_some((1.0 / z, 1.0 / point))
    });
    let pairs: Vec<(f64, f64)> = pairs.collect();
    (pairs.len() >= MIN_POINTS).then(|| DisparityFit::of(&pairs))
}
