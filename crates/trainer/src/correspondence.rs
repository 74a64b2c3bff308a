//! Which places of two frames show the same, by depth and pose.

use crate::views::{pixel_center, seen_at};
use glam::{DAffine3, DVec2};
use splat_core::Camera;

/// A pixel of one frame, seen in another.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// Index of the pixel.
    pub(crate) pixel: usize,
    /// Its centre, px.
    pub(crate) center: DVec2,
    /// Where that is in the other picture, px.
    pub(crate) at: DVec2,
    /// Its z-depth there.
    pub(crate) depth: f64,
}

/// The pixels at every `step`th of a row and a column.
pub(crate) fn every(camera: &Camera, step: usize) -> impl Iterator<Item = usize> + use<> {
    let (width, rows) = (camera.width, (0..camera.height).step_by(step));
    rows.flat_map(move |y| (0..width).step_by(step).map(move |x| y * width + x))
}

/// The pixels of a frame that another camera has in its picture, of [`every`] `step`th. `depth` says how far a pixel
/// is, and that it is not known by 0.
pub(crate) fn seen_in<'a>(
    camera: &'a Camera,
    depth: impl Fn(usize) -> f64 + 'a,
    other: &'a Camera,
    other_from_camera: DAffine3,
    step: usize,
) -> impl Iterator<Item = Seen> + 'a {
    every(camera, step).filter_map(move |pixel| {
        let z = depth(pixel);
        if z <= 0.0 {
            return None;
        }
        let center = pixel_center(camera, pixel);
        let seen = other_from_camera.transform_point3(camera.unproject(center, z));
        let at = seen_at(other, seen)?;
        Some(Seen {
            pixel,
            center,
            at,
            depth: seen.z,
        })
    })
}
