//! The unseen views of a run, which the paper adds to the training frames: frames warped between two cameras (parallel to the
//! path) and beside it (perpendicular).
//!
//! A frame is warped whenever a view of it is learned from, in a fifth of the iterations: their pictures, four for each frame, would
//! take more memory than all else.

use crate::blur::BlurModel;
use crate::error::{SceneProblem, TrainError};
use crate::random::{Purpose, generator, unit};
use crate::settings::Settings;
use crate::views::{CameraView, UnseenView, Views};
use io::Scene;
use rayon::prelude::*;
use std::borrow::Cow;
use unseen_views::{Source, WarpOptions, Warped, parallel_pose, perpendicular_pose, warp};

/// What unseen views are warped from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Filmed<'a> {
    pub(crate) scene: &'a Scene,
    pub(crate) views: &'a Views,
    pub(crate) settings: &'a Settings,
    /// Which pixels of every frame are learned from (see `Data::learned`): others are not warped.
    pub(crate) learned: &'a [Vec<bool>],
}

impl Filmed<'_> {
    /// All unseen views of a scene: between neighbouring frames, warped from both, and to both sides of
    /// the path at a random distance in [0.5, 1] of `offset` times S. Views with too few valid pixels are dropped.
    ///
    /// They depend on scene, settings and seed alone.
    pub(crate) fn unseen_views(
        &self,
        blur: &BlurModel,
        scene_size: f64,
    ) -> Result<Vec<UnseenView>, TrainError> {
        let unseen = &self.settings.unseen;
        let required = matches!(blur, BlurModel::Kernels(_));
        if !unseen.when.holds(required) {
            return Ok(Vec::new());
        }
        let wanted = self.wanted(scene_size).into_par_iter();
        let wanted = wanted.filter(|view| self.scene.frames[view.frame].depth.is_some());
        let kept = wanted.map(|view| {
            let enough = self.warped(&view)?.valid_fraction() >= unseen.min_valid;
            Ok(enough.then_some(view))
        });
        let kept = kept.collect::<Result<Vec<_>, TrainError>>()?;
        Ok(kept.into_iter().flatten().collect())
    }

    fn wanted(&self, scene_size: f64) -> Vec<UnseenView> {
        let train = &self.views.train;
        let mut wanted = Vec::new();
        let mut add = |name, frame: usize, cam_from_world| {
            let viewpoint = CameraView {
                name,
                camera: train[frame].camera.clone(),
                cam_from_world,
                time: train[frame].time,
            };
            wanted.push(UnseenView { viewpoint, frame });
        };
        for (i, pair) in train.windows(2).enumerate() {
            let [a, b] = [&pair[0].cam_from_world, &pair[1].cam_from_world];
            if let Some(middle) = parallel_pose(a, b) {
                for frame in [i, i + 1] {
                    add(format!("parallel {i} from {frame}"), frame, middle);
                }
            }
            for (side, sign) in [(0, 1.0), (1, -1.0)] {
                let count = (2 * i + side) as u64;
                let mut rng = generator(self.settings.seed, Purpose::UnseenOffset, count);
                let most = sign * self.settings.unseen.offset * scene_size;
                let offset = most * (0.5 + 0.5 * unit(&mut rng));
                let pose = perpendicular_pose(a, b, offset);
                add(format!("perpendicular {i} {side}"), i, pose);
            }
        }
        wanted
    }

    /// What an unseen view sees: its frame, which has to have depth, warped.
    pub(crate) fn warped(&self, view: &UnseenView) -> Result<Warped, TrainError> {
        let UnseenView { viewpoint, frame } = view;
        let source = &self.scene.frames[*frame];
        let depth = source.depth.as_ref().map_or(&[][..], |map| &map.values);
        let depth = match self.learned.get(*frame) {
            Some(learned) => {
                let pixels = depth.iter().zip(learned);
                Cow::Owned(pixels.map(|(z, l)| if *l { *z } else { 0.0 }).collect())
            }
            None => Cow::Borrowed(depth),
        };
        let from = &self.views.train[*frame];
        let source = Source {
            camera: &from.camera,
            cam_from_world: &from.cam_from_world,
            color: &source.view.image.pixels,
            depth: &depth,
            mask: source.mask.as_ref().map(|m| m.values.as_slice()),
        };
        let options = WarpOptions {
            sharpness: self.settings.unseen.sharpness,
            edge_jump: self.settings.gaussians.depth_edge,
        };
        let (camera, pose) = (&viewpoint.camera, &viewpoint.cam_from_world);
        let warped = warp(&source, camera, pose, &options);
        Ok(warped.map_err(|source| SceneProblem::UnseenView {
            name: viewpoint.name.clone(),
            source,
        })?)
    }
}
