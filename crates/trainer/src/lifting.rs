//! Lifts 2D tracks to 3D by depth: a point is where its pixel's ray meets the depth of the mover in that frame.

use crate::random::{Purpose, generator, sample};
use crate::track_sample::{confidence, is_sure, position, visibility};
use crate::track_smoothing::smoothed;
use crate::views::is_inside;
use glam::{DVec2, DVec3};
use io::{Frame, Map, Scene, TrackSample};
use motion_bases::Tracks3d;

/// Lifts at most `max_tracks` tracks, the same number from each query frame, smoothed over so many frames to either side.
///
/// A track is *visible* in a frame where its visibility times confidence is over one half, it lies
/// inside the mask, and all depth around it is known. Tracks that are seen too rarely are dropped.
pub(crate) fn lift_tracks(
    scene: &Scene,
    max_tracks: usize,
    window: Option<usize>,
    seed: u64,
) -> Tracks3d {
    let n = scene.frames.len();
    let mut out = Tracks3d {
        num_frames: n,
        positions: Vec::new(),
        visible: Vec::new(),
        confidence: Vec::new(),
        colors: Vec::new(),
    };
    let Some(tracks) = &scene.tracks else {
        return out;
    };
    let share = max_tracks.div_ceil(tracks.queries.len().max(1));
    for query in &tracks.queries {
        if query.frame >= n {
            continue;
        }
        let count = query.samples.len() / n;
        let mut rng = generator(seed, Purpose::Tracks, query.frame as u64);
        let lifted: Vec<Lifted> = sample(&mut rng, count, share)
            .into_iter()
            .map(|row| {
                let samples = &query.samples[row * n..(row + 1) * n];
                match window {
                    Some(width) => lift_track(scene, &smoothed(samples, width), query.frame),
                    None => lift_track(scene, samples, query.frame),
                }
            })
            .collect();
        let mut seen: Vec<usize> = lifted
            .iter()
            .map(|t| t.visible.iter().filter(|&&v| v).count())
            .collect();
        let counts = seen.clone();
        seen.sort_unstable();
        let least = seen
            .get(seen.len() / 10)
            .map_or(0, |&tenth| tenth.min(n / 20))
            .max(1);
        for (track, seen) in lifted.into_iter().zip(counts) {
            if seen < least {
                continue;
            }
            out.positions.extend(track.positions);
            out.visible.extend(track.visible);
            out.confidence.extend(track.confidence);
            out.colors.push(track.color);
        }
    }
    out
}

/// What of all tracks' positions can be lifted; each number is a part of the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Liftable {
    /// Positions that the tracker is sure of.
    pub visible: usize,
    /// That lie in the picture.
    pub inside: usize,
    /// That lie on a mask.
    pub on_mask: usize,
    /// That have depth all around.
    pub with_depth: usize,
}

impl std::fmt::Display for Liftable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "of {} visible positions {} lie in the picture, {} of these on a mask, and {} of these have depth",
            self.visible, self.inside, self.on_mask, self.with_depth
        )
    }
}

/// Counts what of a scene's tracks [`lift_tracks`] can use.
pub(crate) fn liftable(scene: &Scene) -> Liftable {
    let mut found = Liftable::default();
    let queries = scene.tracks.iter().flat_map(|t| &t.queries);
    let rows = queries.flat_map(|q| q.samples.chunks_exact(scene.frames.len().max(1)));
    for (frame, s) in rows.flat_map(|row| scene.frames.iter().zip(row)) {
        let pixel = position(s);
        if !is_sure(s) {
            continue;
        }
        found.visible += 1;
        let (w, h) = (frame.view.image.width, frame.view.image.height);
        if !is_inside(w, h, pixel) {
            continue;
        }
        found.inside += 1;
        let around = |map: &Map, least: f32| {
            let mut all = corners(w, h, pixel).into_iter();
            all.all(|(i, weight)| weight <= LEAST_WEIGHT || map.values[i] > least)
        };
        if !frame.mask.as_ref().is_some_and(|m| around(m, 0.5)) {
            continue;
        }
        found.on_mask += 1;
        found.with_depth += usize::from(frame.depth.as_ref().is_some_and(|d| around(d, 0.0)));
    }
    found
}

/// Weights of a pixel's four neighbours sum to 1 only to rounding: a corner that hardly counts may lie outside.
const LEAST_WEIGHT: f64 = 1e-4;

struct Lifted {
    color: [f32; 3],
    positions: Vec<DVec3>,
    visible: Vec<bool>,
    confidence: Vec<f32>,
}

/// A track in all frames; its colour is what the frame that it starts from shows.
fn lift_track(scene: &Scene, samples: &[TrackSample], query: usize) -> Lifted {
    let n = scene.frames.len();
    let mut lifted = Lifted {
        color: sample_color(&scene.frames[query], position(&samples[query])),
        positions: Vec::with_capacity(n),
        visible: Vec::with_capacity(n),
        confidence: Vec::with_capacity(n),
    };
    for (frame, s) in scene.frames.iter().zip(samples) {
        let (visible, confident) = (visibility(s), confidence(s));
        let pixel = position(s);
        let z = depth_inside_mask(frame, pixel);
        let is_visible = is_sure(s) && z.is_some();
        let is_invisible = (1.0 - visible) * confident > 0.5 && z.is_some();
        let z = z.unwrap_or_else(|| {
            frame
                .depth
                .as_ref()
                .map_or(1.0, |d| nearest_depth(d, pixel))
        });
        let point = frame.view.camera.unproject(pixel, z);
        lifted
            .positions
            .push(frame.view.cam_from_world.inverse().transform_point3(point));
        lifted.visible.push(is_visible);
        lifted.confidence.push(if is_visible || is_invisible {
            confident
        } else {
            0.0
        });
    }
    lifted
}

/// The four pixels around a position, with their bilinear weights; indices are clamped to the picture.
fn corners(width: usize, height: usize, pixel: DVec2) -> [(usize, f64); 4] {
    let (x, y) = (pixel.x - 0.5, pixel.y - 0.5);
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = (x - x0, y - y0);
    let at = |dx: f64, dy: f64| {
        let column = (x0 + dx).clamp(0.0, width as f64 - 1.0) as usize;
        let row = (y0 + dy).clamp(0.0, height as f64 - 1.0) as usize;
        row * width + column
    };
    [
        (at(0.0, 0.0), (1.0 - fx) * (1.0 - fy)),
        (at(1.0, 0.0), fx * (1.0 - fy)),
        (at(0.0, 1.0), (1.0 - fx) * fy),
        (at(1.0, 1.0), fx * fy),
    ]
}

/// Bilinear depth where every pixel that counts lies in the mask and has depth.
fn depth_inside_mask(frame: &Frame, pixel: DVec2) -> Option<f64> {
    let (depth, mask) = (frame.depth.as_ref()?, frame.mask.as_ref()?);
    if !is_inside(depth.width, depth.height, pixel) {
        return None;
    }
    let mut z = 0.0;
    for (i, weight) in corners(depth.width, depth.height, pixel) {
        if weight > LEAST_WEIGHT && (mask.values[i] <= 0.5 || depth.values[i] <= 0.0) {
            return None;
        }
        z += weight * f64::from(depth.values[i]);
    }
    (z > 0.0).then_some(z)
}

/// Depth of the nearest pixel, for a position that is not trusted; any positive number will do where there is none.
fn nearest_depth(depth: &Map, pixel: DVec2) -> f64 {
    let pixel = if pixel.is_finite() {
        pixel
    } else {
        DVec2::ZERO
    };
    let z = f64::from(depth.values[corners(depth.width, depth.height, pixel)[0].0]);
    if z > 0.0 { z } else { 1.0 }
}

/// Bilinear colour at a place in a frame's picture.
pub(crate) fn sample_color(frame: &Frame, pixel: DVec2) -> [f32; 3] {
    let image = &frame.view.image;
    let mut color = [0.0; 3];
    for (i, weight) in corners(image.width, image.height, pixel) {
        for (c, sum) in color.iter_mut().enumerate() {
            *sum += weight as f32 * image.pixels[3 * i + c];
        }
    }
    color
}
