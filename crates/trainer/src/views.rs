//! Where views are seen from, and what an iteration learns from.

use crate::losses::point_disparity;
use crate::sent::{Sent, on_device};
use crate::tensors::host;
use burn::tensor::{Bool, DType, Device, Tensor, TensorData};
use glam::{DAffine3, DMat3, DVec2, DVec3};
use io::Scene;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use splat_core::{Camera, camera_center, pose_rows};
use unseen_views::Warped;

/// From where and when a view is seen: everything of it but its picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraView {
    /// The view's name.
    pub name: String,
    /// Intrinsics, with the near plane of the run.
    pub camera: Camera,
    /// Pose of the camera, OpenCV axes.
    #[serde(serialize_with = "write_pose", deserialize_with = "read_pose")]
    pub cam_from_world: DAffine3,
    /// Time in units of training frames.
    pub time: f32,
}

fn write_pose<S: Serializer>(pose: &DAffine3, serializer: S) -> Result<S::Ok, S::Error> {
    pose_rows(pose).serialize(serializer)
}

fn read_pose<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DAffine3, D::Error> {
    Ok(pose_of(&<[f64; 12]>::deserialize(deserializer)?))
}

/// The pose whose rows [R | t] are these; see [`pose_rows`].
fn pose_of(r: &[f64; 12]) -> DAffine3 {
    DAffine3 {
        matrix3: DMat3::from_cols_array(&[r[0], r[4], r[8], r[1], r[5], r[9], r[2], r[6], r[10]]),
        translation: DVec3::new(r[3], r[7], r[11]),
    }
}

/// A pose as the renderer takes it, [3, 4].
pub(crate) fn pose_tensor(pose: &DAffine3, options: (&Device, DType)) -> Tensor<2> {
    Tensor::from_data(TensorData::new(pose_rows(pose).to_vec(), [3, 4]), options)
}

/// The poses whose rows [R | t] a tensor [n, 3, 4] holds.
pub(crate) fn poses_of(poses: Tensor<3>) -> Vec<DAffine3> {
    let rows = host(poses.detach());
    let rows = rows.as_chunks::<12>().0.iter();
    rows.map(|rows| pose_of(&rows.map(f64::from))).collect()
}

/// Whether a place lies in a picture of this size, px.
pub(crate) fn is_inside(width: usize, height: usize, at: DVec2) -> bool {
    (0.0..width as f64).contains(&at.x) && (0.0..height as f64).contains(&at.y)
}

/// Where a camera sees a point of its space, in pixels; `None` behind the camera and outside of the picture.
pub(crate) fn seen_at(camera: &Camera, point: DVec3) -> Option<DVec2> {
    let pixel = camera.project(point);
    let seen = point.z > 0.0 && is_inside(camera.width, camera.height, pixel);
    seen.then_some(pixel)
}

/// Index of the pixel that a place in the picture lies in.
pub(crate) fn pixel_index(camera: &Camera, at: DVec2) -> usize {
    at.y as usize * camera.width + at.x as usize
}

/// The centre of pixel `i` (row-major), px.
pub(crate) fn pixel_center(camera: &Camera, i: usize) -> DVec2 {
    DVec2::new(
        (i % camera.width) as f64 + 0.5,
        (i / camera.width) as f64 + 0.5,
    )
}

/// Index of the pixel that sees a point of the camera's space; `None` as for [`seen_at`].
pub(crate) fn pixel_of(camera: &Camera, point: DVec3) -> Option<usize> {
    seen_at(camera, point).map(|at| pixel_index(camera, at))
}

/// The views of a scene, as far as rendering needs them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Views {
    /// Training frames in time order.
    pub train: Vec<CameraView>,
    /// Test views.
    pub test: Vec<CameraView>,
}

impl Views {
    /// The views of a scene, with a near plane in scene units.
    pub(crate) fn of(scene: &Scene, near: f64) -> Self {
        let viewpoint = |view: &io::View| CameraView {
            name: view.name.clone(),
            camera: view.camera.clone().with_near(near),
            cam_from_world: view.cam_from_world,
            time: view.time,
        };
        Self {
            train: scene.frames.iter().map(|f| viewpoint(&f.view)).collect(),
            test: scene.test.iter().map(viewpoint).collect(),
        }
    }
}

/// A view that was never filmed: from where a training frame is warped to.
#[derive(Clone, Debug)]
pub(crate) struct UnseenView {
    pub(crate) viewpoint: CameraView,
    /// The frame that is warped.
    pub(crate) frame: usize,
}

/// A view with its targets, ready for the device.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewRef<'a> {
    pub(crate) viewpoint: &'a CameraView,
    /// Index of the training frame whose time, blur and camera it has.
    pub(crate) frame: usize,
    image: &'a [f32],
    /// z-depth, 0 where missing, [H, W].
    depth: Option<&'a [f32]>,
    /// z-depth of sparse points, 0 where there is none, [H, W].
    pub(crate) points: Option<&'a [f32]>,
    /// Dynamic mask, [H, W].
    mask: Option<&'a [f32]>,
    /// What of it is on a GPU.
    pub(crate) sent: Option<&'a Sent>,
    /// Pixels that have a target, [H, W]; `None` where all have one.
    pub(crate) valid: Option<&'a [bool]>,
    /// Whether the view was warped and not filmed.
    pub(crate) is_unseen: bool,
}

impl<'a> ViewRef<'a> {
    pub(crate) fn training(views: &'a Views, scene: &'a Scene, frame: usize) -> Self {
        let source = &scene.frames[frame];
        Self {
            viewpoint: &views.train[frame],
            frame,
            image: &source.view.image.pixels,
            depth: source.depth.as_ref().map(|m| m.values.as_slice()),
            points: None,
            mask: source.mask.as_ref().map(|m| m.values.as_slice()),
            sent: None,
            valid: None,
            is_unseen: false,
        }
    }

    /// An unseen view, and what it sees.
    pub(crate) fn unseen(view: &'a UnseenView, warped: &'a Warped) -> Self {
        Self {
            viewpoint: &view.viewpoint,
            frame: view.frame,
            image: &warped.color,
            depth: None,
            points: None,
            mask: warped.mask.as_deref(),
            sent: None,
            valid: Some(&warped.valid),
            is_unseen: true,
        }
    }

    pub(crate) fn center(&self) -> DVec3 {
        camera_center(&self.viewpoint.cam_from_world)
    }

    /// The picture as a tensor [H, W, 3] of the device and dtype of another.
    pub(crate) fn image<const D: usize>(&self, like: &Tensor<D>) -> Tensor<3> {
        let [height, width] = self.shape();
        let kept = self.sent.map(|sent| &sent.image);
        on_device(kept, like, [height, width, 3], || self.image.to_vec())
    }

    /// What a picture of it is compared with. Holes take the picture itself, so that windows over them carry no false loss.
    pub(crate) fn target(&self, seen: &Tensor<3>) -> Tensor<3> {
        let target = self.image(seen);
        match self.holes(&seen.device()) {
            Some(holes) => {
                let shape = target.dims();
                target.mask_where(holes.expand(shape), seen.clone().detach())
            }
            None => target,
        }
    }

    /// The given depth, [H, W], likewise.
    pub(crate) fn depth<const D: usize>(&self, like: &Tensor<D>) -> Option<Tensor<2>> {
        let depth = self.depth?;
        let kept = self.sent.map(|sent| &sent.depth);
        Some(on_device(kept, like, self.shape(), || depth.to_vec()))
    }

    /// The disparity of the sparse points times the scene size, [H, W], likewise.
    pub(crate) fn point_disparity<const D: usize>(
        &self,
        like: &Tensor<D>,
        scene_size: f64,
    ) -> Option<Tensor<2>> {
        let points = self.points?;
        let kept = self.sent.map(|sent| &sent.points);
        let disparity = || point_disparity(points, scene_size);
        Some(on_device(kept, like, self.shape(), disparity))
    }

    /// The dynamic mask, [H, W], likewise.
    pub(crate) fn mask<const D: usize>(&self, like: &Tensor<D>) -> Option<Tensor<2>> {
        let mask = self.mask?;
        let kept = self.sent.map(|sent| &sent.mask);
        Some(on_device(kept, like, self.shape(), || mask.to_vec()))
    }

    fn shape(&self) -> [usize; 2] {
        let Camera { width, height, .. } = self.viewpoint.camera;
        [height, width]
    }

    /// Pixels without a target, [H, W, 1]; `None` where all have one.
    pub(crate) fn holes(&self, device: &Device) -> Option<Tensor<3, Bool>> {
        let valid = self.valid?;
        if valid.iter().all(|&v| v) {
            return None;
        }
        let Camera { width, height, .. } = self.viewpoint.camera;
        let holes: Vec<bool> = valid.iter().map(|v| !v).collect();
        Some(Tensor::from_data(
            TensorData::new(holes, [height, width, 1]),
            device,
        ))
    }
}
