//! Looks at a scene before training: its size, its depth against the sparse points, and what there is to model.

use crate::brightness::{brightness_change, gains_differ};
use crate::error::{SceneProblem, TrainError};
use crate::sharpness::{is_blurred, sharpness_change};
use crate::views::pixel_of;
use io::{Frame, Map, Scene, SparsePoint};
use serde::{Deserialize, Serialize};

/// What was found in a scene and decided from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Survey {
    /// Scene size S: the median z-depth over the training pixels (without depth: over the sparse points), in scene units.
    pub scene_size: f64,
    /// Depths between which 90 % of the same lie, near and far, scene units.
    pub depth_range: [f64; 2],
    /// There are masks that show movers, and tracks that say how they move.
    pub movers: bool,
    /// There is depth for at least one frame.
    pub depth: bool,
    /// Median change of the fine contrast from a frame to the next, as a factor's logarithm; `None` where that cannot be told.
    pub sharpness_change: Option<f64>,
    /// Frames differ more in sharpness than those of a sharp video do, or it cannot be told.
    pub blurred: bool,
    /// Median change of what frames have in common in brightness, as a factor's logarithm; `None` where that cannot be told.
    pub brightness_change: Option<f64>,
    /// Frames differ more in brightness than those of a fixed exposure do.
    pub gains_differ: bool,
    /// What was decided and why, for people.
    pub notes: Vec<String>,
}

/// Surveys a scene, and aligns the disparity of each frame to the sparse points where there are any
/// (a robust scale and shift per frame).
///
/// # Errors
/// The scene has neither depth nor sparse points in front of its cameras.
pub fn survey(scene: &mut Scene) -> Result<Survey, TrainError> {
    let mut notes = Vec::new();
    for frame in &mut scene.frames {
        // A map without a single depth is no map.
        frame.depth = frame
            .depth
            .take()
            .filter(|m| m.values.iter().any(|&z| z > 0.0));
    }
    let depth = scene.frames.iter().any(|f| f.depth.is_some());
    if depth {
        let aligned = scene
            .frames
            .iter_mut()
            .filter_map(|frame| {
                let fit = fit_to_points(frame, &scene.points)?;
                apply_disparity_fit(frame.depth.as_mut()?, fit);
                Some(fit)
            })
            .collect::<Vec<_>>();
        if aligned.is_empty() {
            notes.push("depth is used as it is: too few sparse points to align it to".to_owned());
        } else {
            let largest = aligned
                .iter()
                .map(|(s, _)| (s - 1.0).abs())
                .fold(0.0, f64::max);
            notes.push(format!(
                "depth of {} frames aligned to the sparse points (scale changed by up to {:.1} %)",
                aligned.len(),
                100.0 * largest
            ));
        }
    } else {
        notes.push(
            "no depth: Gaussians start at the sparse points, no depth loss, no unseen views"
                .to_owned(),
        );
    }
    let mut depths: Vec<f32> = if depth {
        let maps = scene.frames.iter().filter_map(|f| f.depth.as_ref());
        maps.flat_map(|m| m.values.iter().copied())
            .filter(|&z| z > 0.0)
            .collect()
    } else {
        sparse_depths(scene)
    };
    if depths.is_empty() {
        return Err(SceneProblem::NoDepth.into());
    }
    let [scene_size, near, far] =
        [0.5, 0.05, 0.95].map(|share| f64::from(quantile(&mut depths, share)));
    let masked = scene
        .frames
        .iter()
        .filter_map(|f| f.mask.as_ref())
        .any(|m| m.values.iter().any(|&v| v > 0.5));
    let tracked = scene
        .tracks
        .as_ref()
        .is_some_and(|t| t.queries.iter().any(|q| !q.samples.is_empty()));
    let movers = masked && tracked && depth;
    notes.push(match (masked, tracked, depth) {
        (true, true, true) => "masks and tracks show movers".to_owned(),
        (true, true, false) => {
            "masks and tracks are ignored: movers need depth to be lifted".to_owned()
        }
        (true, false, _) => "masks without tracks: the scene is modelled as static".to_owned(),
        (false, ..) => "no movers: no motion bases".to_owned(),
    });
    let sharpness_change = sharpness_change(&scene.frames);
    let brightness_change = brightness_change(&scene.frames);
    Ok(Survey {
        scene_size,
        depth_range: [near, far],
        movers,
        depth,
        sharpness_change,
        blurred: sharpness_change.is_none_or(is_blurred),
        brightness_change,
        gains_differ: brightness_change.is_some_and(gains_differ),
        notes,
    })
}

/// The value above a share of all, of which there is at least one. Values are reordered.
fn quantile(values: &mut [f32], share: f64) -> f32 {
    let rank = (share * values.len() as f64) as usize;
    let rank = rank.min(values.len() - 1);
    *values.select_nth_unstable_by(rank, f32::total_cmp).1
}

fn sparse_depths(scene: &Scene) -> Vec<f32> {
    let points = &scene.points;
    let views = scene.frames.iter().map(|f| &f.view);
    views
        .flat_map(|view| {
            points.iter().filter_map(|p| {
                let c = view.cam_from_world.transform_point3(p.position);
                pixel_of(&view.camera, c).map(|_| c.z as f32)
            })
        })
        .collect()
}

/// Fewer sparse points than this in a frame say too little about its depth.
const MIN_POINTS: usize = 20;

/// Points whose disparity differs by more than this share from a frame's depth are hidden there.
const HIDDEN: f64 = 0.05;

/// The sparse points that a frame sees where nothing moves: index of the pixel, and z-depth; hidden ones as well.
fn points_in<'a>(
    frame: &'a Frame,
    points: &'a [SparsePoint],
) -> impl Iterator<Item = (usize, f64)> + 'a {
    let view = &frame.view;
    points.iter().filter_map(move |point| {
        let c = view.cam_from_world.transform_point3(point.position);
        let i = pixel_of(&view.camera, c)?;
        let moving = frame.mask.as_ref().is_some_and(|m| m.values[i] > 0.0);
        (!moving).then_some((i, c.z))
    })
}

/// z-depth of the sparse points in a frame, 0 where there is none, [H, W]; without those that its own depth, aligned to
/// them, hides. `None` where there are too few.
pub(crate) fn point_depths(frame: &Frame, points: &[SparsePoint]) -> Option<Vec<f32>> {
    let depth = frame.depth.as_ref()?;
    let mut map = vec![0.0; depth.values.len()];
    for (i, z) in points_in(frame, points) {
        let away = z / f64::from(depth.values[i]) - 1.0;
        if away.abs() < HIDDEN {
            map[i] = z as f32;
        }
    }
    let count = map.iter().filter(|z| **z > 0.0).count();
    (count >= MIN_POINTS).then_some(map)
}

/// Robust scale and shift of a frame's disparity against the sparse points: least absolute
/// differences by re-weighted least squares. `None` where there are too few points.
fn fit_to_points(frame: &Frame, points: &[SparsePoint]) -> Option<(f64, f64)> {
    let depth = frame.depth.as_ref()?;
    let pairs = points_in(frame, points).filter_map(|(i, point)| {
        let z = f64::from(depth.values[i]);
        (z > 0.0).then_some((1.0 / z, 1.0 / point))
    });
    let pairs: Vec<(f64, f64)> = pairs.collect();
    if pairs.len() < MIN_POINTS {
        return None;
    }
    let floor = 1e-3 * pairs.iter().map(|p| p.1).sum::<f64>() / pairs.len() as f64;
    let (mut scale, mut shift) = (1.0, 0.0);
    let mut weights = vec![1.0; pairs.len()];
    for _ in 0..20 {
        let (mut w0, mut x0, mut y0, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for ((x, y), w) in pairs.iter().zip(&weights) {
            w0 += w;
            x0 += w * x;
            y0 += w * y;
            xx += w * x * x;
            xy += w * x * y;
        }
        let determinant = w0 * xx - x0 * x0;
        if determinant <= 1e-12 * w0 * xx {
            // All points at one depth: only a scale can be told.
            (scale, shift) = (y0 / x0, 0.0);
        } else {
            scale = (w0 * xy - x0 * y0) / determinant;
            shift = (y0 - scale * x0) / w0;
        }
        for (w, (x, y)) in weights.iter_mut().zip(&pairs) {
            *w = 1.0 / (scale * x + shift - y).abs().max(floor);
        }
    }
    (scale > 0.0 && scale.is_finite() && shift.is_finite()).then_some((scale, shift))
}

/// Applies a fit; where the fitted disparity is no longer positive, depth becomes missing.
fn apply_disparity_fit(depth: &mut Map, (scale, shift): (f64, f64)) {
    for z in &mut depth.values {
        if *z > 0.0 {
            let disparity = scale / f64::from(*z) + shift;
            *z = if disparity > 1e-9 * scale {
                (1.0 / disparity) as f32
            } else {
                0.0
            };
        }
    }
}
