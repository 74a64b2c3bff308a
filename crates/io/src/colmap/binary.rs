//! `cameras.bin`, `images.bin`, `points3D.bin`: little-endian, counts first.

use std::collections::BTreeMap;
use std::path::Path;

use super::model::{ModelImage, cam_from_world, lens, model_by_id, point};
use crate::bytes::{Cursor, read_file};
use crate::camera_model::Lens;
use crate::{IoError, SparsePoint};

pub(super) fn read_cameras(path: &Path) -> Result<BTreeMap<u32, Lens>, IoError> {
    let data = read_file(path)?;
    let mut data = Cursor::new(&data, path);
    // id, model, width, height and at least three parameters.
    let count = data.count(24 + 3 * 8, "cameras")?;
    let mut cameras = BTreeMap::new();
    for _ in 0..count {
        let id = data.u32("a camera's number")?;
        let (model, num_params) = model_by_id(data.i32("a camera's model")?, path)?;
        let size = (
            data.u64("a camera's width")?,
            data.u64("a camera's height")?,
        );
        let mut params = Vec::with_capacity(num_params);
        for _ in 0..num_params {
            params.push(data.f64("a camera's parameter")?);
        }
        cameras.insert(id, lens(model, size, &params, path)?);
    }
    Ok(cameras)
}

pub(super) fn read_images(path: &Path) -> Result<Vec<ModelImage>, IoError> {
    let data = read_file(path)?;
    let mut data = Cursor::new(&data, path);
    // id, quaternion, translation, camera, an empty name, number of 2D points.
    let count = data.count(4 + 32 + 24 + 4 + 1 + 8, "images")?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        data.u32("an image's number")?;
        let mut numbers = [0.0; 7];
        for number in &mut numbers {
            *number = data.f64("an image's pose")?;
        }
        let [w, x, y, z, tx, ty, tz] = numbers;
        let camera_id = data.u32("an image's camera")?;
        let name = data.c_string("an image's name")?;
        let num_points = data.count(24, "2D points")?;
        data.take(24 * num_points, "an image's 2D points")?;
        images.push(ModelImage {
            cam_from_world: cam_from_world([w, x, y, z], [tx, ty, tz], &name, path)?,
            name,
            camera_id,
        });
    }
    Ok(images)
}

pub(super) fn read_points(path: &Path) -> Result<Vec<SparsePoint>, IoError> {
    let data = read_file(path)?;
    let mut data = Cursor::new(&data, path);
    // id, position, colour, error, length of the track.
    let count = data.count(8 + 24 + 3 + 8 + 8, "points")?;
    let mut points = Vec::with_capacity(count);
    for _ in 0..count {
        data.u64("a point's number")?;
        let mut position = [0.0; 3];
        for coordinate in &mut position {
            *coordinate = data.f64("a point's position")?;
        }
        let rgb = data.take(3, "a point's colour")?;
        let rgb = [rgb[0], rgb[1], rgb[2]];
        data.f64("a point's error")?;
        let num_views = data.count(8, "views of a point")?;
        data.take(8 * num_views, "a point's views")?;
        points.push(point(position, rgb, path)?);
    }
    Ok(points)
}
