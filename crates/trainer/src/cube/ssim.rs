//! Mean absolute difference, SSIM and their gradient, as [`crate::cpu::ssim`] has them.
//!
//! A cube has a tile of a channel: it loads the tile with the window's half-width around it once, convolves down its columns,
//! then along its rows.

use cubecl::prelude::*;

use super::reduce::{TEAM, total};
use crate::cpu::ssim::{C1, C2, CHANNELS, TAPS, WINDOW_EDGE, window};

/// Pixels of a tile's side, a unit for each pixel.
const TILE: usize = 16;

/// Those with the window's half-width on either side.
const SPAN: usize = TILE + 2 * WINDOW_EDGE;

const AROUND: usize = SPAN * SPAN;

/// What is convolved down its columns only.
const DOWN: usize = TILE * SPAN;

const FIRST: f32 = C1 as f32;
const SECOND: f32 = C2 as f32;

/// Cubes for a picture of this size.
pub(crate) fn tiles([height, width]: [usize; 2]) -> usize {
    height.div_ceil(TILE) * width.div_ceil(TILE) * CHANNELS
}

#[cube]
fn weight(#[comptime] tap: usize) -> f32 {
    f32::new(comptime!(window::<f32>()[tap]))
}

/// Where a cube's tile begins; one cube too many begins below the picture.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Corner {
    top: usize,
    left: usize,
    channel: usize,
}

#[cube]
fn corner(width: usize) -> Corner {
    let across = width.div_ceil(TILE);
    let tile = CUBE_POS / CHANNELS;
    Corner {
        top: tile / across * TILE,
        left: tile % across * TILE,
        channel: CUBE_POS % CHANNELS,
    }
}

/// Number of the sample at an entry of [`AROUND`], or `none` outside the picture.
#[cube]
fn sample(corner: Corner, at: usize, width: usize, height: usize, none: usize) -> usize {
    // Both lie the window's half-width further than what they stand for.
    let y = corner.top + at / SPAN;
    let x = corner.left + at % SPAN;
    let inside =
        y >= WINDOW_EDGE && y < height + WINDOW_EDGE && x >= WINDOW_EDGE && x < width + WINDOW_EDGE;
    let mut sample = none;
    if inside {
        sample = ((y - WINDOW_EDGE) * width + x - WINDOW_EDGE) * CHANNELS + corner.channel;
    }
    sample
}

/// One entry of row `at` convolved along it.
#[cube]
fn along_row(down: &[f32], at: usize) -> f32 {
    let mut sum = 0.0f32;
    #[unroll]
    for tap in 0..TAPS {
        sum += weight(tap) * down[at + tap];
    }
    sum
}

#[cube]
fn positive(v: f32) -> f32 {
    select(v > 0.0, v, 0.0)
}

/// Sums of each tile's |a - b| and SSIM, each times its scale; with `wanted`, also SSIM's derivatives by m, p and r, [3, H, W, 3].
#[cube(launch)]
pub(crate) fn lanes_kernel(
    a: &[f32],
    b: &[f32],
    partials: &mut [f32],
    terms: &mut [f32],
    width: u32,
    height: u32,
    l1_scale: f32,
    ssim_scale: f32,
    #[comptime] wanted: bool,
) {
    let unit = UNIT_POS as usize;
    let (width, height) = (width as usize, height as usize);
    let count = a.len();
    let corner = corner(width);

    let mut near_a = Shared::<[f32]>::new_slice(AROUND);
    let mut near_b = Shared::<[f32]>::new_slice(AROUND);
    let mut at = unit;
    while at < AROUND {
        let from = sample(corner, at, width, height, count);
        let mut va = 0.0f32;
        let mut vb = 0.0f32;
        if from < count {
            va = a[from];
            vb = b[from];
        }
        near_a[at] = va;
        near_b[at] = vb;
        at += TEAM;
    }
    sync_cube();

    let mut down = Shared::<[f32]>::new_slice(5 * DOWN);
    let mut at = unit;
    while at < DOWN {
        let mut m = 0.0f32;
        let mut n = 0.0f32;
        let mut p = 0.0f32;
        let mut q = 0.0f32;
        let mut r = 0.0f32;
        #[unroll]
        for tap in 0..TAPS {
            let va = near_a[at + tap * SPAN];
            let vb = near_b[at + tap * SPAN];
            let wa = weight(tap) * va;
            let wb = weight(tap) * vb;
            m += wa;
            n += wb;
            p += wa * va;
            q += wb * vb;
            r += wa * vb;
        }
        down[at] = m;
        down[DOWN + at] = n;
        down[2 * DOWN + at] = p;
        down[3 * DOWN + at] = q;
        down[4 * DOWN + at] = r;
        at += TEAM;
    }
    sync_cube();

    let row = unit / TILE;
    let column = unit % TILE;
    let y = corner.top + row;
    let x = corner.left + column;
    let mut term = 0.0f32;
    if y < height && x < width {
        let from = row * SPAN + column;
        let m = along_row(&down, from);
        let n = along_row(&down, DOWN + from);
        let p = along_row(&down, 2 * DOWN + from);
        let q = along_row(&down, 3 * DOWN + from);
        let r = along_row(&down, 4 * DOWN + from);
        // Variances are not negative, but rounding can make them so where a picture is bright and flat.
        let variances = positive(p - m * m) + positive(q - n * n);
        let means = 2.0 * m * n + FIRST;
        let covariance = 2.0 * (r - m * n) + SECOND;
        let below_means = 1.0 / (m * m + n * n + FIRST);
        let below_variances = 1.0 / (variances + SECOND);
        let below = below_means * below_variances;
        let value = means * covariance * below;
        term = ssim_scale * value;
        if l1_scale != 0.0 {
            let center = (row + WINDOW_EDGE) * SPAN + column + WINDOW_EDGE;
            term += l1_scale * (near_a[center] - near_b[center]).abs();
        }
        if wanted {
            let to = (y * width + x) * CHANNELS + corner.channel;
            partials[to] = 2.0 * n * (covariance - means) * below
                - 2.0 * m * value * (below_means - below_variances);
            partials[count + to] = -value * below_variances;
            partials[2 * count + to] = 2.0 * means * below;
        }
    }
    let mut shared = Shared::<[f32]>::new_slice(TEAM);
    let sum = total(&mut shared, term);
    if unit == 0 && CUBE_POS < terms.len() {
        terms[CUBE_POS] = sum;
    }
}

/// The gradient by `a` of what [`lanes_kernel`] adds up, [H, W, 3].
#[cube(launch)]
pub(crate) fn gradient_kernel(
    a: &[f32],
    b: &[f32],
    partials: &[f32],
    gradient: &mut [f32],
    width: u32,
    height: u32,
    l1_scale: f32,
    ssim_scale: f32,
) {
    let unit = UNIT_POS as usize;
    let (width, height) = (width as usize, height as usize);
    let count = a.len();
    let corner = corner(width);

    let mut near = Shared::<[f32]>::new_slice(3 * AROUND);
    let mut at = unit;
    while at < AROUND {
        let from = sample(corner, at, width, height, count);
        #[unroll]
        for lane in 0..3 {
            let mut v = 0.0f32;
            if from < count {
                v = partials[lane * count + from];
            }
            near[lane * AROUND + at] = v;
        }
        at += TEAM;
    }
    sync_cube();

    let mut down = Shared::<[f32]>::new_slice(3 * DOWN);
    let mut at = unit;
    while at < DOWN {
        #[unroll]
        for lane in 0..3 {
            let mut sum = 0.0f32;
            #[unroll]
            for tap in 0..TAPS {
                sum += weight(tap) * near[lane * AROUND + at + tap * SPAN];
            }
            down[lane * DOWN + at] = sum;
        }
        at += TEAM;
    }
    sync_cube();

    let row = unit / TILE;
    let column = unit % TILE;
    let y = corner.top + row;
    let x = corner.left + column;
    if y < height && x < width {
        let from = row * SPAN + column;
        let to = (y * width + x) * CHANNELS + corner.channel;
        let va = a[to];
        let vb = b[to];
        let ssim = along_row(&down, from)
            + 2.0 * va * along_row(&down, DOWN + from)
            + vb * along_row(&down, 2 * DOWN + from);
        let difference = va - vb;
        let negative = select(difference < 0.0, -l1_scale, 0.0);
        let sign = select(difference > 0.0, l1_scale, negative);
        gradient[to] = ssim_scale * ssim + sign;
    }
}
