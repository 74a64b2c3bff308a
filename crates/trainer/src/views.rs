//! What an iteration can show: training views, and unseen views warped from them.

use crate::TrainError;
use crate::random::{Purpose, generator, unit};
use crate::settings::UnseenSettings;
use burn::tensor::{Bool, Device, Tensor, TensorData};
use glam::{DAffine3, DVec3};
use io::Scene;
use rayon::prelude::*;
use splat_core::{Camera, camera_center, pose_rows};
use unseen_views::{Source, WarpOptions, parallel_pose, perpendicular_pose, warp};

/// A view that was never filmed: a training frame, warped.
#[derive(Debug)]
pub(crate) struct UnseenView {
    name: String,
    frame: usize,
    cam_from_world: DAffine3,
    image: Vec<f32>,
    mask: Option<Vec<f32>>,
    valid: Vec<bool>,
}

/// A view with its targets, ready for the device.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewRef<'a> {
    pub(crate) name: &'a str,
    /// Index of the training frame whose time, embedding and camera it has.
    pub(crate) frame: usize,
    pub(crate) time: f32,
    pub(crate) cam_from_world: DAffine3,
    pub(crate) width: usize,
    pub(crate) height: usize,
    image: &'a [f32],
    /// z-depth, 0 where missing, [H, W].
    pub(crate) depth: Option<&'a [f32]>,
    /// Dynamic mask, [H, W].
    pub(crate) mask: Option<&'a [f32]>,
    /// Pixels that have a target, [H, W]; `None` where all have one.
    pub(crate) valid: Option<&'a [bool]>,
}

impl<'a> ViewRef<'a> {
    pub(crate) fn training(scene: &'a Scene, frame: usize) -> Self {
        let source = &scene.frames[frame];
        Self {
            name: &source.view.name,
            frame,
            time: source.view.time,
            cam_from_world: source.view.cam_from_world,
            width: source.view.camera.width,
            height: source.view.camera.height,
            image: &source.view.image.pixels,
            depth: source.depth.as_ref().map(|m| m.values.as_slice()),
            mask: source.mask.as_ref().map(|m| m.values.as_slice()),
            valid: None,
        }
    }

    pub(crate) fn unseen(scene: &'a Scene, view: &'a UnseenView) -> Self {
        Self {
            name: &view.name,
            cam_from_world: view.cam_from_world,
            image: &view.image,
            depth: None,
            mask: view.mask.as_deref(),
            valid: Some(&view.valid),
            ..Self::training(scene, view.frame)
        }
    }

    /// Whether the view was warped and not filmed.
    pub(crate) fn is_unseen(&self) -> bool {
        self.valid.is_some()
    }

    pub(crate) fn center(&self) -> DVec3 {
        camera_center(&self.cam_from_world)
    }

    /// `cam_from_world` as a tensor [3, 4] of the device and dtype of another.
    pub(crate) fn pose<const D: usize>(&self, like: &Tensor<D>) -> Tensor<2> {
        pose_tensor(&self.cam_from_world, like)
    }

    /// The frame as a tensor [H, W, 3] of the device and dtype of another.
    pub(crate) fn image<const D: usize>(&self, like: &Tensor<D>) -> Tensor<3> {
        let data = TensorData::new(self.image.to_vec(), [self.height, self.width, 3]);
        Tensor::from_data(data, (&like.device(), like.dtype()))
    }

    /// Pixels without a target, [H, W, 1]; `None` where all have one.
    pub(crate) fn holes(&self, device: &Device) -> Option<Tensor<3, Bool>> {
        let valid = self.valid?;
        if valid.iter().all(|&v| v) {
            return None;
        }
        let holes: Vec<bool> = valid.iter().map(|v| !v).collect();
        Some(Tensor::from_data(
            TensorData::new(holes, [self.height, self.width, 1]),
            device,
        ))
    }
}

/// A pose as a tensor [3, 4] of the device and dtype of another.
pub(crate) fn pose_tensor<const D: usize>(
    cam_from_world: &DAffine3,
    like: &Tensor<D>,
) -> Tensor<2> {
    Tensor::from_data(
        TensorData::new(pose_rows(cam_from_world).to_vec(), [3, 4]),
        (&like.device(), like.dtype()),
    )
}

/// The camera of a training frame, with the near plane of the run.
pub(crate) fn camera_of(scene: &Scene, frame: usize, near: f64) -> Camera {
    scene.frames[frame].view.camera.clone().with_near(near)
}

/// All unseen views of a scene: between neighbouring frames, warped from both, and to both sides of
/// the path at a random distance in [0.5, 1] of `offset` times S. Views with too few valid pixels are dropped.
pub(crate) fn unseen_views(
    scene: &Scene,
    settings: &UnseenSettings,
    scene_size: f64,
    near: f64,
    depth_edge: f64,
    seed: u64,
) -> Result<Vec<UnseenView>, TrainError> {
    let options = WarpOptions {
        sharpness: settings.sharpness,
        edge_jump: depth_edge,
    };
    let mut wanted = Vec::new();
    for i in 0..scene.frames.len().saturating_sub(1) {
        let a = &scene.frames[i].view.cam_from_world;
        let b = &scene.frames[i + 1].view.cam_from_world;
        if let Some(middle) = parallel_pose(a, b) {
            wanted.push((format!("parallel {i} from {i}"), i, middle));
            wanted.push((format!("parallel {i} from {}", i + 1), i + 1, middle));
        }
        for (side, sign) in [(0, 1.0), (1, -1.0)] {
            let mut rng = generator(seed, Purpose::UnseenOffset, (2 * i + side) as u64);
            let offset = sign * settings.offset * scene_size * (0.5 + 0.5 * unit(&mut rng));
            wanted.push((
                format!("perpendicular {i} {side}"),
                i,
                perpendicular_pose(a, b, offset),
            ));
        }
    }
    let views: Vec<Option<UnseenView>> = wanted
        .into_par_iter()
        .map(|(name, frame, cam_from_world)| {
            let source = &scene.frames[frame];
            let Some(depth) = &source.depth else {
                return Ok(None);
            };
            let camera = camera_of(scene, frame, near);
            let source = Source {
                camera: &camera,
                cam_from_world: &source.view.cam_from_world,
                color: &source.view.image.pixels,
                depth: &depth.values,
                mask: source.mask.as_ref().map(|m| m.values.as_slice()),
            };
            let warped = warp(&source, &camera, &cam_from_world, &options)
                .map_err(|e| TrainError::Scene(format!("unseen view {name}: {e}")))?;
            let enough = warped.valid_fraction() >= settings.min_valid;
            Ok(enough.then_some(UnseenView {
                name,
                frame,
                cam_from_world,
                image: warped.color,
                mask: warped.mask,
                valid: warped.valid,
            }))
        })
        .collect::<Result<_, TrainError>>()?;
    Ok(views.into_iter().flatten().collect())
}
