//! Tracks: whether they lie in the pictures and on the masks, and follow the poses where nothing moves.

use super::finding::{Finding, Verdict};
use super::fit::Fit;
use crate::lifting::{Liftable, liftable};
use crate::placement::{dilate, pixels_at_256};
use crate::statistics::median;
use crate::track_sample::{is_sure, position};
use crate::views::{is_inside, pixel_index, seen_at};
use glam::DVec2;
use io::Scene;

/// Where fewer visible positions are in the pictures, they belong to others.
const MOST: f64 = 0.5;
/// So many are in the pictures where trackers go astray now and then.
const NEARLY_ALL: f64 = 0.9;
/// Where fewer lie on the masks (whole pixels, which are large in small pictures), movers are lost.
const ON_MASKS: f64 = 0.3;
/// As far as this around a mask things may move, px of a picture 256 wide.
const MARGIN: f64 = 8.0;
/// Fewer positions say too little.
const ENOUGH: usize = 50;
/// Positions that go less far say nothing of poses, px.
const LEAST_SHIFT: f64 = 1.0;

pub(super) fn check(scene: &Scene, fits: &[Fit]) -> Vec<Finding> {
    if scene.tracks.is_none() {
        return Vec::new();
    }
    let found = liftable(scene);
    let mut findings = vec![inside(scene, found)];
    if scene.frames.iter().any(|f| f.mask.is_some()) {
        findings.push(on_masks(found));
    }
    findings.extend(fits.first().and_then(|fit| still(scene, fit)));
    findings
}

fn share(part: usize, of: usize) -> f64 {
    part as f64 / of.max(1) as f64
}

fn inside(scene: &Scene, found: Liftable) -> Finding {
    let in_picture = share(found.inside, found.visible);
    let mut text = format!(
        "{:.1} % of {} visible positions lie in the pictures",
        100.0 * in_picture,
        found.visible
    );
    let queries = scene.tracks.iter().flat_map(|t| &t.queries);
    let visible = queries.flat_map(|q| &q.samples).filter(|s| is_sure(s));
    // A pixel is at i + 0.5 here.
    let in_corner = visible
        .clone()
        .filter(|s| position(s).max_element() <= 1.5)
        .count();
    let normalised = found.visible >= ENOUGH && share(in_corner, found.visible) > NEARLY_ALL;
    let farthest = visible.map(position).fold(DVec2::ZERO, DVec2::max);
    let verdict = if found.visible == 0 {
        Verdict::Wrong
    } else if normalised {
        text += "; nearly all lie within a pixel of the corner: pixels are expected, and these look like shares of the picture";
        Verdict::Wrong
    } else if in_picture < NEARLY_ALL {
        let size = scene
            .frames
            .first()
            .map_or([0; 2], |f| [f.view.image.width, f.view.image.height]);
        text += &format!(
            "; they reach {:.0}, {:.0} in pictures of {}x{}: were they made at another size, or with x and y exchanged?",
            farthest.x, farthest.y, size[0], size[1]
        );
        if in_picture < MOST {
            Verdict::Wrong
        } else {
            Verdict::Doubtful
        }
    } else {
        Verdict::Pass
    };
    Finding {
        what: "tracks in the pictures",
        verdict,
        text,
    }
}

fn on_masks(found: Liftable) -> Finding {
    let on_mask = share(found.on_mask, found.inside);
    let verdict = match found {
        Liftable { with_depth: 0, .. } => Verdict::Wrong,
        _ if on_mask < ON_MASKS => Verdict::Doubtful,
        _ => Verdict::Pass,
    };
    Finding {
        what: "tracks on the masks",
        verdict,
        text: format!("{found}"),
    }
}

/// Tracks of what does not move go where depth and poses say.
fn still(scene: &Scene, fit: &Fit) -> Option<Finding> {
    let (mut errors, mut shifts) = (Vec::new(), Vec::new());
    let n = scene.frames.len();
    for query in scene.tracks.iter().flat_map(|t| &t.queries) {
        let Some(from) = scene.frames.get(query.frame) else {
            continue;
        };
        // What lies beside a mask may belong to what it shows.
        let margin = pixels_at_256(MARGIN, from.view.camera.width);
        let mask = fit.reading.mask(from);
        let near_mask = mask.map(|m| dilate(&m, margin, 0.02));
        let moves = |pixel: usize| near_mask.as_ref().is_some_and(|m| m[pixel]);
        let world_from_query = fit.pose(scene, query.frame).inverse();
        let camera = &from.view.camera;
        for row in query.samples.chunks_exact(n) {
            let start = position(&row[query.frame]);
            if !is_sure(&row[query.frame]) || !is_inside(camera.width, camera.height, start) {
                continue;
            }
            let pixel = pixel_index(camera, start);
            let z = fit.depth(scene, query.frame, pixel);
            if z <= 0.0 || moves(pixel) {
                continue;
            }
            let point = world_from_query.transform_point3(camera.unproject(start, z));
            for (frame, sample) in row.iter().enumerate().filter(|(k, _)| *k != query.frame) {
                let seen = fit.pose(scene, frame).transform_point3(point);
                let at = seen_at(&scene.frames[frame].view.camera, seen);
                if let Some(at) = at.filter(|_| is_sure(sample)) {
                    errors.push(at.distance(position(sample)));
                    shifts.push(start.distance(position(sample)));
                }
            }
        }
    }
    if errors.len() < ENOUGH || median(&shifts) < LEAST_SHIFT {
        return None;
    }
    let (error, shift) = (median(&errors), median(&shifts));
    Some(Finding {
        what: "tracks and poses",
        verdict: if error < 0.5 * shift {
            Verdict::Pass
        } else {
            Verdict::Doubtful
        },
        text: format!(
            "where nothing moves tracks go {shift:.1} px, and {error:.1} px from where depth and pose say"
        ),
    })
}
