//! Backward of the projection: from each item's sums of partial gradients to gradients in the world.

use cubecl::prelude::*;
use host::cube::finite::is_finite;
use host::cube::sums::add_units;
use host::cube::vec3::{Vec3, dot, load, scaled, store, sum, vec3};

use super::body::{
    Placed, SHAPE, placed, quaternion_gradient, quaternion_matrix, sigmoid, unit_quaternion,
};
use super::geometry::{Geometry, Lens, magnitude, project_one};
use super::matrices::{
    Mat3, apply_transposed, load_matrix, mul_transpose3, pose_rotation, store_matrix,
    transpose_mul3,
};
use crate::cpu::GEOMETRIC;

/// Units of a cube.
pub(crate) const TEAM: usize = 128;
/// Numbers of a Gaussian's gradient: of its shape, the statistic of density control, of its colour.
pub(crate) const V_SHAPE: usize = 15;
/// Where the statistic of density control lies among them, and the colour.
pub(crate) const SCREEN: usize = 11;
pub(super) const V_COLOR: usize = 12;
/// Numbers of a moving Gaussian's gradient in a sample: of mean and left rotation.
pub(crate) const V_MOVED: usize = 12;

/// Adds up twelve numbers of each unit of a cube, in a fixed order; the sums begin at `to`.
#[cube]
pub(super) fn add_up(shared: &mut [f32], own: &Array<f32>, sums: &mut [f32], to: usize) {
    let unit = UNIT_POS as usize;
    #[unroll]
    for k in 0..12usize {
        shared[unit * 12 + k] = own[k];
    }
    add_units(shared, TEAM, 12usize);
    if unit < 12 && to + unit < sums.len() {
        sums[to + unit] = shared[unit];
    }
    sync_cube();
}

/// Gradients of an ellipse, mean in pixels.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct EllipseGradient {
    u: f32,
    v: f32,
    e: f32,
    /// Gradient of rho divided by yy.
    rho_over_yy: f32,
    yy: f32,
    depth: f32,
}

/// Gradients of log-scales, point in camera space and R_pose * rotation.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct ShapeGradient {
    log_scale: Vec3,
    point: Vec3,
    in_cam: Mat3,
}

/// For one axis k of the Gaussian: gradients of both rows of the 2D factor, and of its logarithm of the scale.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct AxisGradient {
    a0: f32,
    a1: f32,
    log_scale: f32,
}

#[cube]
fn axis(v: EllipseGradient, rho: f32, d: f32, m1: f32, scale: f32) -> AxisGradient {
    let along = 2.0 * v.e * d;
    let v_m0 = along + v.rho_over_yy * m1;
    let v_m1 = -rho * along + v.rho_over_yy * (d - rho * m1) + 2.0 * v.yy * m1;
    AxisGradient {
        a0: v_m0 * scale,
        a1: v_m1 * scale,
        log_scale: 2.0 * (v.e * d * d + v.rho_over_yy * d * m1 + v.yy * m1 * m1),
    }
}

#[cube]
fn ellipse(lens: Lens, g: Geometry, p: Placed, v: EllipseGradient) -> ShapeGradient {
    let m1 = g.row1;
    let d = g.residual;
    let x = axis(v, g.rho, d.x, m1.x, p.scale.x);
    let y = axis(v, g.rho, d.y, m1.y, p.scale.y);
    let z = axis(v, g.rho, d.z, m1.z, p.scale.z);
    let a0 = vec3(x.a0, y.a0, z.a0);
    let a1 = vec3(x.a1, y.a1, z.a1);
    // a0 = j0 in_cam[0] - j0 tan0 in_cam[2], a1 = j1 in_cam[1] - j1 tan1 in_cam[2].
    let inv_z = 1.0 / g.point.z;
    let j0 = lens.fx * inv_z;
    let j1 = lens.fy * inv_z;
    let j02 = -j0 * g.tan_x;
    let j12 = -j1 * g.tan_y;
    let v_j0 = dot(a0, g.in_cam.x);
    let v_j1 = dot(a1, g.in_cam.y);
    let v_j02 = dot(a0, g.in_cam.z);
    let v_j12 = dot(a1, g.in_cam.z);
    let px = v.u * j0;
    let py = v.v * j1;
    let tx = select(g.inside_x, -j0 * v_j02, 0.0);
    let ty = select(g.inside_y, -j1 * v_j12, 0.0);
    let pz = v.depth
        - (px * (g.point.x * inv_z) + py * (g.point.y * inv_z))
        - (j0 * v_j0 + j1 * v_j1 + j02 * v_j02 + j12 * v_j12) * inv_z
        - tx * g.tan_x * inv_z
        - ty * g.tan_y * inv_z;
    ShapeGradient {
        log_scale: vec3(x.log_scale, y.log_scale, z.log_scale),
        point: vec3(px + tx * inv_z, py + ty * inv_z, pz),
        in_cam: Mat3 {
            x: scaled(a0, j0),
            y: scaled(a1, j1),
            z: sum(scaled(a0, j02), scaled(a1, j12)),
        },
    }
}

/// Euclidean norm that neither overflows nor underflows on the way.
#[cube]
fn norm2(a: f32, b: f32) -> f32 {
    let largest = a.abs().max(b.abs());
    let by = select(largest > 0.0, largest, 1.0);
    let (s, t) = (a / by, b / by);
    select(largest > 0.0, largest * (s * s + t * t).sqrt(), 0.0)
}

#[cube]
fn matrix_magnitude(m: Mat3) -> f32 {
    magnitude(m.x) + magnitude(m.y) + magnitude(m.z)
}

#[cube]
fn row_of_pose(pose: &mut Array<f32>, #[comptime] row: usize, turn: Vec3, shift: f32) {
    pose[comptime!(4 * row)] = turn.x;
    pose[comptime!(4 * row + 1)] = turn.y;
    pose[comptime!(4 * row + 2)] = turn.z;
    pose[comptime!(4 * row + 3)] = shift;
}

/// Gradients of every Gaussian, [N, 15], summed over the samples; of those that move, [n, moving, 12]; of the poses, [n, cubes,
/// 12]. `sums` are what [`super::raster_backward::slot_sums_kernel`] leaves: a Gaussian whose gradient in a sample is larger than
/// f32 can hold gets none from it, where the last of them says so. With `separate`, the means of what moves have gradients only
/// there.
#[cube(launch)]
pub(crate) fn project_backward_kernel(
    lens: Lens,
    shapes: &[f32],
    moved: &[f32],
    poses: &[f32],
    sums: &[f32],
    v_shapes: &mut [f32],
    v_moved: &mut [f32],
    v_poses: &mut [f32],
    moving: usize,
    samples: usize,
    #[comptime] channels: usize,
    #[comptime] wants_poses: bool,
    #[comptime] separate: bool,
) {
    let row = ABSOLUTE_POS;
    let rows = v_shapes.len() / V_SHAPE;
    let width = comptime!(GEOMETRIC + channels + 1);
    let drops = sums[rows * samples * width] != 0.0;
    let cubes = v_poses.len() / (12 * samples);
    let mut shared = Shared::<[f32]>::new_slice(TEAM * 12);
    let mut own = Array::<f32>::new(12usize);
    let mut v_mean = vec3(0.0, 0.0, 0.0);
    let mut v_log_scale = vec3(0.0, 0.0, 0.0);
    let mut v_color = vec3(0.0, 0.0, 0.0);
    let mut v_x = vec3(0.0, 0.0, 0.0);
    let mut v_y = vec3(0.0, 0.0, 0.0);
    let mut v_z = vec3(0.0, 0.0, 0.0);
    let mut s_total = 0.0f32;
    let mut screen_total = 0.0f32;
    for sample in 0..samples {
        #[unroll]
        for k in 0..12usize {
            own[k] = 0.0;
        }
        if row < rows {
            let from = (sample * rows + row) * width;
            let mut left_gradient = Mat3 {
                x: vec3(0.0, 0.0, 0.0),
                y: vec3(0.0, 0.0, 0.0),
                z: vec3(0.0, 0.0, 0.0),
            };
            let mut moved_gradient = vec3(0.0, 0.0, 0.0);
            if sums[from + comptime!(GEOMETRIC + channels)] > 0.0 {
                let p = placed(shapes, moved, sample, row, moving);
                let g = project_one(lens, poses, sample * 12, p);
                let (sp, spp, sp_dy) = (sums[from], sums[from + 1], sums[from + 2]);
                let (s_dy, s_dy_dy, s) = (sums[from + 3], sums[from + 4], sums[from + 5]);
                let mut depth = 0.0f32;
                if comptime!(channels > 3) {
                    depth = sums[from + comptime!(GEOMETRIC + 3)];
                }
                let v = EllipseGradient {
                    u: -(2.0 * g.l11 * sp),
                    v: -(2.0 * (g.l21 * sp + g.l22 * g.l22 * s_dy)),
                    e: -spp / g.e,
                    rho_over_yy: -(2.0 * g.l11 * sp_dy / g.yy),
                    yy: -(0.5 * s_dy_dy / (g.yy * g.yy)),
                    depth,
                };
                let screen = norm2(
                    v.u * 0.5 * lens.width as f32,
                    v.v * 0.5 * lens.height as f32,
                );
                let shape = ellipse(lens, g, p, v);
                let turn = pose_rotation(poses, sample * 12);
                let mean = apply_transposed(turn, shape.point);
                let rotation = transpose_mul3(turn, shape.in_cam);
                let quat_matrix = quaternion_matrix(unit_quaternion(shapes, row));
                let mut v_matrix = rotation;
                let mut v_left = rotation;
                if row < moving {
                    let at = (sample * moving + row) * V_MOVED + 3;
                    v_left = mul_transpose3(rotation, quat_matrix);
                    v_matrix = transpose_mul3(load_matrix(moved, at), rotation);
                }
                if comptime!(wants_poses) {
                    let v_turn = mul_transpose3(shape.in_cam, p.rotation);
                    let x = sum(v_turn.x, scaled(p.mean, shape.point.x));
                    let y = sum(v_turn.y, scaled(p.mean, shape.point.y));
                    let z = sum(v_turn.z, scaled(p.mean, shape.point.z));
                    row_of_pose(&mut own, 0usize, x, shape.point.x);
                    row_of_pose(&mut own, 1usize, y, shape.point.y);
                    row_of_pose(&mut own, 2usize, z, shape.point.z);
                }
                let color = load(sums, from + GEOMETRIC);
                let mut total = s.abs()
                    + screen.abs()
                    + magnitude(mean)
                    + matrix_magnitude(v_matrix)
                    + magnitude(shape.log_scale)
                    + magnitude(color)
                    + matrix_magnitude(v_left);
                #[unroll]
                for k in 0..12usize {
                    total += own[k].abs();
                }
                #[unroll]
                for c in 4..channels {
                    total += sums[from + comptime!(GEOMETRIC + c)].abs();
                }
                if is_finite(total) || !drops {
                    if row < moving {
                        moved_gradient = mean;
                        left_gradient = v_left;
                    }
                    if comptime!(!separate) || row >= moving {
                        v_mean = sum(v_mean, mean);
                    }
                    v_x = sum(v_x, v_matrix.x);
                    v_y = sum(v_y, v_matrix.y);
                    v_z = sum(v_z, v_matrix.z);
                    v_log_scale = sum(v_log_scale, shape.log_scale);
                    v_color = sum(v_color, color);
                    s_total += s;
                    screen_total += screen;
                } else {
                    #[unroll]
                    for k in 0..12usize {
                        own[k] = 0.0;
                    }
                }
            }
            if row < moving {
                let to = (sample * moving + row) * V_MOVED;
                store(v_moved, to, moved_gradient);
                store_matrix(v_moved, to + 3, left_gradient);
            }
        }
        if comptime!(wants_poses) {
            add_up(&mut shared, &own, v_poses, (sample * cubes + CUBE_POS) * 12);
        }
    }
    if row < rows {
        let to = row * V_SHAPE;
        let v_matrix = Mat3 {
            x: v_x,
            y: v_y,
            z: v_z,
        };
        let quat = quaternion_gradient(unit_quaternion(shapes, row), v_matrix);
        store(v_shapes, to, v_mean);
        v_shapes[to + 3] = quat.w;
        store(v_shapes, to + 4, quat.v);
        store(v_shapes, to + 7, v_log_scale);
        // s is -∂L/∂alpha · alpha, and ∂alpha/∂logit = alpha (1 - opacity).
        v_shapes[to + 10] = -s_total * sigmoid(-shapes[row * SHAPE + 10]);
        v_shapes[to + SCREEN] = screen_total;
        store(v_shapes, to + V_COLOR, v_color);
    }
}

/// The sum of the cubes' parts of each of `sums` twelve numbers, [n, cubes, 12]: a cube for each of the n. Nothing is left where a
/// sum is larger than f32 can hold and `flags` say that it is dropped.
#[cube(launch)]
pub(crate) fn poses_kernel(parts: &[f32], flags: &[f32], sums: &mut [f32]) {
    let sample = CUBE_POS;
    let samples = sums.len() / 12;
    let cubes = parts.len() / (12 * samples);
    let mut own = Array::<f32>::new(12usize);
    #[unroll]
    for k in 0..12usize {
        own[k] = 0.0;
    }
    let mut cube = UNIT_POS as usize;
    while cube < cubes {
        if sample < samples {
            #[unroll]
            for k in 0..12usize {
                own[k] += parts[(sample * cubes + cube) * 12 + k];
            }
        }
        cube += TEAM;
    }
    let mut shared = Shared::<[f32]>::new_slice(TEAM * 12);
    add_up(&mut shared, &own, sums, sample * 12);
    let mut total = 0.0f32;
    #[unroll]
    for k in 0..12usize {
        total += shared[k].abs();
    }
    if !is_finite(total) && flags[0] != 0.0 && UNIT_POS < 12 && sample < samples {
        sums[sample * 12 + UNIT_POS as usize] = 0.0;
    }
}
