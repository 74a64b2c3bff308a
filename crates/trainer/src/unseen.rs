//! The unseen views of a run, which the paper adds to the training frames: frames warped between two cameras (parallel to the
//! path) and beside it (perpendicular).

use crate::blur::BlurModel;
use crate::error::{SceneProblem, TrainError};
use crate::random::{Purpose, generator, unit};
use crate::settings::Settings;
use crate::views::{CameraView, UnseenView, Views};
use io::Scene;
use rayon::prelude::*;
use std::borrow::Cow;
use unseen_views::{Source, WarpOptions, parallel_pose, perpendicular_pose, warp};

/// All unseen views of a scene: between neighbouring frames, warped from both, and to both sides of
/// the path at a random distance in [0.5, 1] of `offset` times S. Views with too few valid pixels are dropped.
///
/// They depend on scene, settings and seed alone. Pixels that are not `learned` from (see `Data::learned`) are not warped.
pub(crate) fn unseen_views(
    scene: &Scene,
    views: &Views,
    settings: &Settings,
    blur: &BlurModel,
    scene_size: f64,
    learned: &[Vec<bool>],
) -> Result<Vec<UnseenView>, TrainError> {
    let required = matches!(blur, BlurModel::Kernels(_));
    if !settings.unseen.when.holds(required) {
        return Ok(Vec::new());
    }
    let options = WarpOptions {
        sharpness: settings.unseen.sharpness,
        edge_jump: settings.gaussians.depth_edge,
    };
    let mut wanted = Vec::new();
    for i in 0..scene.frames.len().saturating_sub(1) {
        let a = &views.train[i].cam_from_world;
        let b = &views.train[i + 1].cam_from_world;
        if let Some(middle) = parallel_pose(a, b) {
            wanted.push((format!("parallel {i} from {i}"), i, middle));
            wanted.push((format!("parallel {i} from {}", i + 1), i + 1, middle));
        }
        for (side, sign) in [(0, 1.0), (1, -1.0)] {
            let mut rng = generator(settings.seed, Purpose::UnseenOffset, (2 * i + side) as u64);
            let offset = sign * settings.unseen.offset * scene_size * (0.5 + 0.5 * unit(&mut rng));
            wanted.push((
                format!("perpendicular {i} {side}"),
                i,
                perpendicular_pose(a, b, offset),
            ));
        }
    }
    let warped: Vec<Option<UnseenView>> = wanted
        .into_par_iter()
        .map(|(name, frame, cam_from_world)| {
            let source = &scene.frames[frame];
            let Some(depth) = &source.depth else {
                return Ok(None);
            };
            let depth = match learned.get(frame) {
                Some(learned) => {
                    let pixels = depth.values.iter().zip(learned);
                    Cow::Owned(pixels.map(|(z, l)| if *l { *z } else { 0.0 }).collect())
                }
                None => Cow::Borrowed(&depth.values),
            };
            let from = &views.train[frame];
            let camera = &from.camera;
            let source = Source {
                camera,
                cam_from_world: &from.cam_from_world,
                color: &source.view.image.pixels,
                depth: &depth,
                mask: source.mask.as_ref().map(|m| m.values.as_slice()),
            };
            let view = warp(&source, camera, &cam_from_world, &options).map_err(|source| {
                SceneProblem::UnseenView {
                    name: name.clone(),
                    source,
                }
            })?;
            let enough = view.valid_fraction() >= settings.unseen.min_valid;
            Ok(enough.then(|| UnseenView {
                viewpoint: CameraView {
                    name,
                    camera: camera.clone(),
                    cam_from_world,
                    time: from.time,
                },
                frame,
                image: view.color,
                mask: view.mask,
                valid: view.valid,
            }))
        })
        .collect::<Result<_, TrainError>>()?;
    Ok(warped.into_iter().flatten().collect())
}
