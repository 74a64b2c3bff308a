//! Projection, culling and depth sort.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::body::{Body, Shapes, column};
use super::constants::MIN_ALPHA;
use super::geometry::{Geometry, Lens, project_some, view_directions};
use super::packs::{Number, Pack, WIDEST, arrays};
use super::real::Real;
use super::sh;
use super::splat::{Extent, Splat};
use super::tiles::{TileLists, pixel_range};
use super::types::{SplatSlices, View};
use crate::error::SplatError;
use crate::stages::{InImage, Stages};

/// Gaussians per piece of parallel work; fixed, so that results do not depend on threads.
pub(super) const CHUNK: usize = 512;

/// Gaussians projected into a view, in depth order, with their tile lists.
///
/// At equal depth the lower row comes first.
#[derive(Clone, Debug)]
pub struct Projection<T> {
    pub(super) view: View,
    pub(super) lens: Lens<T>,
    /// Number of Gaussians N in the inputs.
    pub(super) count: usize,
    pub(super) splats: Vec<Splat<T>>,
    pub(super) tiles: TileLists,
    /// Place of every row in `splats`, `u32::MAX` for culled rows.
    pub(super) rank: Vec<u32>,
    pub(crate) radii: Vec<f32>,
}

impl<T> Projection<T> {
    /// The view it was made for.
    #[must_use]
    pub fn view(&self) -> &View {
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

impl<T: Copy + Into<f64>> Projection<T> {
    /// Every Gaussian in the image, and the tiles' lists.
    #[must_use]
    pub fn stages(&self) -> Stages {
        let mut projected = vec![None; self.count];
        for splat in &self.splats {
            let [red, green, blue, depth] = splat.channels.map(T::into);
            projected[splat.row as usize] = Some(InImage {
                mean: splat.mean.map(T::into),
                falloff: [splat.l11, splat.l21, splat.l22].map(T::into),
                opacity: splat.opacity.into(),
                depth,
                color: [red, green, blue],
            });
        }
        let tiles = &self.tiles;
        let row = |place: &u32| self.splats[*place as usize].row;
        Stages {
            projected,
            tiles: [tiles.across, tiles.down],
            tile_starts: tiles.tile_starts.iter().map(|s| *s as usize).collect(),
            listed: tiles.gaussians.iter().map(row).collect(),
        }
    }
}

/// See [`super::project`].
pub(super) fn project<T: Real>(
    splats: &SplatSlices<'_, T>,
    view: &View,
) -> Result<Projection<T>, SplatError> {
    let _span = tracing::trace_span!("project").entered();
    let lens = Lens::new(view)?;
    splats.check(view.sh_degree)?;
    let count = splats.len();
    let arch = Arch::new();
    let chunks: Vec<_> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            arch.dispatch(ProjectRows {
                splats,
                lens: &lens,
                sh_degree: view.sh_degree,
                rows: chunk * CHUNK..((chunk + 1) * CHUNK).min(count),
            })
        })
        .collect();
    // In order, so that the first fault is named whatever the threads do.
    let chunks: Vec<_> = chunks.into_iter().collect::<Result<_, SplatError>>()?;
    in_depth_order(view, lens, count, &chunks)
}

/// Visible Gaussians by depth, with their tile lists. `pieces` are visible ones of consecutive rows, each of at most
/// [`CHUNK`].
pub(super) fn in_depth_order<T: Real>(
    view: &View,
    lens: Lens<T>,
    count: usize,
    pieces: &[Vec<(Splat<T>, Extent<T>)>],
) -> Result<Projection<T>, SplatError> {
    // The sort is stable, so that at equal depth the lower row comes first.
    let mut order: Vec<(T, u32)> = Vec::with_capacity(count);
    for (c, piece) in pieces.iter().enumerate() {
        let depths = piece.iter().map(|(splat, _)| splat.channels[3]);
        order.extend(depths.zip((c * CHUNK) as u32..));
    }
    radsort::sort_by_key(&mut order, |(depth, _)| *depth);
    let at = |(_, at): &(T, u32)| &pieces[*at as usize / CHUNK][*at as usize % CHUNK];
    let sorted: Vec<Splat<T>> = order.par_iter().map(|k| at(k).0).collect();
    let extents: Vec<Extent<T>> = order.par_iter().map(|k| at(k).1).collect();

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
        lens,
        count,
        splats: sorted,
        tiles,
        rank,
        radii,
    })
}

/// SH + 0.5 per channel, before the clamp at 0, of the Gaussian in lane `l`.
#[inline(always)]
pub(super) fn sh_color<T: Real>(stored: &[T], basis: &[[T; WIDEST]; 16], l: usize) -> [T; 3] {
    let mut color = [T::of(0.5); 3];
    for (b, c) in basis.iter().zip(stored.chunks_exact(3)) {
        for k in 0..3 {
            color[k] += b[l] * c[k];
        }
    }
    color
}

struct ProjectRows<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    lens: &'a Lens<T>,
    sh_degree: usize,
    rows: Range<usize>,
}

impl<T: Real> WithSimd for ProjectRows<'_, T> {
    type Output = Result<Vec<(Splat<T>, Extent<T>)>, SplatError>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        check_finite(self.splats, self.rows.clone())?;
        let mut visible = Vec::with_capacity(self.rows.len());
        for first in self.rows.clone().step_by(T::lanes::<S>()) {
            let rows = first..(first + T::lanes::<S>()).min(self.rows.end);
            project_rows(
                simd,
                self.splats,
                self.lens,
                self.sh_degree,
                &rows,
                &mut visible,
            );
        }
        Ok(visible)
    }
}

/// Projects as many Gaussians as a vector has, or fewer; appends those that can be seen.
#[inline(always)]
fn project_rows<T: Real, S: Simd>(
    simd: S,
    splats: &SplatSlices<'_, T>,
    lens: &Lens<T>,
    sh_degree: usize,
    rows: &Range<usize>,
    visible: &mut Vec<(Splat<T>, Extent<T>)>,
) {
    let shapes = Shapes::new(simd, splats, rows);
    let body = Body::new(simd, &shapes);
    let g = project_some(simd, lens, &body.placed);
    let opacity = column(simd, splats.opacity_logits, 1, rows, 0).map(sigmoid);

    let (direction, _) = view_directions(&lens.pose, shapes.mean);
    let basis = arrays(sh::basis(sh_degree, direction));
    let used = sh::num_coefficients(sh_degree) * 3;
    let stored = splats.sh_coefficients() * 3;
    keep_visible(
        lens,
        rows,
        &g,
        [opacity, reach(opacity)],
        #[inline(always)]
        |l| {
            let sh = &splats.sh[(rows.start + l) * stored..][..used];
            sh_color(sh, &basis, l).map(|c| c.max(T::ZERO))
        },
        visible,
    );
}

/// sigma beyond which alpha is under the threshold.
#[inline(always)]
pub(super) fn reach<T: Real, S: Simd>(opacity: Pack<T, S>) -> Pack<T, S> {
    let min_alpha = opacity.like(MIN_ALPHA);
    (opacity / min_alpha).map(T::ln).max(opacity.like(0.0))
}

/// Appends those of projected Gaussians that can be seen; `alpha` is their opacity and its [`reach`], `color` that of the
/// Gaussian in a lane.
#[inline(always)]
pub(super) fn keep_visible<T: Real, S: Simd>(
    lens: &Lens<T>,
    rows: &Range<usize>,
    g: &Geometry<T, S>,
    [opacity, sigma_max]: [Pack<T, S>; 2],
    color: impl Fn(usize) -> [T; 3],
    visible: &mut Vec<(Splat<T>, Extent<T>)>,
) {
    let n = |value| opacity.like(value);
    // Enlarged beyond rounding: the threshold is decided per pixel, not here.
    let reach = |variance| (n(2.0) * sigma_max * variance).sqrt() * n(1.001) + n(0.01);
    let half = [reach(g.xx), reach(g.yy)];
    let middle = n(0.5) * (g.xx + g.yy);
    let spread = n(0.5) * (g.xx - g.yy);
    let xy = g.rho * g.yy;
    let larger = middle + (spread * spread + xy * xy).sqrt();

    let seen = g.visible.to_array();
    let [opacity, sigma_max, larger] = arrays([opacity, sigma_max, larger]);
    let (half, mean) = (arrays(half), arrays(g.mean2d));
    let [l11, l21, l22, depth] = arrays([g.l11, g.l21, g.l22, g.point[2]]);
    for (l, row) in rows.clone().enumerate() {
        if !seen[l] || opacity[l] < T::of(MIN_ALPHA) {
            continue;
        }
        let range = |axis: usize, count| {
            let (mean, half) = (mean[axis][l], half[axis][l]);
            let (from, to) = pixel_range(mean - half, mean + half, count)?;
            // The sides of an image are at most 65,535 px.
            Some([from as u16, to as u16])
        };
        let columns = range(0, lens.size[0]);
        let (Some(columns), Some(rows)) = (columns, range(1, lens.size[1])) else {
            continue;
        };
        let color = color(l);
        if !(color[0] + color[1] + color[2]).is_finite() {
            continue;
        }
        let splat = Splat {
            mean: [mean[0][l], mean[1][l]],
            l11: l11[l],
            l21: l21[l],
            l22: l22[l],
            opacity: opacity[l],
            channels: [color[0], color[1], color[2], depth[l]],
            columns,
            rows,
            row: row as u32,
        };
        let extent = Extent {
            sigma_max: sigma_max[l],
            half: [half[0][l], half[1][l]],
            radius: (3.0 * larger[l].to_f64().sqrt()).min(f64::from(f32::MAX)) as f32,
        };
        visible.push((splat, extent));
    }
}

#[inline(always)]
pub(super) fn sigmoid<T: Real>(x: T) -> T {
    T::ONE / (T::ONE + (-x).exp())
}

/// Names the first input and row in `rows` that is not finite.
#[inline(always)]
pub(super) fn check_finite<T: Real>(
    splats: &SplatSlices<'_, T>,
    rows: Range<usize>,
) -> Result<(), SplatError> {
    let left = rows.start.min(splats.num_left())..rows.end.min(splats.num_left());
    let inputs: [(&'static str, &[T], usize, Range<usize>); 6] = [
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
