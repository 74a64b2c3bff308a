//! Masks: how much they say moves, and whether that does.

use super::finding::{Finding, Verdict};
use super::fit::Fit;
use super::reading::Masks;
use io::Scene;

/// Movers that fill more of the pictures than this leave too little that is still.
const MUCH: f64 = 0.4;

/// Mean share of the pictures that masks say moves; `None` without masks.
pub(super) fn moving_share(scene: &Scene) -> Option<f64> {
    let masks = scene.frames.iter().filter_map(|f| f.mask.as_ref());
    let shares = masks.map(|m| {
        let moving = m.values.iter().filter(|v| **v > 0.5).count();
        moving as f64 / m.values.len().max(1) as f64
    });
    let shares: Vec<f64> = shares.collect();
    (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64)
}

/// Of masks that say so much moves.
pub(super) fn check(share: f64, fits: &[Fit]) -> Option<Finding> {
    let given = fits.first()?;
    let mut text = format!("masks say that {:.1} % of the pictures move", 100.0 * share);
    let turned = given.reading.masks == Masks::Still;
    if let Some(moving) = given.warp.as_ref().and_then(|w| w.moving) {
        let what = if turned { "outside of them" } else { "on them" };
        text += &format!(
            "; {what}, frames moved by depth and pose differ {moving:.1} times as much as elsewhere"
        );
    }
    let verdict = if turned {
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
