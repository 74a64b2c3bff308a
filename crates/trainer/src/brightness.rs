//! How much the frames of a video differ in brightness: auto-exposure shows before anything is trained.

use crate::correspondence::{PairChanges, Shared, pair_changes, shared};
use io::Frame;

/// The same things are seen equally bright in the frames of a video of fixed exposure, but for less than this between half of the
/// pairs of frames (the logarithm's change) …
const FIXED: f64 = 0.03;
/// … and for less than this between nine in ten. More, since what shines, and what blur carries over edges, is elsewhere in some
/// frames. Measured in docs/SURVEY.md.
const FIXED_IN_MOST: f64 = 0.08;
/// Pixels of a row and of a column of which one is looked up.
const STEP: usize = 2;
/// Fewer pixels that two frames share say too little.
const LEAST_SHARED: usize = 50;
/// Values over this may have been cut off.
const SATURATED: f32 = 0.98;

/// By how much the light changes that frames have in common, as a logarithm. `None` where too little is known in depth.
pub(crate) fn brightness_changes(frames: &[Frame]) -> Option<PairChanges> {
    pair_changes(frames, pair_change)
}

/// Whether frames that change so much in brightness have gains of their own.
pub(crate) fn gains_differ(changes: PairChanges) -> bool {
    changes.half > FIXED || changes.most > FIXED_IN_MOST
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
