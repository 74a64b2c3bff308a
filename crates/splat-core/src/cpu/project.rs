//! Projection, culling and depth sort.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::geometry::{Lens, Shape, project_one, view_direction};
use super::tiles::{TileLists, pixel_range};
use super::{MIN_ALPHA, Real, SplatSlices, View, sh};
use crate::SplatError;

/// Gaussians per piece of parallel work; fixed, so that results do not depend on threads.
pub(super) const CHUNK: usize = 512;

/// A visible Gaussian as the rasteriser sees it, kept small: tiles load it from all over memory.
#[derive(Clone, Copy, Debug)]
pub(super) struct Splat<T> {
    /// Mean in pixels.
    pub(super) mean: [T; 2],
    /// sigma = (l11 dx + l21 dy)² + (l22 dy)².
    pub(super) l11: T,
    pub(super) l21: T,
    pub(super) l22: T,
    pub(super) opacity: T,
    /// max(SH + 0.5, 0), and z-depth.
    pub(super) channels: [T; 4],
    /// Columns and rows of pixels [from, to) that its bounding box meets.
    pub(super) columns: [u16; 2],
    pub(super) rows: [u16; 2],
    /// Row in the inputs.
    pub(super) row: u32,
}

/// How far a visible Gaussian reaches in the image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extent<T> {
    /// Where sigma is larger, alpha is under the threshold.
    pub(super) sigma_max: T,
    /// Half the size of the bounding box of that ellipse, px, a little enlarged.
    pub(super) half: [T; 2],
    /// Three standard deviations along the longer axis, px.
    radius: f32,
}

/// Gaussians projected into a view, in depth order, with their tile lists.
///
/// At equal depth the lower row comes first.
#[derive(Clone, Debug)]
pub struct Projection<T> {
    pub(super) view: View<T>,
    /// Number of Gaussians N in the inputs.
    pub(super) count: usize,
    pub(super) splats: Vec<Splat<T>>,
    pub(super) tiles: TileLists,
    /// Place of every row in `splats`, `u32::MAX` for culled rows.
    pub(super) rank: Vec<u32>,
    radii: Vec<f32>,
}

impl<T: Real> Projection<T> {
    /// The view it was made for.
    #[must_use]
    pub fn view(&self) -> &View<T> {
        &self.view
    }

    /// Number of Gaussians N in the inputs, visible or not.
    #[must_use]
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there was no Gaussian.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Radius of every Gaussian in the image (three standard deviations of its longer axis), px,
    /// `[N]`; 0 for Gaussians that are not drawn.
    #[must_use]
    pub fn radii(&self) -> &[f32] {
        &self.radii
    }

    /// Number of Gaussians that are drawn.
    #[must_use]
    pub fn num_visible(&self) -> usize {
        self.radii.iter().filter(|r| **r > 0.0).count()
    }

    /// Number of pairs of a Gaussian and a tile.
    #[must_use]
    pub fn num_slots(&self) -> usize {
        self.tiles.slots.len()
    }
}

/// Projects Gaussians into a view, drops what cannot be seen, sorts by depth and lists every tile's
/// Gaussians.
///
/// # Errors
/// Wrong lengths, an unusable camera, or an input that is not finite, which is named with its row.
pub fn project<T: Real>(
    splats: &SplatSlices<'_, T>,
    view: &View<T>,
) -> Result<Projection<T>, SplatError> {
    let _span = tracing::trace_span!("project").entered();
    view.check()?;
    splats.check(view.sh_degree)?;
    let count = splats.len();
    let lens = Lens::new(view);
    let arch = Arch::new();
    let chunks: Vec<Vec<(Splat<T>, Extent<T>)>> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            arch.dispatch(ProjectRows {
                splats,
                view,
                lens: &lens,
                rows: chunk * CHUNK..((chunk + 1) * CHUNK).min(count),
            })
        })
        .collect::<Result<_, SplatError>>()?;
    // Depth order; the sort is stable, so that at equal depth the lower row comes first.
    let mut order: Vec<(u64, u32)> = chunks
        .iter()
        .enumerate()
        .flat_map(|(c, chunk)| {
            let key = move |(k, (splat, _)): (usize, &(Splat<T>, _))| {
                (splat.channels[3].sort_bits(), (c * CHUNK + k) as u32)
            };
            chunk.iter().enumerate().map(key)
        })
        .collect();
    T::sort_by_bits(&mut order);
    let (sorted, extents): (Vec<_>, Vec<_>) = order
        .iter()
        .map(|(_, at)| chunks[*at as usize / CHUNK][*at as usize % CHUNK])
        .unzip();

    let tiles = TileLists::new(&sorted, &extents, view.camera.width, view.camera.height)?;
    let mut rank = vec![u32::MAX; count];
    let mut radii = vec![0.0; count];
    for (k, (splat, extent)) in sorted.iter().zip(&extents).enumerate() {
        rank[splat.row as usize] = k as u32;
        if tiles.slot_starts[k] < tiles.slot_starts[k + 1] {
            radii[splat.row as usize] = extent.radius;
        }
    }
    Ok(Projection {
        view: view.clone(),
        count,
        splats: sorted,
        tiles,
        rank,
        radii,
    })
}

/// SH + 0.5 per channel, before the clamp at 0.
#[inline(always)]
pub(super) fn sh_color<T: Real>(
    splats: &SplatSlices<'_, T>,
    coefficients: usize,
    row: usize,
    used: usize,
    basis: &[T; 16],
) -> [T; 3] {
    let stored = &splats.sh[row * coefficients * 3..(row + 1) * coefficients * 3];
    let mut color = [T::of(0.5); 3];
    for (b, c) in basis[..used].iter().zip(stored.chunks_exact(3)) {
        for k in 0..3 {
            color[k] += *b * c[k];
        }
    }
    color
}

struct ProjectRows<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    view: &'a View<T>,
    lens: &'a Lens<T>,
    rows: std::ops::Range<usize>,
}

impl<T: Real> WithSimd for ProjectRows<'_, T> {
    type Output = Result<Vec<(Splat<T>, Extent<T>)>, SplatError>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        check_finite(self.splats, self.rows.clone())?;
        let mut visible = Vec::with_capacity(self.rows.len());
        for row in self.rows {
            visible.extend(project_row(self.splats, self.view, self.lens, row));
        }
        Ok(visible)
    }
}

#[inline(always)]
fn project_row<T: Real>(
    splats: &SplatSlices<'_, T>,
    view: &View<T>,
    lens: &Lens<T>,
    row: usize,
) -> Option<(Splat<T>, Extent<T>)> {
    let opacity = sigmoid(splats.opacity_logits[row]);
    if opacity < T::of(MIN_ALPHA) {
        return None;
    }
    let shape = Shape::of_row(splats, row);
    let g = project_one(lens, &view.cam_from_world, &shape)?;
    let sigma_max = (opacity / T::of(MIN_ALPHA)).ln().max(T::ZERO);
    // Enlarged beyond rounding: the threshold is decided per pixel, not here.
    let reach =
        |variance: T| (T::of(2.0) * sigma_max * variance).sqrt() * T::of(1.001) + T::of(0.01);
    let (half_width, half_height) = (reach(g.xx), reach(g.yy));
    let [mx, my] = g.mean2d;
    let columns = pixel_range(mx - half_width, mx + half_width, view.camera.width)?;
    let rows = pixel_range(my - half_height, my + half_height, view.camera.height)?;

    let (direction, _) = view_direction(&view.cam_from_world, shape.mean);
    let basis = sh::basis(view.sh_degree, direction);
    let used = sh::num_coefficients(view.sh_degree);
    let color =
        sh_color(splats, splats.sh_coefficients(), row, used, &basis).map(|c| c.max(T::ZERO));
    if !(color[0] + color[1] + color[2]).is_finite() {
        return None;
    }
    let l11 = (T::of(0.5) / g.e).sqrt();
    let middle = T::of(0.5) * (g.xx + g.yy);
    let spread = T::of(0.5) * (g.xx - g.yy);
    let xy = g.rho * g.yy;
    let larger = middle + (spread * spread + xy * xy).sqrt();
    let splat = Splat {
        mean: g.mean2d,
        l11,
        l21: -g.rho * l11,
        l22: (T::of(0.5) / g.yy).sqrt(),
        opacity,
        channels: [color[0], color[1], color[2], g.point[2]],
        // The sides of an image are at most 65,535 px.
        columns: [columns.0 as u16, columns.1 as u16],
        rows: [rows.0 as u16, rows.1 as u16],
        row: row as u32,
    };
    let extent = Extent {
        sigma_max,
        half: [half_width, half_height],
        radius: (3.0 * larger.to_f64().sqrt()).min(f64::from(f32::MAX)) as f32,
    };
    Some((splat, extent))
}

#[inline(always)]
pub(super) fn sigmoid<T: Real>(x: T) -> T {
    T::ONE / (T::ONE + (-x).exp())
}

/// Names the first input and row in `rows` that is not finite.
#[inline(always)]
fn check_finite<T: Real>(
    splats: &SplatSlices<'_, T>,
    rows: std::ops::Range<usize>,
) -> Result<(), SplatError> {
    let left = rows.start.min(splats.num_left())..rows.end.min(splats.num_left());
    let inputs: [(&'static str, &[T], usize, std::ops::Range<usize>); 6] = [
        ("means", splats.means, 3, rows.clone()),
        ("quats", splats.quats, 4, rows.clone()),
        ("left_rotations", splats.left_rotations, 9, left),
        ("log_scales", splats.log_scales, 3, rows.clone()),
        ("opacity_logits", splats.opacity_logits, 1, rows.clone()),
        ("sh", splats.sh, 3 * splats.sh_coefficients(), rows),
    ];
    for (tensor, values, width, rows) in inputs {
        find_not_finite(
            tensor,
            &values[rows.start * width..rows.end * width],
            width,
            rows.start,
        )?;
    }
    Ok(())
}

/// Fails on the first row of `values` (rows of `width`, counted from `first`) that is not finite.
#[inline(always)]
pub(super) fn find_not_finite<T: Real>(
    tensor: &'static str,
    values: &[T],
    width: usize,
    first: usize,
) -> Result<(), SplatError> {
    // Without a branch per value, so that the check runs at memory speed.
    if values.iter().fold(true, |ok, v| ok & v.is_finite()) {
        return Ok(());
    }
    let at = values.iter().position(|v| !v.is_finite()).unwrap_or(0);
    Err(SplatError::NotFinite {
        tensor,
        row: first + at / width.max(1),
    })
}
