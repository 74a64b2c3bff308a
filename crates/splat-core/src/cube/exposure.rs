//! Between pictures and light: the mean of samples, and the tables of gradients that the blending's way back reads.

use cubecl::prelude::*;
use host::cube::finite::is_finite;

use super::raster::STATE;
use super::raster_backward::pixel_width;
use crate::cpu::{KNEE, LARGEST, TOE};

/// How values stand for light; see [`crate::cpu::Transfer`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Curve {
    Srgb,
    Power,
    Linear,
}

/// Light of a value that is not negative, and the slope there.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Light {
    light: f32,
    slope: f32,
}

/// u^(2/5) for u of 0.04 to 10, to the last places.
#[cube]
fn two_fifths(u: f32) -> f32 {
    let fourth = u.sqrt().sqrt();
    // u^(3/8) is within 9 %. A step of Halley's for y⁵ = u² leaves 2 e³ of a relative error e.
    let mut y = fourth * fourth.sqrt();
    let square = u * u;
    #[unroll]
    for _ in 0..2 {
        let y2 = y * y;
        let y5 = y2 * y2 * y;
        y *= (2.0 * y5 + 3.0 * square) / (3.0 * y5 + 2.0 * square);
    }
    y
}

#[cube]
fn decode(value: f32, gamma: f32, #[comptime] curve: Curve) -> Light {
    let toe = comptime!(TOE as f32);
    let inside = value.min(comptime!(KNEE as f32));
    let over = value.min(comptime!(LARGEST as f32)) - inside;
    let mut light = value;
    let mut slope = 1.0f32;
    if comptime!(curve == Curve::Srgb) {
        let u = (inside + 0.055) / 1.055;
        let root = two_fifths(u);
        let steep = comptime!((2.4 / 1.055) as f32) * u * root;
        light = select(value < toe, value / 12.92, u * u * root + steep * over);
        slope = select(value < toe, comptime!((1.0 / 12.92) as f32), steep);
    }
    if comptime!(curve == Curve::Power) {
        let start = power(toe, gamma - 1.0);
        let steep = gamma * power(inside.max(toe), gamma - 1.0);
        light = select(
            value < toe,
            value * start,
            inside * steep / gamma + steep * over,
        );
        slope = select(value < toe, start, steep);
    }
    Light { light, slope }
}

#[cube]
fn power(value: f32, exponent: f32) -> f32 {
    (value.ln() * exponent).exp()
}

/// The value of a light that is not negative.
#[cube]
fn encode(light: f32, gamma: f32, #[comptime] curve: Curve) -> f32 {
    let toe = comptime!(TOE as f32);
    let knee = decode(comptime!(KNEE as f32), gamma, curve);
    let over = (light - light.min(knee.light)) / knee.slope;
    let mut value = light;
    if comptime!(curve == Curve::Srgb) {
        let start = comptime!((TOE / 12.92) as f32);
        let curved = power(
            light.min(knee.light).max(start),
            comptime!((1.0 / 2.4) as f32),
        );
        value = select(light < start, 12.92 * light, 1.055 * curved - 0.055 + over);
    }
    if comptime!(curve == Curve::Power) {
        let start = power(toe, gamma);
        let curved = power(light.min(knee.light).max(start), 1.0 / gamma);
        value = select(
            light < start,
            power(toe, 1.0 - gamma) * light,
            curved + over,
        );
    }
    value
}

/// The mean light of the samples' pictures [n, H, W, 3], as values.
#[cube(launch)]
pub(crate) fn mean_kernel(
    samples: &[f32],
    picture: &mut [f32],
    weight: f32,
    gamma: f32,
    #[comptime] curve: Curve,
) {
    let at = ABSOLUTE_POS;
    let count = picture.len();
    if at < count {
        let mut light = 0.0f32;
        for sample in 0..samples.len() / count {
            light += weight * decode(samples[sample * count + at], gamma, curve).light;
        }
        picture[at] = encode(light, gamma, curve);
    }
}

/// The table of gradients of every pixel of every sample, [n, H, W, 6], from that of the picture.
#[cube(launch)]
pub(crate) fn sample_gradients_kernel(
    samples: &[f32],
    picture: &[f32],
    gradient: &[f32],
    state: &[f32],
    pixels: &mut [f32],
    weight: f32,
    gamma: f32,
    #[comptime] curve: Curve,
) {
    let at = ABSOLUTE_POS;
    if at < state.len() / STATE {
        let to = at * comptime!(pixel_width(3));
        let pixel = at % (picture.len() / 3);
        pixels[to] = state[at * STATE];
        pixels[to + 1] = state[at * STATE + 1];
        pixels[to + 2] = 0.0;
        #[unroll]
        for c in 0..3usize {
            let light = gradient[pixel * 3 + c] * weight
                / decode(picture[pixel * 3 + c], gamma, curve).slope;
            pixels[to + 3 + c] = light * decode(samples[at * 3 + c], gamma, curve).slope;
        }
    }
}

/// The table of gradients of every pixel, [H, W, 3 + C], from that of a render [H, W, 1 + C].
#[cube(launch)]
pub(crate) fn pixel_gradients_kernel(
    gradient: &[f32],
    state: &[f32],
    pixels: &mut [f32],
    #[comptime] channels: usize,
) {
    let at = ABSOLUTE_POS;
    if at < state.len() / STATE {
        let to = at * comptime!(pixel_width(channels));
        let from = at * comptime!(1 + channels);
        pixels[to] = state[at * STATE];
        pixels[to + 1] = state[at * STATE + 1];
        pixels[to + 2] = gradient[from + 3];
        #[unroll]
        for c in 0..3usize {
            pixels[to + 3 + c] = gradient[from + c];
        }
        #[unroll]
        for c in 3..channels {
            pixels[to + 3 + c] = gradient[from + 1 + c];
        }
    }
}

/// Sets `flags` [1] to 0 where a value is not finite; it finds 1.
#[cube(launch)]
pub(crate) fn finite_kernel(values: &[f32], flags: &[Atomic<u32>]) {
    let at = ABSOLUTE_POS;
    if at < values.len() && !is_finite(values[at]) {
        flags[0usize].store(0u32);
    }
}
