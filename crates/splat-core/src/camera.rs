//! Cameras: a pinhole's intrinsics as a plain struct. Poses are `glam::DAffine3`, named `b_from_a`.

use glam::{DAffine3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::cpu::TILE;

/// How a camera projects a point; one variant for now.
///
/// Exhaustive on purpose: whatever computes with intrinsics matches the model, so that a second variant
/// stops the build in each of these places. A wildcard arm, which `#[non_exhaustive]` asks other crates
/// for, would take the new camera for a pinhole and say nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CameraModel {
    /// Pinhole without distortion.
    Pinhole,
}

/// Intrinsics, image size and near plane of a camera.
///
/// OpenCV axes (x right, y down, z forward); the centre of pixel (i, j) is at (i + 0.5, j + 0.5).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Camera {
    /// Projection model.
    pub model: CameraModel,
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point's x, in pixels (may be off the centre).
    pub cx: f64,
    /// Principal point's y, in pixels.
    pub cy: f64,
    /// Points with a z-depth up to this are not drawn, in scene units.
    pub near: f64,
}

impl Camera {
    /// A pinhole camera with a near plane at 0.01 scene units, from the picture's size, the focal lengths
    /// along x and y, and the principal point; all in pixels.
    #[must_use]
    pub fn pinhole([width, height]: [usize; 2], [fx, fy]: [f64; 2], [cx, cy]: [f64; 2]) -> Self {
        Self {
            model: CameraModel::Pinhole,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            near: 0.01,
        }
    }

    /// The same camera with another near plane (scene units).
    #[must_use]
    pub fn with_near(mut self, near: f64) -> Self {
        self.near = near;
        self
    }

    /// Number of tiles along x and y.
    pub(crate) fn tiles(&self) -> [usize; 2] {
        [self.width, self.height].map(|side| side.div_ceil(TILE))
    }

    /// Number of pixels.
    #[must_use]
    pub fn num_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Pixel coordinates of a point in camera space. Meaningful only for z > 0.
    #[must_use]
    pub fn project(&self, point_in_cam: DVec3) -> DVec2 {
        match self.model {
            CameraModel::Pinhole => DVec2::new(
                self.fx * point_in_cam.x / point_in_cam.z + self.cx,
                self.fy * point_in_cam.y / point_in_cam.z + self.cy,
            ),
        }
    }

    /// The point in camera space that is seen at `pixel` (px) at a z-depth (scene units).
    #[must_use]
    pub fn unproject(&self, pixel: DVec2, depth: f64) -> DVec3 {
        match self.model {
            CameraModel::Pinhole => DVec3::new(
                (pixel.x - self.cx) / self.fx * depth,
                (pixel.y - self.cy) / self.fy * depth,
                depth,
            ),
        }
    }
}

/// The rows of a rigid transform as a [3, 4] matrix, row-major.
#[must_use]
pub fn pose_rows(cam_from_world: &DAffine3) -> [f64; 12] {
    let (r, t) = (cam_from_world.matrix3, cam_from_world.translation);
    [
        r.x_axis.x, r.y_axis.x, r.z_axis.x, t.x, //
        r.x_axis.y, r.y_axis.y, r.z_axis.y, t.y, //
        r.x_axis.z, r.y_axis.z, r.z_axis.z, t.z,
    ]
}

/// The camera's centre in the world.
#[must_use]
pub fn camera_center(cam_from_world: &DAffine3) -> DVec3 {
    cam_from_world.inverse().translation
}
