//! The way back of [`super::moved`].

use cubecl::prelude::*;

use super::frame::{frame, frame_backward};
use super::moved::{BASIS, blended, row_x, row_y, row_z};
use host::cube::sums::add_units;
use host::cube::vec3::{load, scaled, store, sum, vec3};

/// Gradients of each Gaussian's logits and mean, and that of its blend at every moment, [F, T, 9]: a unit for every Gaussian.
#[cube(launch)]
pub(crate) fn rows_backward_kernel(
    weights: &[f32],
    bases: &[f32],
    means: &[f32],
    gradient: &[f32],
    blends: &mut [f32],
    v_logits: &mut [f32],
    v_means: &mut [f32],
    #[comptime] count: usize,
) {
    let rows = means.len() / 3;
    let moments = bases.len() / (BASIS * count);
    let row = ABSOLUTE_POS;
    if row < rows {
        let mean = load(means, row * 3);
        let mut v_mean = vec3(0.0, 0.0, 0.0);
        for b in 0..count {
            v_logits[row * count + b] = 0.0;
        }
        for moment in 0..moments {
            let blend = blended(weights, bases, row, moment, moments, count);
            let f = frame(blend.first, blend.second);
            let (rx, ry, rz) = (row_x(f), row_y(f), row_z(f));
            let unit = moment * rows + row;
            let moved = load(gradient, unit * 3);
            let at = moments * rows * 3 + unit * 9;
            v_mean = sum(v_mean, scaled(rx, moved.x));
            v_mean = sum(v_mean, scaled(ry, moved.y));
            v_mean = sum(v_mean, scaled(rz, moved.z));
            // Of the rotation, row by row.
            let gx = sum(load(gradient, at), scaled(mean, moved.x));
            let gy = sum(load(gradient, at + 3), scaled(mean, moved.y));
            let gz = sum(load(gradient, at + 6), scaled(mean, moved.z));
            let six = frame_backward(
                f,
                vec3(gx.x, gy.x, gz.x),
                vec3(gx.y, gy.y, gz.y),
                vec3(gx.z, gy.z, gz.z),
            );
            let to = (row * moments + moment) * BASIS;
            store(blends, to, six.first);
            store(blends, to + 3, six.second);
            store(blends, to + 6, moved);
            for b in 0..count {
                let from = (b * moments + moment) * BASIS;
                let mut v_weight = 0.0f32;
                #[unroll]
                for c in 0..BASIS {
                    v_weight += bases[from + c] * blends[to + c];
                }
                v_logits[row * count + b] += v_weight;
            }
        }
        store(v_means, row * 3, v_mean);
        // Through the softmax.
        let mut expected = 0.0f32;
        for b in 0..count {
            expected += weights[row * count + b] * v_logits[row * count + b];
        }
        for b in 0..count {
            let at = row * count + b;
            v_logits[at] = weights[at] * (v_logits[at] - expected);
        }
    }
}

/// Gaussians that add up what they give a basis at a moment, side by side.
pub(crate) const TEAM: usize = 128;

/// Gradient of the bases, [B, T, 9]: a cube of [`TEAM`] units for each basis and moment. The sum has a fixed order.
#[cube(launch)]
pub(crate) fn bases_backward_kernel(
    weights: &[f32],
    blends: &[f32],
    v_bases: &mut [f32],
    #[comptime] count: usize,
) {
    let rows = weights.len() / count;
    let moments = v_bases.len() / (BASIS * count);
    let basis = CUBE_POS / moments;
    let moment = CUBE_POS % moments;
    let unit = UNIT_POS as usize;
    let mut sums = Array::<f32>::new(BASIS);
    #[unroll]
    for c in 0..BASIS {
        sums[c] = 0.0;
    }
    let mut row = unit;
    while row < rows {
        let weight = weights[row * count + basis];
        let from = (row * moments + moment) * BASIS;
        #[unroll]
        for c in 0..BASIS {
            sums[c] += weight * blends[from + c];
        }
        row += TEAM;
    }
    let mut shared = Shared::<[f32]>::new_slice(TEAM * BASIS);
    #[unroll]
    for c in 0..BASIS {
        shared[unit * BASIS + c] = sums[c];
    }
    add_units(&mut shared, TEAM, BASIS);
    if basis < count && unit < BASIS {
        v_bases[CUBE_POS * BASIS + unit] = shared[unit];
    }
}
