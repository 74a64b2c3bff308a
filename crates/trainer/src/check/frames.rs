//! Single frames that are not where their poses have them, or whose depth is not theirs. Over all pairs of frames a few do not
//! show.

use super::finding::{Finding, Verdict};
use super::fit::{Fit, LEAST_SHIFT, moved, num_known};
use crate::alignment::MIN_POINTS;
use crate::statistics::median;
use io::{Scene, list_names};

/// Frames are held against so many before and as many behind them.
const NEIGHBOURS: usize = 2;
/// Frames that are moved by depth and pose resemble others at best no more than unmoved ones do. (Of eight scenes no frame is over
/// 0.79, however blurred it is.)
const ASTRAY: f64 = 1.0;
/// Where more than this share of the frames is, it is not the frames.
const FEW: f64 = 0.5;

/// How a frame differs from those around it where it fits best, as a share of what it differs unmoved; `None` where that cannot be
/// told.
#[derive(Clone, Copy, Debug, Default)]
struct Misfit {
    /// Moved to others, by its own depth.
    from: Option<f64>,
    /// Others moved to it, by theirs.
    to: Option<f64>,
}

fn misfits(scene: &Scene, fit: &Fit) -> Vec<Misfit> {
    let count = scene.frames.len();
    let mut all = vec![Misfit::default(); count];
    // Depth that is missing all over puts a frame nowhere, which says nothing of poses.
    let has_depth = |a: &usize| num_known(scene, fit, *a) >= MIN_POINTS;
    for a in (0..count).filter(has_depth) {
        let around = a.saturating_sub(NEIGHBOURS)..(a + NEIGHBOURS + 1).min(count);
        for b in around.filter(|b| *b != a) {
            let mut shifts = Vec::new();
            let ratio = match moved(scene, fit, a, b, &mut shifts) {
                // Where a camera rests, moved and unmoved frames are the same, and nothing is wrong.
                Some(_) if shifts.is_empty() || median(&shifts) < LEAST_SHIFT => Some(0.0),
                Some(moved) => moved.ratio(),
                // What the other has nothing of in its picture fits worse than anything.
                None => Some(f64::INFINITY),
            };
            let Some(ratio) = ratio else { continue };
            let at_best = |least: Option<f64>| Some(least.map_or(ratio, |least| least.min(ratio)));
            all[a].from = at_best(all[a].from);
            all[b].to = at_best(all[b].to);
        }
    }
    all
}

pub(super) fn check(scene: &Scene, fits: &[Fit]) -> Option<Finding> {
    let given = fits.first()?;
    let fit = given.warp.as_ref()?;
    if fit.shift_px < LEAST_SHIFT || fit.ratio >= ASTRAY {
        return None;
    }
    let misfits = misfits(scene, given);
    let is_astray = |ratio: Option<f64>| ratio.is_some_and(|ratio| ratio >= ASTRAY);
    let named = |is_meant: &dyn Fn(&Misfit) -> bool| -> Vec<&str> {
        let frames = scene.frames.iter().zip(&misfits);
        let meant = frames.filter(|(_, misfit)| is_meant(misfit));
        meant.map(|(frame, _)| frame.view.name.as_str()).collect()
    };
    let poses = named(&|m| is_astray(m.to) && (m.from.is_none() || is_astray(m.from)));
    let depths = named(&|m| is_astray(m.from) && !is_astray(m.to));
    if (poses.len() + depths.len()) as f64 > FEW * misfits.len() as f64 {
        return None;
    }
    let told = [
        (
            poses,
            "at its pose no frame around fits it: look at the pose, or leave the frame out",
        ),
        (
            depths,
            "by its depth it fits no frame around, which fit it by theirs: look at the depth, or leave it out",
        ),
    ];
    let told = told.into_iter().filter(|(names, _)| !names.is_empty());
    let told: Vec<String> = told
        .map(|(names, what)| format!("{}: {what}", list_names(&names)))
        .collect();
    let (verdict, text) = if told.is_empty() {
        (
            Verdict::Pass,
            "each is where its pose and depth have it, among those around it".to_owned(),
        )
    } else {
        (Verdict::Doubtful, told.join("; "))
    };
    Some(Finding {
        what: "single frames",
        verdict,
        text,
    })
}
