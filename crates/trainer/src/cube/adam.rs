//! The update of Adam, as [`crate::cpu::adam`] has it.

use cubecl::prelude::*;

use crate::cpu::adam::{BETAS, EPSILON, LARGEST_GRADIENT, SMALLEST_FIRST, SMALLEST_SECOND};

const DECAY: [f32; 2] = [BETAS[0] as f32, BETAS[1] as f32];
const SHARE: [f32; 2] = [(1.0 - BETAS[0]) as f32, (1.0 - BETAS[1]) as f32];
const ROOT_FLOOR: f32 = EPSILON as f32;
const LIMIT: f32 = LARGEST_GRADIENT as f32;
const LEAST_FIRST: f32 = SMALLEST_FIRST as f32;
const LEAST_SECOND: f32 = SMALLEST_SECOND as f32;

/// Which elements of a parameter [N, C] step, and how far.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Window {
    /// So many rows from this one on.
    pub(crate) first_row: u32,
    pub(crate) rows: u32,
    /// C.
    pub(crate) columns: u32,
    /// The columns [from, to); those below `split` have the first rate, the others the second.
    pub(crate) from: u32,
    pub(crate) split: u32,
    pub(crate) to: u32,
    pub(crate) first_rate: f32,
    pub(crate) second_rate: f32,
    /// 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t).
    pub(crate) first_correction: f32,
    pub(crate) second_correction: f32,
}

/// One step, in place: a unit for every element of the window.
#[cube(launch)]
pub(crate) fn adam_kernel(
    parameter: &mut [f32],
    gradient: &[f32],
    moment1: &mut [f32],
    moment2: &mut [f32],
    window: Window,
) {
    let width = (window.to - window.from) as usize;
    let unit = ABSOLUTE_POS;
    if unit < window.rows as usize * width {
        let column = window.from as usize + unit % width;
        let row = window.first_row as usize + unit / width;
        let at = row * window.columns as usize + column;
        let rate = select(
            column < window.split as usize,
            window.first_rate,
            window.second_rate,
        );
        let g = gradient[at];
        let g = select(g > LIMIT, LIMIT, g);
        let g = select(g < -LIMIT, -LIMIT, g);
        let m = DECAY[0] * moment1[at] + SHARE[0] * g;
        let v = DECAY[1] * moment2[at] + SHARE[1] * (g * g);
        let m = select(m.abs() < LEAST_FIRST, 0.0, m);
        let v = select(v < LEAST_SECOND, 0.0, v);
        moment1[at] = m;
        moment2[at] = v;
        let root = v.sqrt() * window.second_correction + ROOT_FLOOR;
        parameter[at] -= rate * (m * window.first_correction / root);
    }
}
