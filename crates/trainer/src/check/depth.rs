//! Depth against the sparse points.

use super::finding::{Finding, Verdict};
use super::fit::{Fit, PointFit, better};

/// Depth that misses the points by less than this share is as good as estimators make it.
const GOOD: f64 = 0.1;
/// Depth that misses them by more is none.
const BAD: f64 = 0.3;
/// Depth says less than this of how far the points are apart: 0 is all of it.
const UNRELATED: f64 = 0.6;

/// Of readings, as given first.
pub(super) fn check(fits: &[Fit]) -> Option<Finding> {
    let given = fits.first()?.points.as_ref()?;
    let PointFit {
        frames,
        upside_down,
        error,
        spread,
        scales: [least, most],
    } = given;
    let apart = format!("which differ by {:.1} % among themselves", 100.0 * spread);
    let (verdict, mut text) = if 2 * upside_down > *frames {
        let text = format!(
            "where the sparse points are near depth is far, and the other way round, in {upside_down} of {frames} frames"
        );
        (Verdict::Wrong, text)
    } else {
        let verdict = match given.disagreement() {
            _ if *error > BAD => Verdict::Wrong,
            unrelated if *error > GOOD || (unrelated > UNRELATED && *spread > GOOD) => {
                Verdict::Doubtful
            }
            _ => Verdict::Pass,
        };
        let text = format!(
            "depth of {frames} frames, its disparity times {least:.3} to {most:.3}, misses the sparse points, {apart}, by {:.1} %",
            100.0 * error
        );
        (verdict, text)
    };
    if verdict > Verdict::Pass
        && let Some(best) = better(fits)
        && best.reading.inverse_depth
        && let Some(points) = &best.points
    {
        text += &format!(
            "; as inverse depth the files agree with the points within {:.1} %",
            100.0 * points.error
        );
    }
    Some(Finding {
        what: "depth and sparse points",
        verdict,
        text,
    })
}
