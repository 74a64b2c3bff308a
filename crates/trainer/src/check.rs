//! Whether a scene's inputs can be right, told before anything is trained on them.
//!
//! Files in another convention than the layout's train to the end and give a bad picture. Depth, poses, points, masks and tracks
//! say some of the same things, so each is measured against the others, and where another reading of a file makes them agree, the
//! finding says which.

mod depth;
mod finding;
mod fit;
mod frames;
mod masks;
mod poses;
mod reading;
mod tracks;

pub use finding::{Finding, Verdict};

use crate::settings::When;
use io::Scene;

/// Looks at a scene as it was read, before [`crate::survey()`] aligns its depth. What is not there is not looked at, and neither
/// are masks and tracks where movers are never to be modelled (`asked` is `motion.when`).
#[must_use]
pub fn check(scene: &Scene, asked: When) -> Vec<Finding> {
    let looks_at_movers = asked != When::Never;
    let moving_share = masks::moving_share(scene).filter(|_| looks_at_movers);
    let fits = fit::fits(scene, moving_share);
    let mut findings = Vec::new();
    findings.extend(depth::check(&fits));
    findings.extend(poses::check(&fits));
    findings.extend(frames::check(scene, &fits));
    findings.extend(moving_share.and_then(|share| masks::check(share, &fits)));
    if looks_at_movers {
        findings.extend(tracks::check(scene, &fits));
    }
    findings
}
