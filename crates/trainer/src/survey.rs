//! Looks at a scene before training: its size, its depth against the sparse points, and what there is to model.

use crate::alignment::fit_to_points;
use crate::brightness::{brightness_changes, gains_differ};
use crate::error::{SceneProblem, TrainError};
use crate::settings::{BlurKind, Settings, When};
use crate::sharpness::SharpnessChange;
use crate::statistics::quantile_by;
use crate::track_motion::{TrackMotion, track_motion};
use crate::views::pixel_of;
use io::Scene;
use serde::{Deserialize, Serialize};

/// No tracked point is nearer to a camera, as a share of the scene's size.
const NEAREST: f64 = 0.1;

/// What was found in a scene and decided from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Survey {
    /// Scene size S: the median z-depth over the training pixels (without depth: over the sparse points), in scene units.
    pub scene_size: f64,
    /// Depths between which 90 % of the same lie, near and far, scene units.
    pub depth_range: [f64; 2],
    /// There are masks that show movers, and tracks that say how they move and do not say that they stand still
    /// ([`crate::settings::MotionSettings::when`] can ask for movers all the same, or for none).
    pub movers: bool,
    /// What tracks say of whether they move; `None` where there are too few.
    #[serde(default)]
    pub track_motion: Option<TrackMotion>,
    /// There is depth for at least one frame.
    pub depth: bool,
    /// How much more than nine in ten pairs of frames differ in the fine contrast of what both see, as a factor's logarithm; `None`
    /// where that cannot be told.
    #[serde(default)]
    pub shared_sharpness_change: Option<f64>,
    /// Median change of the fine contrast of all that is seen from a frame to the next, as a factor's logarithm, by which frames are
    /// judged where the other is not known; `None` where it cannot be told.
    pub sharpness_change: Option<f64>,
    /// Frames differ more in sharpness than those of a sharp video do, or it cannot be told.
    pub blurred: bool,
    /// How much more than half of the pairs of frames differ in the brightness of what both see, as a factor's logarithm; `None` where
    /// that cannot be told.
    pub brightness_change: Option<f64>,
    /// The same of nine in ten pairs.
    #[serde(default)]
    pub most_brightness_change: Option<f64>,
    /// Frames differ more in brightness than those of a fixed exposure do.
    pub gains_differ: bool,
    /// What was decided and why, for people.
    pub notes: Vec<String>,
}

impl Survey {
    /// What settings leave to the survey, and how it decides; for people.
    #[must_use]
    pub fn decided(&self, settings: &Settings) -> Vec<String> {
        let notes = [blur_note(settings, self), gains_note(settings, self)];
        notes.into_iter().flatten().collect()
    }
}

/// Why blur is modelled or not, where that is left to the survey.
fn blur_note(settings: &Settings, survey: &Survey) -> Option<String> {
    if settings.blur.model != BlurKind::Auto {
        return None;
    }
    let percent = |change: f64| {
        let percent = 100.0 * change.exp_m1();
        format!("{percent:.*} %", usize::from(percent < 10.0))
    };
    let found = match (survey.shared_sharpness_change, survey.sharpness_change) {
        (Some(change), _) if survey.blurred => format!(
            "what two frames share differs in fine contrast by {} or more in a tenth of the pairs",
            percent(change)
        ),
        (Some(change), _) => format!(
            "what two frames share differs in fine contrast by {} or less in nine of ten pairs",
            percent(change)
        ),
        (None, Some(change)) => {
            format!(
                "fine contrast changes by {} from frame to frame{}",
                percent(change),
                if survey.blurred {
                    ""
                } else {
                    " (without depth a blur that only some frames have is not told)"
                }
            )
        }
        (None, None) => {
            "too few frames, or too little that stands still, to tell whether they are blurred"
                .to_owned()
        }
    };
    let decision = if survey.blurred {
        "blur is modelled (`blur.model = \"off\"` has no blur model)"
    } else if settings.camera.is_asked_for() {
        "as in a sharp video; blur is modelled since `camera.path` or `camera.lens` is \"always\""
    } else {
        "as in a sharp video: no blur model (`blur.model = \"camera\"` has one all the same)"
    };
    let joint = if survey.blurred { ":" } else { "," };
    Some(format!("{found}{joint} {decision}"))
}

/// Why frames have gains of their own, where that is left to the survey.
fn gains_note(settings: &Settings, survey: &Survey) -> Option<String> {
    let percent = |change: f64| 100.0 * change.exp_m1();
    let half = percent(survey.brightness_change?);
    // Not known of runs that were surveyed before it was asked.
    let most = survey.most_brightness_change.map(percent);
    let most = most.map_or_else(String::new, |most| {
        format!(" in half of the pairs and {most:.1} % in a tenth of them")
    });
    let (decision, otherwise) = if survey.gains_differ {
        (
            ": each has a gain of its own",
            "`frames.gains = \"never\"` has none",
        )
    } else {
        (
            ", as at a fixed exposure: no gains",
            "`frames.gains = \"always\"` has them all the same",
        )
    };
    (settings.frames.gains == When::Auto).then(|| {
        format!("what two frames share differs in brightness by {half:.1} %{most}{decision} ({otherwise})")
    })
}

/// Whether anything is modelled as moving and why, where there are masks, tracks and what these say.
fn movers_note(
    [masked, tracked]: [bool; 2],
    motion: Option<&TrackMotion>,
    asked: When,
    movers: bool,
) -> String {
    if masked && asked == When::Never {
        return "masks are left out (`motion.when = \"never\"`): the scene is modelled as static"
            .to_owned();
    }
    let place = "where something that stands still would be seen";
    match (masked, tracked, motion) {
        (true, false, _) => "masks without tracks: the scene is modelled as static".to_owned(),
        (false, true, Some(motion)) if motion.moves() => format!(
            "warning: there are no masks, but of {} tracks {:.0} % leave {place}, next to each other: either things move, which \
             are left out until masks say where they are, or poses or depth are off",
            motion.tracks,
            100.0 * motion.leaving_together,
        ),
        (false, _, _) => "no movers: no motion bases".to_owned(),
        (true, true, None) => {
            "masks and tracks show movers; too few tracks are seen often enough to tell whether these move \
             (`motion.when = \"never\"` leaves them out)"
                .to_owned()
        }
        (true, true, Some(motion)) => {
            let found = format!(
                "of {} tracks on the masks {:.1} % are more than {:.1} px from {place}, and {:.1} px at the median",
                motion.tracks,
                100.0 * motion.leaving,
                motion.bar_px,
                motion.distance_px
            );
            if !movers {
                format!(
                    "what the masks show stands still: {found}; masks and tracks are left out, and the scene is modelled as \
                     static (`motion.when = \"always\"` models movers all the same)"
                )
            } else if motion.moves() {
                format!("masks and tracks show movers: {found} (`motion.when = \"never\"` models none)")
            } else {
                format!(
                    "masks and tracks show movers, which may stand still: {found}; tracks are near {:.0} % of the masks \
                     (`motion.when = \"never\"` models no movers)",
                    100.0 * motion.covered
                )
            }
        }
    }
}

/// Surveys a scene, aligns the disparity of each frame to the sparse points where there are any (a robust scale and shift per
/// frame), and takes the masks away where the tracks on them say that nothing moves; `asked` can ask for movers all the same, or
/// for none ([`crate::settings::MotionSettings::when`]). Masks that are left out for that are left out of everything.
///
/// # Errors
/// The scene has neither depth nor sparse points in front of its cameras, or movers and no depth to lift them by.
pub fn survey(scene: &mut Scene, asked: When) -> Result<Survey, TrainError> {
    let mut notes = Vec::new();
    let masked = scene
        .frames
        .iter()
        .filter_map(|f| f.mask.as_ref())
        .any(|m| m.values.iter().any(|&v| v > 0.5));
    if asked == When::Never {
        drop_masks(scene);
    }
    if drop_empty_depth(scene) {
        notes.extend(align_depth(scene));
    }
    // Aligned, all of a map may come to lie behind its camera.
    let depth = drop_empty_depth(scene);
    if !depth {
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
        [0.5, 0.05, 0.95].map(|share| f64::from(quantile_by(&mut depths, share, f32::total_cmp)));
    let tracked = scene
        .tracks
        .as_ref()
        .is_some_and(|t| t.queries.iter().any(|q| !q.samples.is_empty()));
    let shown = masked && tracked && asked != When::Never;
    if shown && !depth {
        return Err(SceneProblem::MoversWithoutDepth.into());
    }
    let track_motion = track_motion(scene, NEAREST * scene_size);
    let stand_still = track_motion.as_ref().is_some_and(TrackMotion::stands_still);
    let movers = shown && asked.holds(!stand_still);
    if shown && !movers {
        drop_masks(scene);
    }
    let given = [masked, tracked];
    notes.push(movers_note(given, track_motion.as_ref(), asked, movers));
    let sharpness = SharpnessChange::of(&scene.frames);
    let brightness = brightness_changes(&scene.frames);
    Ok(Survey {
        scene_size,
        depth_range: [near, far],
        movers,
        track_motion,
        depth,
        shared_sharpness_change: sharpness.shared,
        sharpness_change: sharpness.whole,
        blurred: sharpness.is_blurred(),
        brightness_change: brightness.map(|changes| changes.half),
        most_brightness_change: brightness.map(|changes| changes.most),
        gains_differ: brightness.is_some_and(gains_differ),
        notes,
    })
}

fn drop_masks(scene: &mut Scene) {
    scene.frames.iter_mut().for_each(|f| f.mask = None);
}

/// Takes away maps without a single depth, which are no maps. Says whether any is left.
fn drop_empty_depth(scene: &mut Scene) -> bool {
    let mut any = false;
    for frame in &mut scene.frames {
        let map = frame.depth.take();
        frame.depth = map.filter(|map| map.values.iter().any(|&z| z > 0.0));
        any |= frame.depth.is_some();
    }
    any
}

/// Aligns the disparity of each frame to the sparse points, as far as they say something about it. Says what was done.
fn align_depth(scene: &mut Scene) -> Vec<String> {
    let (mut scales, mut upside_down, mut few) = (Vec::new(), 0, 0);
    for frame in &mut scene.frames {
        let fit = fit_to_points(frame, &scene.points);
        match (fit, &mut frame.depth) {
            (Some(fit), Some(depth)) if fit.is_upright() => {
                fit.apply(depth);
                scales.push(fit.scale);
            }
            (Some(_), _) => upside_down += 1,
            (None, Some(_)) => few += 1,
            (None, None) => (),
        }
    }
    let mut notes = Vec::new();
    scales.sort_unstable_by(f64::total_cmp);
    if let (Some(least), Some(most)) = (scales.first(), scales.last()) {
        notes.push(format!(
            "depth of {} frames aligned to the sparse points (disparity times {least:.3} to {most:.3})",
            scales.len(),
        ));
    }
    if upside_down > 0 {
        notes.push(format!(
            "warning: depth of {upside_down} frames is used as it is: where the sparse points are near it is far, and the other \
             way round"
        ));
    }
    if few > 0 {
        notes.push(format!(
            "depth of {few} frames is used as it is: too few sparse points to align it to"
        ));
    }
    notes
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
