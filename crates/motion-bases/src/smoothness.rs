//! Smoothness of the motion, in units of a scene scale that the caller gives: the terms of Shape of Motion (Wang et al. 2024),
//! which the method keeps.

use crate::motion::MotionBases;
use burn::tensor::{Tensor, TensorData};
use glam::DVec3;

/// Lengths under this (relative to the scene scale) have no direction, hence no gradient: the naive
/// gradient of a norm at rest is NaN.
pub(crate) const REST: f64 = 1e-6;

/// Weight of the translations beside the 6D vectors in [`bases_acceleration`].
pub(crate) const TRANSLATION_WEIGHT: f64 = 2.0;

/// Acceleration of the bases, `[1]`: the mean length of the second differences over time of the 6D
/// vectors, plus twice that of the translations divided by `scene_scale`.
///
/// Zero for fewer than three frames. At rest it is zero and has a gradient of zero.
#[must_use]
pub fn bases_acceleration(bases: &MotionBases, scene_scale: f64) -> Tensor<1> {
    if bases.num_frames < 3 || bases.num_bases() == 0 {
        return zero_like(&bases.rots);
    }
    let inner = bases.num_frames - 2;
    let rows = bases.num_bases() * inner;
    let mean_acceleration = |frames: Tensor<2>, width: usize| {
        let from = |t: usize| frames.clone().slice_dim(1, width * t..width * (t + inner));
        let acceleration = from(1) * 2.0 - from(0) - from(2);
        mean_length(acceleration.reshape([rows, width]).square().sum_dim(1))
    };
    mean_acceleration(bases.rots.clone(), 6)
        + mean_acceleration(bases.transls.clone() / scene_scale, 3) * TRANSLATION_WEIGHT
}

/// Acceleration of means, `[1]`: the mean length of their second differences, divided by `scene_scale`.
///
/// `[prev, cur, next]` are [F, 3], the means in three consecutive frames. (The factor 0.5
/// of the reference code belongs to the weight.) Zero without Gaussians; at rest the gradient is zero.
#[must_use]
pub fn means_acceleration([prev, cur, next]: [&Tensor<2>; 3], scene_scale: f64) -> Tensor<1> {
    if cur.dims()[0] == 0 {
        return zero_like(cur);
    }
    let acceleration = (cur.clone() * 2.0 - prev.clone() - next.clone()) / scene_scale;
    mean_length(acceleration.square().sum_dim(1))
}

/// Motion along the viewing ray, `[1]`: the mean square of the steps from `prev` to `cur` and from
/// `cur` to `next`, projected on the ray from the camera's centre to `cur`, divided by `scene_scale`.
///
/// `[prev, cur, next]` are means [F, 3]. Depth from one view is the least certain coordinate,
/// and this keeps it from jittering. Zero without Gaussians.
#[must_use]
pub fn along_ray(
    [prev, cur, next]: [&Tensor<2>; 3],
    camera_center: DVec3,
    scene_scale: f64,
) -> Tensor<1> {
    if cur.dims()[0] == 0 {
        return zero_like(cur);
    }
    let center = Tensor::<2>::from_data(
        TensorData::new(camera_center.to_array().to_vec(), [1, 3]),
        (&cur.device(), cur.dtype()),
    );
    let ray = (cur.clone() - center) / scene_scale;
    let length = ray
        .clone()
        .square()
        .sum_dim(1)
        .clamp_min(REST * REST)
        .sqrt();
    let direction = ray / length;
    let along = |step: Tensor<2>| {
        (step * direction.clone() / scene_scale)
            .sum_dim(1)
            .square()
            .mean()
    };
    along(cur.clone() - prev.clone()) + along(next.clone() - cur.clone())
}

/// Mean length of vectors, given the squares of their lengths: zero up to [`REST`], with a gradient
/// of zero there, and less by [`REST`] above.
fn mean_length(squares: Tensor<2>) -> Tensor<1> {
    (squares.clamp_min(REST * REST).sqrt() - REST).mean()
}

pub(crate) fn zero_like(tensor: &Tensor<2>) -> Tensor<1> {
    Tensor::zeros([1], (&tensor.device(), tensor.dtype()))
}
