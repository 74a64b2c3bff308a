//! Masks: how much they say moves, and whether that does.

use super::finding::{Finding, Verdict};
use super::fit::{Fit, moving_share};
use io::Scene;

/// Movers that fill more of the pictures than this leave too little that is still.
const MUCH: f64 = 0.4;
/// … and more than this are rather what is still.
const MOST: f64 = 0.5;

pub(super) fn check(scene: &Scene, fits: &[Fit]) -> Option<Finding> {
    let share = moving_share(scene)?;
    let mut text = format!("masks say that {:.1} % of the pictures move", 100.0 * share);
    // Where masks cover most, the fit has them the other way round.
    let moving = fits.first().and_then(|f| f.warp.as_ref()?.moving);
    if let Some(moving) = moving {
        let what = if share > MOST {
            "outside of them"
        } else {
            "on them"
        };
        text += &format!(
            "; {what}, frames moved by depth and pose differ {moving:.1} times as much as elsewhere"
        );
    }
    let verdict = if share > MOST {
        text += "; turned round (white where nothing moves) they would say the rest";
        Verdict::Wrong
    } else if share > MUCH {
        Verdict::Doubtful
    } else {
        Verdict::Pass
    };
    Some(Finding {
        what: "masks",
        verdict,
        text,
    })
}
