//! Colours of Gaussians: spherical harmonics in the direction from the camera's centre, and their way back.

use cubecl::prelude::*;
use host::cube::finite::is_finite;
use host::cube::vec3::{Vec3, dot, load, store, sum, vec3};

use super::body::SHAPE;
use super::geometry::view_direction;
use super::project_backward::{TEAM, V_COLOR, V_SHAPE, add_up};
use super::sh::{BASIS, basis, direction_gradient};

/// SH + 0.5 per channel, before the clamp at 0.
#[cube]
fn sh_color(sh: &[f32], at: usize, values: &Array<f32>, #[comptime] used: usize) -> Vec3 {
    let mut color = vec3(0.5, 0.5, 0.5);
    #[unroll]
    for b in 0..used {
        let value = values[b];
        color.x += value * sh[at + 3 * b];
        color.y += value * sh[at + 3 * b + 1];
        color.z += value * sh[at + 3 * b + 2];
    }
    color
}

/// Colour of every Gaussian, [N, 3], seen from the centre of `pose`; `stored` coefficients a channel.
#[cube(launch)]
pub(crate) fn colors_kernel(
    shapes: &[f32],
    sh: &[f32],
    pose: &[f32],
    colors: &mut [f32],
    #[comptime] degree: usize,
    #[comptime] stored: usize,
) {
    let row = ABSOLUTE_POS;
    if row < colors.len() / 3 {
        let mut values = Array::<f32>::new(BASIS);
        let towards = view_direction(pose, load(shapes, row * SHAPE));
        basis(&mut values, towards.unit, degree);
        let used = comptime!((degree + 1) * (degree + 1));
        let color = sh_color(sh, row * stored * 3, &values, used);
        store(
            colors,
            row * 3,
            vec3(color.x.max(0.0), color.y.max(0.0), color.z.max(0.0)),
        );
    }
}

/// Back through the colours. Each Gaussian's gradient of its colour lies in `v_shapes`, whose means get what comes through the
/// direction; `v_pose` is [cubes, 12]. A Gaussian whose gradient is larger than f32 can hold gets none, where `drops` says so.
#[cube(launch)]
pub(crate) fn colors_backward_kernel(
    shapes: &[f32],
    sh: &[f32],
    pose: &[f32],
    v_shapes: &mut [f32],
    v_sh: &mut [f32],
    v_pose: &mut [f32],
    drops: &[f32],
    #[comptime] degree: usize,
    #[comptime] stored: usize,
) {
    let rows = v_shapes.len() / V_SHAPE;
    let row = ABSOLUTE_POS;
    let used = comptime!((degree + 1) * (degree + 1));
    let mut own = Array::<f32>::new(12usize);
    #[unroll]
    for k in 0..12 {
        own[k] = 0.0;
    }
    if row < rows {
        let mut values = Array::<f32>::new(BASIS);
        let mut weights = Array::<f32>::new(BASIS);
        let towards = view_direction(pose, load(shapes, row * SHAPE));
        basis(&mut values, towards.unit, degree);
        let from = row * stored * 3;
        let color = sh_color(sh, from, &values, used);
        let given = load(&*v_shapes, row * V_SHAPE + V_COLOR);
        // Where a colour was clamped at zero, nothing passes.
        let v = vec3(
            select(color.x > 0.0, given.x, 0.0),
            select(color.y > 0.0, given.y, 0.0),
            select(color.z > 0.0, given.z, 0.0),
        );
        #[unroll]
        for b in 0..used {
            weights[b] = dot(load(sh, from + 3 * b), v);
        }
        let unit = towards.unit;
        let v_unit = direction_gradient(&weights, unit, degree);
        let along = dot(v_unit, unit);
        let v_direction = vec3(
            (v_unit.x - unit.x * along) / towards.length,
            (v_unit.y - unit.y * along) / towards.length,
            (v_unit.z - unit.z * along) / towards.length,
        );
        // Of the pose: the centre is -Rᵀ t.
        #[unroll]
        for i in 0..3usize {
            let shift = pose[4 * i + 3];
            own[4 * i] = shift * v_direction.x;
            own[4 * i + 1] = shift * v_direction.y;
            own[4 * i + 2] = shift * v_direction.z;
            own[4 * i + 3] = dot(load(pose, 4 * i), v_direction);
        }
        let mean = sum(load(&*v_shapes, row * V_SHAPE), v_direction);
        store(v_shapes, row * V_SHAPE, mean);
        // A basis function is under 4.
        let mut total = 4.0 * (v.x.abs() + v.y.abs() + v.z.abs());
        #[unroll]
        for k in 0..V_SHAPE {
            total += v_shapes[row * V_SHAPE + k].abs();
        }
        #[unroll]
        for k in 0..12 {
            total += own[k].abs();
        }
        let kept = is_finite(total) || drops[0] == 0.0;
        if !kept {
            #[unroll]
            for k in 0..V_SHAPE {
                v_shapes[row * V_SHAPE + k] = 0.0;
            }
            #[unroll]
            for k in 0..12 {
                own[k] = 0.0;
            }
        }
        #[unroll]
        for b in 0..stored {
            let mut out = vec3(0.0, 0.0, 0.0);
            if comptime!(b < used) && kept {
                out = vec3(values[b] * v.x, values[b] * v.y, values[b] * v.z);
            }
            store(v_sh, from + 3 * b, out);
        }
    }
    let mut shared = Shared::<[f32]>::new_slice(TEAM * 12);
    add_up(&mut shared, &own, v_pose, CUBE_POS * 12);
}
