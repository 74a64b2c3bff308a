//! Whether what tracks follow moves: something that stands still is seen where the cameras' poses say, for one depth of it or
//! another, and nothing else is.
//!
//! A track is held against all points on the ray that it starts on, within what depth may be off by there, and is as far from
//! standing still as from the best of them. So it tells what leaves its epipolar lines, and what stays on them but is seen where
//! another depth would be.

use crate::statistics::{median, quantile};
use crate::track_sample::{is_sure, position};
use crate::views::{is_inside, pixel_index};
use glam::{DAffine3, DVec2, DVec3};
use io::{Frame, Map, QueryTracks, Scene};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use splat_core::Camera;

/// So many frames are asked for their tracks, evenly spread, …
const QUERIES: usize = 12;
/// … and so many tracks of each are looked at.
const TRACKS_PER_QUERY: usize = 160;
/// A track is looked at that is seen in so many frames, …
const SEEN: usize = 5;
/// … and in this share of them.
const SEEN_SHARE: f64 = 0.125;
/// Fewer tracks say too little.
const ENOUGH: usize = 50;
/// Given depth, aligned to the points, is off by less than this share.
const DEPTH_OFF: f64 = 0.25;
/// Depth is looked up in a window that reaches so far, px of a picture 256 wide.
const WINDOW: f64 = 2.0;
/// Inverse depths that are tried at a time, and how often they draw together around the best.
const TRIED: usize = 12;
const ROUNDS: usize = 3;
/// A track's distance is what this share of its positions stays within: trackers are wrong now and then.
const POSITIONS: f64 = 0.7;
/// What rests for most of a video and moves then is told by a part of it: the largest number of parts, …
const PARTS: usize = 3;
/// … the fewest positions of one, …
const PART_SEEN: usize = 8;
/// … and the share of its distance that counts, for poses drift.
const OF_PART: f64 = 0.5;
/// The median length of a vector whose two components are normal, of a standard deviation of 1.
const MEDIAN_LENGTH: f64 = 1.177;
/// A track leaves beyond so many times the noise, …
const NOISES: f64 = 3.0;
/// … but not within the first of these, px of a picture 256 wide, and always beyond the second: no tracker is off by so much.
const BAR: [f64; 2] = [1.0, 4.0];
/// Where fewer than this share of the tracks leave together, nothing moves. Measured in docs/SURVEY.md.
const FEW: f64 = 0.005;
/// Side of the cells in which masks and tracks are held against each other, px of a picture 256 wide.
const CELL: f64 = 8.0;
/// Tracks are to be near this share of the masks to speak for them.
const COVERED: f64 = 0.8;

/// What tracks say of whether that which they follow moves: those that start on masks, or all where there are no masks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrackMotion {
    /// Tracks that were looked at.
    pub tracks: usize,
    /// Share of them that leave the place where something that stands still would be seen.
    pub leaving: f64,
    /// Share of them that do so, and whose nearest neighbour does so too: trackers' mistakes come alone.
    pub leaving_together: f64,
    /// How far from such a place they are, at the median, px.
    pub distance_px: f64,
    /// How far that has to be for a track to leave, px.
    pub bar_px: f64,
    /// Share of the masks that is near a track; 1 without masks.
    pub covered: f64,
}

impl TrackMotion {
    /// Nothing of what is masked moves, as far as tracks tell.
    #[must_use]
    pub fn stands_still(&self) -> bool {
        self.leaving_together < FEW && self.covered >= COVERED
    }

    /// Something moves, or the poses are wrong.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.leaving_together >= FEW
    }
}

/// How a track goes with a point that stands still.
struct Fit {
    /// Where the track starts, px.
    start: DVec2,
    /// What [`POSITIONS`] of its positions stay within, or [`OF_PART`] of what those of a part of it do, whichever is more, px.
    distance: f64,
    /// How far each position is from the middle of its neighbours in time, as noise of a position, px.
    noises: Vec<f64>,
}

/// What a scene's tracks say; `None` where too few of them are seen often enough. No point is nearer to a camera than `nearest`.
pub(crate) fn track_motion(scene: &Scene, nearest: f64) -> Option<TrackMotion> {
    let tracks = scene.tracks.as_ref()?;
    let n = scene.frames.len();
    let pixels = scene.frames.first()?.view.camera.width as f64 / 256.0;
    let queries: Vec<&QueryTracks> = tracks
        .queries
        .iter()
        .filter(|q| q.frame < n && !q.samples.is_empty())
        .collect();
    let (mut fits, mut seen) = (Vec::new(), Vec::new());
    for query in spread(&queries, QUERIES) {
        let rows: Vec<Vec<Option<DVec2>>> = query
            .samples
            .chunks_exact(n)
            .map(|row| {
                let frames = scene.frames.iter().zip(row);
                let seen = frames.map(|(frame, sample)| {
                    let camera = &frame.view.camera;
                    let at = position(sample);
                    (is_sure(sample) && is_inside(camera.width, camera.height, at)).then_some(at)
                });
                seen.collect::<Vec<Option<DVec2>>>()
            })
            .filter(|row| is_told(scene, query.frame, row))
            .collect();
        let rows = spread(&rows, TRACKS_PER_QUERY);
        let fitted = rows.par_iter().filter_map(|row| {
            let depths = depths(&scene.frames[query.frame], row[query.frame]?, nearest);
            fit(scene, query.frame, row, depths)
        });
        fits.push(fitted.collect::<Vec<Fit>>());
        seen.extend(rows.into_iter().cloned());
    }
    let all = || fits.iter().flatten();
    let noises: Vec<f64> = all().flat_map(|f| f.noises.iter().copied()).collect();
    let count = all().count();
    if count < ENOUGH || noises.is_empty() {
        return None;
    }
    let noise = median(&noises) / MEDIAN_LENGTH;
    let bar = (NOISES * noise).clamp(BAR[0] * pixels, BAR[1] * pixels);
    let leaves = |fit: &Fit| fit.distance > bar;
    let together = fits.iter().map(|of_query| {
        let leaving = of_query.iter().enumerate().filter(|(_, f)| leaves(f));
        let with_neighbour = leaving.filter(|(k, f)| {
            let others = of_query.iter().enumerate().filter(|(j, _)| j != k);
            let distance = |other: &Fit| other.start.distance_squared(f.start);
            let nearest = others.min_by(|a, b| distance(a.1).total_cmp(&distance(b.1)));
            nearest.is_some_and(|(_, other)| leaves(other))
        });
        with_neighbour.count()
    });
    let share = |part: usize| part as f64 / count as f64;
    Some(TrackMotion {
        tracks: count,
        leaving: share(all().filter(|f| leaves(f)).count()),
        leaving_together: share(together.sum()),
        distance_px: median(&all().map(|f| f.distance).collect::<Vec<f64>>()),
        bar_px: bar,
        covered: covered(scene, &seen, CELL * pixels),
    })
}

/// At most so many of some things, evenly spread.
fn spread<T>(all: &[T], most: usize) -> Vec<&T> {
    let count = all.len().min(most);
    let chosen = (0..count).map(|k| &all[(2 * k + 1) * all.len() / (2 * count)]);
    chosen.collect()
}

/// Whether a track starts on a mask, if there are any, and is seen often enough.
fn is_told(scene: &Scene, query: usize, row: &[Option<DVec2>]) -> bool {
    let masks = scene.frames.iter().any(|f| f.mask.is_some());
    let on_mask = |at: DVec2| {
        let frame = &scene.frames[query];
        let pixel = pixel_index(&frame.view.camera, at);
        frame.mask.as_ref().is_some_and(|m| m.values[pixel] > 0.5)
    };
    let least = SEEN.max((SEEN_SHARE * row.len() as f64) as usize);
    row[query].is_some_and(|at| !masks || on_mask(at)) && row.iter().flatten().count() >= least
}

/// Least and largest inverse depth that what is seen at a place may have, 1 / scene unit.
fn depths(frame: &Frame, at: DVec2, nearest: f64) -> [f64; 2] {
    let around = |map: &Map| {
        let reach = (WINDOW * map.width as f64 / 256.0).ceil() as usize;
        let window = |middle: f64, size: usize| {
            let middle = middle as usize;
            middle.saturating_sub(reach)..(middle + reach + 1).min(size)
        };
        let rows = window(at.y, map.height);
        let values = rows.flat_map(|y| {
            window(at.x, map.width).map(move |x| f64::from(map.values[y * map.width + x]))
        });
        let known = values.filter(|z| *z > 0.0 && z.is_finite());
        known.fold([f64::INFINITY, 0.0], |[near, far], z| {
            [f64::min(near, z), f64::max(far, z)]
        })
    };
    match frame.depth.as_ref().map(around) {
        Some([near, far]) if far > 0.0 => {
            [1.0 / (far * (1.0 + DEPTH_OFF)), (1.0 + DEPTH_OFF) / near]
        }
        _ => [0.0, 1.0 / nearest],
    }
}

/// Holds a track against the points of its ray. `None` where none of them is before all cameras that see the track.
fn fit(scene: &Scene, query: usize, row: &[Option<DVec2>], depths: [f64; 2]) -> Option<Fit> {
    let from = &scene.frames[query].view;
    let start = row[query]?;
    let ray = from.camera.unproject(start, 1.0);
    let world_from_query = from.cam_from_world.inverse();
    let seen: Vec<Seen<'_>> = row
        .iter()
        .zip(&scene.frames)
        .enumerate()
        .filter_map(|(frame, (at, f))| {
            let camera_from_query = f.view.cam_from_world * world_from_query;
            Some(Seen {
                frame,
                at: (*at)?,
                camera: &f.view.camera,
                ray: camera_from_query.matrix3 * ray,
                camera_from_query,
            })
        })
        .collect();
    let [mut least, mut most] = depths;
    let mut best: Option<(f64, f64)> = None;
    for _ in 0..ROUNDS {
        let step = (most - least) / (TRIED - 1) as f64;
        for k in 0..TRIED {
            let inverse_depth = least + step * k as f64;
            let Some(away) = away(&seen, inverse_depth) else {
                continue;
            };
            let distance = distance(&away);
            if best.is_none_or(|(least, _)| distance < least) {
                best = Some((distance, inverse_depth));
            }
        }
        let (_, middle) = best?;
        [least, most] = [depths[0].max(middle - step), depths[1].min(middle + step)];
    }
    let (distance, inverse_depth) = best?;
    let away = away(&seen, inverse_depth)?;
    let noises = seen.windows(3).zip(away.windows(3)).filter_map(|(s, a)| {
        let are_neighbours = s[0].frame + 2 == s[2].frame;
        // The second difference of values that are off by 1 is off by √6.
        are_neighbours.then(|| (a[0] - 2.0 * a[1] + a[2]).length() / 6.0_f64.sqrt())
    });
    Some(Fit {
        start,
        distance,
        noises: noises.collect(),
    })
}

/// A position of a track, and what it takes to say where a point of the track's first ray would be seen there.
struct Seen<'a> {
    frame: usize,
    at: DVec2,
    camera: &'a Camera,
    camera_from_query: DAffine3,
    /// The ray's direction in this camera's space.
    ray: DVec3,
}

/// How far each position of a track is from where the point of its ray at an inverse depth is seen, but for what all positions have
/// in common, which is what the first one is off by; px. `None` where the point is behind a camera.
fn away(seen: &[Seen<'_>], inverse_depth: f64) -> Option<Vec<DVec2>> {
    let away = seen.iter().map(|s| {
        // The point, divided by its depth: it may be infinitely far.
        let point = s.ray + inverse_depth * s.camera_from_query.translation;
        (point.z > 0.0).then(|| s.at - s.camera.project(point))
    });
    let mut away = away.collect::<Option<Vec<DVec2>>>()?;
    let median_of = |axis: fn(&DVec2) -> f64| median(&away.iter().map(axis).collect::<Vec<f64>>());
    let middle = DVec2::new(median_of(|a| a.x), median_of(|a| a.y));
    away.iter_mut().for_each(|a| *a -= middle);
    Some(away)
}

/// How far positions of a track are from where they would be, of which there is at least one.
fn distance(away: &[DVec2]) -> f64 {
    let typical = |part: &[DVec2]| {
        let mut lengths: Vec<f64> = part.iter().map(|v| v.length()).collect();
        quantile(&mut lengths, POSITIONS)
    };
    let parts = (away.len() / PART_SEEN).clamp(1, PARTS);
    let parts = away.chunks(away.len().div_ceil(parts));
    let of_parts = parts.map(|part| OF_PART * typical(part));
    of_parts.fold(typical(away), f64::max)
}

/// The share of the masks' cells that have one of the tracks in them or beside them; 1 where nothing is masked.
fn covered(scene: &Scene, tracks: &[Vec<Option<DVec2>>], cell: f64) -> f64 {
    let (mut masked, mut near) = (0_usize, 0_usize);
    for (k, frame) in scene.frames.iter().enumerate() {
        let Some(mask) = &frame.mask else { continue };
        let cell = cell.max(1.0);
        let columns = (mask.width as f64 / cell).ceil() as usize;
        let rows = (mask.height as f64 / cell).ceil() as usize;
        let cell_of = |at: DVec2| ((at.y / cell) as usize, (at.x / cell) as usize);
        let (mut shown, mut tracked) = (vec![false; rows * columns], vec![false; rows * columns]);
        for (i, _) in mask.values.iter().enumerate().filter(|(_, v)| **v > 0.5) {
            let (x, y) = ((i % mask.width) as f64, (i / mask.width) as f64);
            let (row, column) = cell_of(DVec2::new(x, y));
            shown[row * columns + column] = true;
        }
        for at in tracks.iter().filter_map(|track| track[k]) {
            let (row, column) = cell_of(at);
            for y in row.saturating_sub(1)..(row + 2).min(rows) {
                for x in column.saturating_sub(1)..(column + 2).min(columns) {
                    tracked[y * columns + x] = true;
                }
            }
        }
        masked += shown.iter().filter(|s| **s).count();
        let both = shown.iter().zip(&tracked).filter(|(s, t)| **s && **t);
        near += both.count();
    }
    if masked == 0 {
        1.0
    } else {
        near as f64 / masked as f64
    }
}

#[cfg(test)]
mod tests;
