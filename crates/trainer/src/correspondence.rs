//! Which places of two frames show the same, by depth and pose.

use crate::statistics::quantile;
use crate::views::{pixel_center, pixel_index, seen_at};
use glam::{DAffine3, DVec2};
use io::Frame;
use rayon::prelude::*;
use splat_core::Camera;

/// What lies elsewhere in depth by more than this share is hidden.
const HIDDEN: f64 = 0.05;
/// What changes once, or for some frames of a video, does so between a few of its pairs: it shows in the change that so many of them
/// do not exceed.
const MOST: f64 = 0.9;
/// Fewer pairs of frames say nothing.
const LEAST_PAIRS: usize = 3;

/// A pixel of one frame, seen in another.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// Index of the pixel.
    pub(crate) pixel: usize,
    /// Its centre, px.
    pub(crate) center: DVec2,
    /// Where that is in the other picture, px.
    pub(crate) at: DVec2,
    /// Its z-depth there.
    pub(crate) depth: f64,
}

/// The pixels at every `step`th of a row and a column.
pub(crate) fn every(camera: &Camera, step: usize) -> impl Iterator<Item = usize> + use<> {
    let (width, rows) = (camera.width, (0..camera.height).step_by(step));
    rows.flat_map(move |y| (0..width).step_by(step).map(move |x| y * width + x))
}

/// The pixels of a frame that another camera has in its picture, of [`every`] `step`th. `depth` says how far a pixel
/// is, and that it is not known by 0.
pub(crate) fn seen_in<'a>(
    camera: &'a Camera,
    depth: impl Fn(usize) -> f64 + 'a,
    other: &'a Camera,
    other_from_camera: DAffine3,
    step: usize,
) -> impl Iterator<Item = Seen> + 'a {
    every(camera, step).filter_map(move |pixel| {
        let z = depth(pixel);
        if z <= 0.0 {
            return None;
        }
        let center = pixel_center(camera, pixel);
        let seen = other_from_camera.transform_point3(camera.unproject(center, z));
        let at = seen_at(other, seen)?;
        Some(Seen {
            pixel,
            center,
            at,
            depth: seen.z,
        })
    })
}

/// What stands still and is seen in two frames.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shared {
    /// Index of the pixel that sees it, in either frame.
    pub(crate) pixels: [usize; 2],
    /// Its z-depth in either frame.
    pub(crate) depths: [f64; 2],
}

/// What of every `step`th row and column of a frame another one sees too: nothing that is masked, hidden in the other, or without
/// depth in one of them. `None` where a frame has no depth at all.
pub(crate) fn shared<'a>(
    a: &'a Frame,
    b: &'a Frame,
    step: usize,
) -> Option<impl Iterator<Item = Shared> + 'a> {
    let (depth, other) = (a.depth.as_ref()?, b.depth.as_ref()?);
    let b_from_a = b.view.cam_from_world * a.view.cam_from_world.inverse();
    let known = move |i: usize| {
        if is_still(a, i) {
            f64::from(depth.values[i])
        } else {
            0.0
        }
    };
    let seen = seen_in(&a.view.camera, known, &b.view.camera, b_from_a, step);
    Some(seen.filter_map(move |seen| {
        let there = pixel_index(&b.view.camera, seen.at);
        // Not so either where one of the depths is no number, or without end.
        let is_there = (f64::from(other.values[there]) / seen.depth - 1.0).abs() <= HIDDEN;
        (is_there && is_still(b, there)).then(|| Shared {
            pixels: [seen.pixel, there],
            depths: [f64::from(depth.values[seen.pixel]), seen.depth],
        })
    }))
}

/// What pairs of frames change by, at most.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PairChanges {
    /// Half of them.
    pub(crate) half: f64,
    /// Nine in ten of them.
    pub(crate) most: f64,
}

/// What pairs of frames change by: neighbours, or frames a quarter of the video apart, whichever change more. `None` where `change`
/// tells it of three pairs of neither.
pub(crate) fn pair_changes(
    frames: &[Frame],
    change: impl Fn(&Frame, &Frame) -> Option<f64> + Sync,
) -> Option<PairChanges> {
    let of_apart = [1, (frames.len() / 4).max(1)].map(|apart| {
        let pairs = frames.par_iter().zip(frames.par_iter().skip(apart));
        let mut changes: Vec<f64> = pairs.filter_map(|(a, b)| change(a, b)).collect();
        (changes.len() >= LEAST_PAIRS).then(|| PairChanges {
            half: quantile(&mut changes, 0.5),
            most: quantile(&mut changes, MOST),
        })
    });
    let of_apart = of_apart.into_iter().flatten();
    of_apart.reduce(|a, b| PairChanges {
        half: a.half.max(b.half),
        most: a.most.max(b.most),
    })
}

/// Whether a pixel shows nothing that is masked.
pub(crate) fn is_still(frame: &Frame, pixel: usize) -> bool {
    let mask = frame.mask.as_ref();
    mask.is_none_or(|mask| mask.values[pixel] < 0.5)
}
