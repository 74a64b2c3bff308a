//! Forward warping: a picture with depth, splatted into another camera.
//!
//! Every source pixel becomes a point, the point lands between four target pixels and is shared among
//! them bilinearly. Where several points land on one pixel, a soft z-buffer lets the nearest win: each
//! share is multiplied by `exp(-sharpness * r)`, where the *rank* r in [0, 1] grows with the point's
//! z-depth z in the target camera,
//!
//! > r = l(z) / max l, l(z) = ln(1 + min(z / median z, 10)),
//!
//! with median and maximum over the points of this one view. So the result does not depend on which
//! other views are warped (the method's reference code normalises over a batch), nor on the unit of
//! length. The cap at 10 medians keeps a far outlier, such as a sky, from blunting the near range;
//! points beyond it count as equally far.
//!
//! Only ratios of the factors matter, so that each pixel takes its factors relative to its own nearest
//! point: nothing underflows however sharp the buffer is. Sums are in f64 and in row order.
//!
//! Limits: a view enlarged by more than 2 has gaps between its points, and a gap shows what lies behind.

use crate::WarpError;
use crate::depth_edges::{depth_edges, has_depth};
use glam::{DAffine3, DVec2};
use splat_core::{Camera, CameraModel};

/// Bilinear shares below this are rounding, and are dropped: else a pixel that lands on a pixel centre
/// to within rounding would leak into its neighbours, where the z-buffer could let it win.
const MIN_SHARE: f64 = 1e-6;
/// Depths beyond this many medians count as equally far.
const MAX_MEDIANS: f64 = 10.0;
/// Larger targets are refused rather than allocated (pixels).
const MAX_PIXELS: usize = 1 << 27;

/// A picture with depth and the camera that took it.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// Intrinsics and size.
    pub camera: &'a Camera,
    /// Pose.
    pub cam_from_world: &'a DAffine3,
    /// Colour, [H, W, 3] row-major.
    pub color: &'a [f32],
    /// z-depth in scene units, [H, W] row-major; 0 and infinity mean missing.
    pub depth: &'a [f32],
    /// A second picture to carry along, such as the mask of what moves, [H, W] row-major.
    pub mask: Option<&'a [f32]>,
}

/// Settings of [`warp`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarpOptions {
    /// Exponent of the soft z-buffer over the view's whole depth range; 0 mixes near and far alike.
    pub sharpness: f64,
    /// Relative jump of depth from which pixels are on a depth edge ([`depth_edges`]) and are not
    /// splatted: depth and colour of such pixels are mixed from both sides. Infinity keeps all.
    pub edge_jump: f64,
}

impl Default for WarpOptions {
    /// A sharpness of 50, as in the method's reference code, and edges from jumps over 5 %.
    fn default() -> Self {
        Self {
            sharpness: 50.0,
            edge_jump: 0.05,
        }
    }
}

/// A picture warped into another camera. Pixels that nothing landed on are 0 and not valid.
#[derive(Clone, Debug, PartialEq)]
pub struct Warped {
    /// Colour, [H, W, 3] row-major.
    pub color: Vec<f32>,
    /// The source's mask, [H, W], where it had one. Fractional where shares mix.
    pub mask: Option<Vec<f32>>,
    /// z-depth in the target camera, scene units, [H, W].
    pub depth: Vec<f32>,
    /// Whether anything landed on the pixel, [H, W].
    pub valid: Vec<bool>,
}

impl Warped {
    /// Share of valid pixels, in [0, 1].
    #[must_use]
    pub fn valid_fraction(&self) -> f64 {
        let valid = self.valid.iter().filter(|&&v| v).count();
        valid as f64 / self.valid.len().max(1) as f64
    }
}

/// Warps `source` into the camera `target` at `target_cam_from_world`.
///
/// Not splatted are source pixels without depth, on a depth edge ([`WarpOptions::edge_jump`]), up to
/// the target's near plane or behind it, and outside its picture. Into its own pose a picture comes
/// back as it was. Serial and deterministic.
///
/// # Errors
/// [`WarpError`] says which buffer and pixel, camera, pose or option is at fault when an input is not a
/// number, is negative where it must not be, or has the wrong size. Nothing else fails: with no pixel
/// to splat, no pixel is valid.
pub fn warp(
    source: &Source<'_>,
    target: &Camera,
    target_cam_from_world: &DAffine3,
    options: &WarpOptions,
) -> Result<Warped, WarpError> {
    check(source, target, target_cam_from_world, options)?;
    let points = points(source, target, target_cam_from_world, options.edge_jump);
    let ranks = ranks(&points);
    let pixels = target.num_pixels();

    let mut nearest = vec![f64::INFINITY; pixels];
    for (point, &rank) in points.iter().zip(&ranks) {
        for (pixel, _) in shares(target, point.at) {
            nearest[pixel] = nearest[pixel].min(rank);
        }
    }

    // Per pixel: weight, depth, mask, red, green, blue.
    let mut sums = vec![[0.0_f64; 6]; pixels];
    for (point, &rank) in points.iter().zip(&ranks) {
        let mask = source.mask.map_or(0.0, |mask| mask[point.pixel]);
        let color = &source.color[3 * point.pixel..3 * point.pixel + 3];
        let values = [
            1.0,
            point.depth,
            mask.into(),
            color[0].into(),
            color[1].into(),
            color[2].into(),
        ];
        for (pixel, share) in shares(target, point.at) {
            let weight = share * (-options.sharpness * (rank - nearest[pixel])).exp();
            for (sum, value) in sums[pixel].iter_mut().zip(values) {
                *sum += weight * value;
            }
        }
    }

    let mean = |pixel: usize, channel: usize| {
        let sums: &[f64; 6] = &sums[pixel];
        if sums[0] > 0.0 {
            (sums[channel] / sums[0]) as f32
        } else {
            0.0
        }
    };
    Ok(Warped {
        color: (0..3 * pixels).map(|i| mean(i / 3, 3 + i % 3)).collect(),
        mask: source
            .mask
            .map(|_| (0..pixels).map(|p| mean(p, 2)).collect()),
        depth: (0..pixels).map(|p| mean(p, 1)).collect(),
        valid: sums.iter().map(|sums| sums[0] > 0.0).collect(),
    })
}

/// A source pixel seen from the target.
struct Point {
    /// Index of the source pixel.
    pixel: usize,
    /// Where it lands in the target, in pixels.
    at: DVec2,
    /// z-depth in the target, above its near plane.
    depth: f64,
}

/// The source pixels that are splatted, in row order.
fn points(
    source: &Source<'_>,
    target: &Camera,
    target_cam_from_world: &DAffine3,
    edge_jump: f64,
) -> Vec<Point> {
    let target_from_source = *target_cam_from_world * source.cam_from_world.inverse();
    let (width, height) = (source.camera.width, source.camera.height);
    let on_edge = depth_edges(source.depth, width, edge_jump);
    let mut points = Vec::with_capacity(source.depth.len());
    for y in 0..height {
        for x in 0..width {
            let pixel = y * width + x;
            if on_edge[pixel] || !has_depth(source.depth[pixel]) {
                continue;
            }
            let center = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let in_source = source
                .camera
                .unproject(center, f64::from(source.depth[pixel]));
            let in_target = target_from_source.transform_point3(in_source);
            if in_target.z > target.near && in_target.z <= f64::from(f32::MAX) {
                let at = target.project(in_target);
                if at.is_finite() {
                    points.push(Point {
                        pixel,
                        at,
                        depth: in_target.z,
                    });
                }
            }
        }
    }
    points
}

/// Each point's rank in the soft z-buffer, in [0, 1]: see the head of this file.
fn ranks(points: &[Point]) -> Vec<f64> {
    if points.is_empty() {
        return Vec::new();
    }
    let mut depths: Vec<f64> = points.iter().map(|point| point.depth).collect();
    let middle = depths.len() / 2;
    let (_, &mut median, _) = depths.select_nth_unstable_by(middle, f64::total_cmp);
    let logs: Vec<f64> = points
        .iter()
        .map(|point| (point.depth / median).min(MAX_MEDIANS).ln_1p())
        .collect();
    // At least ln 2: the median itself is among the depths.
    let largest = logs.iter().fold(0.0, |largest: f64, &log| largest.max(log));
    logs.into_iter().map(|log| log / largest).collect()
}

/// The pixels among which a point at `at` is shared, with their bilinear shares.
fn shares(target: &Camera, at: DVec2) -> impl Iterator<Item = (usize, f64)> {
    let (width, height) = (target.width, target.height);
    // From the first pixel's centre; columns floor(x) and floor(x) + 1 get the point.
    let at = at - 0.5;
    let first = at.floor();
    let fraction = at - first;
    let column = move |step: usize| {
        let x = first.x + step as f64;
        (x >= 0.0 && x < width as f64).then_some(x as usize)
    };
    let row = move |step: usize| {
        let y = first.y + step as f64;
        (y >= 0.0 && y < height as f64).then_some(y as usize)
    };
    [(0, 0), (1, 0), (0, 1), (1, 1)]
        .into_iter()
        .filter_map(move |(i, j)| {
            let share_x = if i == 0 { 1.0 - fraction.x } else { fraction.x };
            let share_y = if j == 0 { 1.0 - fraction.y } else { fraction.y };
            if share_x < MIN_SHARE || share_y < MIN_SHARE {
                return None;
            }
            Some((row(j)? * width + column(i)?, share_x * share_y))
        })
}

fn check(
    source: &Source<'_>,
    target: &Camera,
    target_cam_from_world: &DAffine3,
    options: &WarpOptions,
) -> Result<(), WarpError> {
    check_camera("source", source.camera)?;
    check_camera("target", target)?;
    for (which, pose) in [
        ("source", source.cam_from_world),
        ("target", target_cam_from_world),
    ] {
        if !pose.is_finite() || pose.matrix3.determinant() == 0.0 {
            return Err(WarpError::Pose { which });
        }
    }
    for (name, value, ok, must) in [
        (
            "sharpness",
            options.sharpness,
            options.sharpness >= 0.0 && options.sharpness.is_finite(),
            "finite and not negative",
        ),
        (
            "edge_jump",
            options.edge_jump,
            options.edge_jump >= 0.0,
            "a number, not negative",
        ),
    ] {
        if !ok {
            return Err(WarpError::Option { name, value, must });
        }
    }
    let finite: fn(f32) -> bool = f32::is_finite;
    check_buffer(source, "color", source.color, 3, finite, "finite")?;
    let depth_must = "0 or more, where 0 and infinity mean missing";
    check_buffer(source, "depth", source.depth, 1, |v| v >= 0.0, depth_must)?;
    if let Some(mask) = source.mask {
        check_buffer(source, "mask", mask, 1, finite, "finite")?;
    }
    Ok(())
}

fn check_camera(which: &'static str, camera: &Camera) -> Result<(), WarpError> {
    let Camera {
        model: CameraModel::Pinhole,
        width,
        height,
        fx,
        fy,
        cx,
        cy,
        near,
        ..
    } = *camera;
    let pixels = width.checked_mul(height);
    let fault = if pixels == Some(0) {
        "picture has no pixels"
    } else if pixels.is_none_or(|pixels| pixels > MAX_PIXELS) {
        "picture has more than 2^27 pixels"
    } else if ![fx, fy].iter().all(|f| f.is_finite() && *f > 0.0) {
        "focal length is not a positive number"
    } else if !(cx.is_finite() && cy.is_finite()) {
        "principal point is not a finite number"
    } else if !(near.is_finite() && near >= 0.0) {
        "near plane is negative or not a finite number"
    } else {
        return Ok(());
    };
    Err(WarpError::Camera { which, what: fault })
}

fn check_buffer(
    source: &Source<'_>,
    what: &'static str,
    values: &[f32],
    channels: usize,
    ok: impl Fn(f32) -> bool,
    must: &'static str,
) -> Result<(), WarpError> {
    let (width, height) = (source.camera.width, source.camera.height);
    let expected = width * height * channels;
    if values.len() != expected {
        return Err(WarpError::Length {
            what,
            expected,
            got: values.len(),
            width,
            height,
        });
    }
    match values.iter().position(|&value| !ok(value)) {
        None => Ok(()),
        Some(index) => {
            let pixel = index / channels;
            Err(WarpError::Value {
                what,
                x: pixel % width,
                y: pixel / width,
                value: values[index],
                must,
            })
        }
    }
}

#[cfg(test)]
mod tests;
