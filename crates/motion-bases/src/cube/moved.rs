//! Where Gaussians are at several moments: bases blended by softmax weights, a rotation made of the blend, a mean moved.

use cubecl::prelude::*;

use super::frame::{Frame, frame};
use host::cube::vec3::{Vec3, dot, load, store, vec3};

/// Numbers of a basis at a moment: a 6D vector and a translation.
pub(crate) const BASIS: usize = 9;

/// The softmax weights of every Gaussian, [F, B], from logits of the same shape.
#[cube(launch)]
pub(crate) fn weights_kernel(logits: &[f32], weights: &mut [f32], #[comptime] bases: usize) {
    let row = ABSOLUTE_POS;
    if row < logits.len() / bases {
        let first = row * bases;
        let mut largest = logits[first];
        for b in 1..bases {
            largest = largest.max(logits[first + b]);
        }
        let mut total = 0.0f32;
        for b in 0..bases {
            let weight = (logits[first + b] - largest).exp();
            weights[first + b] = weight;
            total += weight;
        }
        for b in 0..bases {
            weights[first + b] /= total;
        }
    }
}

/// A blend of bases at a moment: two vectors that make a rotation, and a translation.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Blend {
    pub(crate) first: Vec3,
    pub(crate) second: Vec3,
    pub(crate) translation: Vec3,
}

/// The bases of a Gaussian at a moment, blended; `bases` are [B, T, 9], `weights` [F, B].
#[cube]
pub(crate) fn blended(
    weights: &[f32],
    bases: &[f32],
    row: usize,
    moment: usize,
    moments: usize,
    #[comptime] count: usize,
) -> Blend {
    let mut sums = Array::<f32>::new(BASIS);
    #[unroll]
    for c in 0..BASIS {
        sums[c] = 0.0;
    }
    for b in 0..count {
        let weight = weights[row * count + b];
        let at = (b * moments + moment) * BASIS;
        #[unroll]
        for c in 0..BASIS {
            sums[c] += weight * bases[at + c];
        }
    }
    Blend {
        first: vec3(sums[0], sums[1], sums[2]),
        second: vec3(sums[3], sums[4], sums[5]),
        translation: vec3(sums[6], sums[7], sums[8]),
    }
}

/// Rows of the rotation.
#[cube]
pub(crate) fn row_x(f: Frame) -> Vec3 {
    vec3(f.x.x, f.y.x, f.z.x)
}
#[cube]
pub(crate) fn row_y(f: Frame) -> Vec3 {
    vec3(f.x.y, f.y.y, f.z.y)
}
#[cube]
pub(crate) fn row_z(f: Frame) -> Vec3 {
    vec3(f.x.z, f.y.z, f.z.z)
}

/// Means [T, F, 3] and behind them rotations [T, F, 3, 3], a unit for every Gaussian at every moment.
#[cube(launch)]
pub(crate) fn moved_kernel(
    weights: &[f32],
    bases: &[f32],
    means: &[f32],
    output: &mut [f32],
    #[comptime] count: usize,
) {
    let rows = means.len() / 3;
    let moments = bases.len() / (BASIS * count);
    let unit = ABSOLUTE_POS;
    if unit < moments * rows {
        let row = unit % rows;
        let moment = unit / rows;
        let blend = blended(weights, bases, row, moment, moments, count);
        let f = frame(blend.first, blend.second);
        let mean = load(means, row * 3);
        let (rx, ry, rz) = (row_x(f), row_y(f), row_z(f));
        output[unit * 3] = dot(rx, mean) + blend.translation.x;
        output[unit * 3 + 1] = dot(ry, mean) + blend.translation.y;
        output[unit * 3 + 2] = dot(rz, mean) + blend.translation.z;
        let at = moments * rows * 3 + unit * 9;
        store(output, at, rx);
        store(output, at + 3, ry);
        store(output, at + 6, rz);
    }
}
