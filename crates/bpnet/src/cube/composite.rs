//! What the camera saw, and the way back; the formulas are in [`crate::cpu::composite`].
//!
//! A unit works on a pixel, forward and back. The image's gradient has the form of a gather: a pixel asks the neighbours whose
//! windows it lies in.

use cubecl::prelude::*;
use host::cube::vec3::{Vec3, dot, load, scaled, store, sum, vec3};

use crate::cpu::composite::{CHANNELS, LEAST_SUM};

const LEAST: f32 = LEAST_SUM as f32;

/// Numbers of a pixel that the image's gradient is gathered from: what its windows' colours get, and its own colour's share.
pub(crate) const GATHERED: usize = 4;

/// Sums over the kernel of a pixel.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Window {
    /// Σ k I / s over the weights inside the image, or the pixel's own colour.
    mean: Vec3,
    /// s, or 0 where it is too small.
    inside: f32,
    /// Σ k Δ.
    x: f32,
    y: f32,
}

/// The kernel of a pixel at `first`, applied around (y, x). The order of the sums is that of the CPU.
#[cube]
fn window(
    image: &[f32],
    field: &[f32],
    first: usize,
    y: usize,
    x: usize,
    size: Size,
    #[comptime] kernel: usize,
) -> Window {
    let half = comptime!(kernel / 2);
    let mut total = vec3(0.0, 0.0, 0.0);
    let mut inside = 0.0f32;
    let mut shift_x = 0.0f32;
    let mut shift_y = 0.0f32;
    for kx in 0..kernel {
        let mut column = vec3(0.0, 0.0, 0.0);
        let mut column_inside = 0.0f32;
        let mut weights = 0.0f32;
        let mut vertical = 0.0f32;
        for ky in 0..kernel {
            let weight = field[first + ky * kernel + kx];
            if size.holds(y + ky, x + kx, half) {
                let at = (y + ky - half) * size.width + x + kx - half;
                column = sum(column, scaled(load(image, at * 3), weight));
                column_inside += weight;
            }
            weights += weight;
            vertical += weight * offset(ky, half);
        }
        total = sum(total, column);
        inside += column_inside;
        shift_x += weights * offset(kx, half);
        shift_y += vertical;
    }
    let drawn = inside >= LEAST;
    let own = load(image, (y * size.width + x) * 3);
    // Not a number stays one.
    let none = inside < LEAST;
    let divisor = select(drawn, inside, 1.0);
    Window {
        mean: vec3(
            select(none, own.x, total.x / divisor),
            select(none, own.y, total.y / divisor),
            select(none, own.z, total.z / divisor),
        ),
        inside: select(none, 0.0, inside),
        x: shift_x,
        y: shift_y,
    }
}

/// Height and width of a picture.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Size {
    height: usize,
    width: usize,
}

#[cube]
impl Size {
    /// Whether a place counted from `half` pixels before the first one is a pixel's.
    fn holds(self, y: usize, x: usize, half: usize) -> bool {
        y >= half && x >= half && y < self.height + half && x < self.width + half
    }
}

/// Distance of column or row `k` of a window from its centre, px.
#[cube]
fn offset(k: usize, half: usize) -> f32 {
    k as f32 - half as f32
}

#[cube(launch)]
pub(crate) fn composite_kernel(
    image: &[f32],
    field: &[f32],
    output: &mut [f32],
    height: usize,
    width: usize,
    #[comptime] kernel: usize,
) {
    let pixel = ABSOLUTE_POS;
    if pixel < height * width {
        let size = Size { height, width };
        let entries = comptime!(kernel * kernel);
        let first = pixel * comptime!(kernel * kernel + 1);
        let w = window(
            image,
            field,
            first,
            pixel / width,
            pixel % width,
            size,
            kernel,
        );
        let own = load(image, pixel * 3);
        let m = field[first + entries];
        let to = pixel * CHANNELS;
        output[to] = mixed(own.x, w.mean.x, m);
        output[to + 1] = mixed(own.y, w.mean.y, m);
        output[to + 2] = mixed(own.z, w.mean.z, m);
        output[to + 3] = m * w.x;
        output[to + 4] = m * w.y;
        output[to + 5] = field[first + comptime!(kernel * kernel / 2)];
        output[to + 6] = m;
    }
}

/// Exact at both ends, and where blurred and sharp agree.
#[cube]
fn mixed(sharp: f32, blurred: f32, m: f32) -> f32 {
    let way = blurred - sharp;
    select(m < 0.5, sharp + m * way, blurred - (1.0 - m) * way)
}

/// Gradient of the field where it is wanted, and what [`image_kernel`] gathers, `[H, W, 4]`.
#[cube(launch)]
pub(crate) fn field_kernel(
    image: &[f32],
    field: &[f32],
    gradient: &[f32],
    gathered: &mut [f32],
    v_field: &mut [f32],
    height: usize,
    width: usize,
    #[comptime] kernel: usize,
    #[comptime] wanted: bool,
) {
    let pixel = ABSOLUTE_POS;
    if pixel < height * width {
        let size = Size { height, width };
        let half = comptime!(kernel / 2);
        let entries = comptime!(kernel * kernel);
        let first = pixel * comptime!(kernel * kernel + 1);
        let (y, x) = (pixel / width, pixel % width);
        let w = window(image, field, first, y, x, size, kernel);
        let m = field[first + entries];
        let at = pixel * CHANNELS;
        let g = load(gradient, at);
        let drawn = w.inside > 0.0;
        let divisor = select(drawn, w.inside, 1.0);
        let of_mean = vec3(
            select(drawn, m * g.x / divisor, 0.0),
            select(drawn, m * g.y / divisor, 0.0),
            select(drawn, m * g.z / divisor, 0.0),
        );
        store(gathered, pixel * GATHERED, of_mean);
        gathered[pixel * GATHERED + 3] = select(drawn, 1.0 - m, 1.0);
        if comptime!(wanted) {
            let level = dot(of_mean, w.mean);
            let across = m * gradient[at + 3];
            let down = m * gradient[at + 4];
            for ky in 0..kernel {
                let vertical = down * offset(ky, half);
                for kx in 0..kernel {
                    let mut value = across * offset(kx, half) + vertical;
                    if size.holds(y + ky, x + kx, half) {
                        let from = (y + ky - half) * width + x + kx - half;
                        value += dot(of_mean, load(image, from * 3)) - level;
                    }
                    v_field[first + ky * kernel + kx] = value;
                }
            }
            v_field[first + comptime!(kernel * kernel / 2)] += gradient[at + 5];
            let own = load(image, pixel * 3);
            let way = vec3(w.mean.x - own.x, w.mean.y - own.y, w.mean.z - own.z);
            v_field[first + entries] =
                gradient[at + 3] * w.x + gradient[at + 4] * w.y + gradient[at + 6] + dot(g, way);
        }
    }
}

/// Gradient of the image, gathered from the pixels around.
#[cube(launch)]
pub(crate) fn image_kernel(
    field: &[f32],
    gradient: &[f32],
    gathered: &[f32],
    v_image: &mut [f32],
    height: usize,
    width: usize,
    #[comptime] kernel: usize,
) {
    let pixel = ABSOLUTE_POS;
    if pixel < height * width {
        let size = Size { height, width };
        let half = comptime!(kernel / 2);
        let entries = comptime!(kernel * kernel);
        let (y, x) = (pixel / width, pixel % width);
        let own = load(gradient, pixel * CHANNELS);
        let mut total = scaled(own, gathered[pixel * GATHERED + 3]);
        // The neighbour on one side sees the pixel on the other: at entry `entries - 1 - j`.
        for ky in 0..kernel {
            for kx in 0..kernel {
                if size.holds(y + ky, x + kx, half) {
                    let from = (y + ky - half) * width + x + kx - half;
                    let entry = entries - 1 - (ky * kernel + kx);
                    let weight = field[from * (entries + 1) + entry];
                    total = sum(total, scaled(load(gathered, from * GATHERED), weight));
                }
            }
        }
        store(v_image, pixel * 3, total);
    }
}
