//! Poses against pictures: frames warped to others, and points in the frames.

use super::finding::{Finding, Verdict};
use super::fit::{Fit, LEAST_SHIFT, better};

/// Warped frames that differ by less than this share of unwarped ones are where they should be.
const GOOD: f64 = 0.8;
/// Ones that differ by more than unmoved ones are not.
const BAD: f64 = 1.1;
/// A scene is seen where fewer of its points than this are in no picture.
const SEEN: f64 = 0.5;

/// Of readings, as given first.
pub(super) fn check(fits: &[Fit]) -> Vec<Finding> {
    [warp(fits), points(fits)].into_iter().flatten().collect()
}

/// What another reading would be called.
fn proposal(fits: &[Fit]) -> Option<(String, &Fit)> {
    let best = better(fits)?;
    let Fit { reading, scale, .. } = best;
    let poses = reading.poses().map(|poses| format!("poses as {poses}"));
    let depth = match (reading.inverse_depth, reading.free_scale) {
        (true, _) => Some("depth as inverse depth".to_owned()),
        // Where poses are what is wrong, the nearest scale that was tried says nothing of depth.
        (false, true) if poses.is_none() || best.is_rescaled() => {
            Some(format!("depth times {scale:.2e}"))
        }
        (false, _) => None,
    };
    let parts: Vec<String> = poses.into_iter().chain(depth).collect();
    Some((parts.join(" and "), best))
}

fn warp(fits: &[Fit]) -> Option<Finding> {
    let given = fits.first()?.warp.as_ref()?;
    let mut text = match given.pairs {
        0 => "by depth and pose hardly a frame has anything of another in its picture".to_owned(),
        pairs => format!(
            "a frame moved to another by depth and pose differs from it by {:.0} % of what it differs unmoved ({pairs} pairs, \
             {:.1} px at the median)",
            100.0 * given.ratio,
            given.shift_px
        ),
    };
    let proposed = proposal(fits);
    let verdict = match &proposed {
        _ if given.shift_px < LEAST_SHIFT => Verdict::Untold,
        Some((name, best)) if best.warp.as_ref().is_some_and(|w| w.ratio < given.ratio) => {
            let found = best.warp.as_ref().map_or(1.0, |w| w.ratio);
            text += &format!("; with {name} it is {:.0} %", 100.0 * found);
            Verdict::Wrong
        }
        _ if given.ratio < GOOD => Verdict::Pass,
        _ if given.ratio < BAD => Verdict::Doubtful,
        _ => Verdict::Wrong,
    };
    Some(Finding {
        what: "poses, depth and pictures",
        verdict,
        text,
    })
}

fn points(fits: &[Fit]) -> Option<Finding> {
    let given = fits.first()?.colors.as_ref()?;
    let ratio_of = |fit: &Fit| fit.colors.as_ref().and_then(|colors| colors.ratio);
    let mut text = format!(
        "{:.0} % of the sparse points are in some picture",
        100.0 * given.seen
    );
    text += &match given.ratio {
        Some(ratio) => format!(
            ", and their colours differ from it by {:.0} % of what chance would do",
            100.0 * ratio
        ),
        None => ", and their colours, which are all alike, tell nothing".to_owned(),
    };
    let proposed = proposal(fits);
    let better = proposed.as_ref().and_then(|(name, best)| {
        let found = ratio_of(best)?;
        (found < given.ratio?).then_some((name, found))
    });
    let verdict = if let Some((name, found)) = better {
        text += &format!("; with {name} it is {:.0} %", 100.0 * found);
        Verdict::Wrong
    } else if given.seen < SEEN || given.ratio.is_some_and(|ratio| ratio > GOOD) {
        Verdict::Doubtful
    } else {
        Verdict::Pass
    };
    Some(Finding {
        what: "poses and sparse points",
        verdict,
        text,
    })
}
