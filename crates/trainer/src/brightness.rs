//! How much the frames of a video differ in brightness: auto-exposure shows before anything is trained.

use crate::correspondence::{Shared, shared};
use crate::statistics::median;
use io::Frame;

/// The same things are seen equally bright in the frames of a video of fixed exposure, but for less than this (median of the
/// logarithm's change, between frames that are one apart and a quarter of the video).
const FIXED: f64 = 0.03;
/// Pixels of a row and of a column of which one is looked up.
const STEP: usize = 2;
/// Fewer pixels that two frames share say too little.
const LEAST_SHARED: usize = 50;
/// Values over this may have been cut off.
const SATURATED: f32 = 0.98;

/// Median change, as a logarithm, of the light that frames have in common: of neighbours and of those a quarter of the video
/// apart, whichever is larger. `None` where too little is known in depth.
pub(crate) fn brightness_change(frames: &[Frame]) -> Option<f64> {
    let change = |apart: usize| {
        let pairs = frames.iter().zip(frames.iter().skip(apart));
        let changes: Vec<f64> = pairs.filter_map(|(a, b)| pair_change(a, b)).collect();
        (changes.len() >= 3).then(|| median(&changes))
    };
    let apart = [1, (frames.len() / 4).max(1)];
    apart.into_iter().filter_map(change).max_by(f64::total_cmp)
}

/// Whether frames that change so much in brightness have gains of their own.
pub(crate) fn gains_differ(change: f64) -> bool {
    change > FIXED
}

/// Size of the change from a frame to another.
fn pair_change(a: &Frame, b: &Frame) -> Option<f64> {
    let (mut count, mut sums) = (0, [0.0; 2]);
    for Shared { pixels, .. } in shared(a, b, STEP)? {
        let [before, after] =
            [(a, pixels[0]), (b, pixels[1])].map(|(f, k)| &f.view.image.pixels[3 * k..3 * k + 3]);
        if before.iter().chain(after).any(|v| *v > SATURATED) {
            continue;
        }
        count += 1;
        for (sum, color) in sums.iter_mut().zip([before, after]) {
            *sum += color.iter().copied().map(f64::from).sum::<f64>();
        }
    }
    let [before, after] = sums;
    (count >= LEAST_SHARED && before > 0.0 && after > 0.0).then(|| (after / before).ln().abs())
}
