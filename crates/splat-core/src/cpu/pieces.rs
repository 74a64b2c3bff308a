//! Where the gradients of Gaussians are written, in pieces of rows.

use host::filled;
use pulp::Simd;

use super::color_backward::ColorGradient;
use super::gradients::Gradients;
use super::packs::{Number as _, Pack, Where, array, arrays};
use super::project::CHUNK;
use super::real::Real;
use super::sh;
use super::types::SplatSlices;

/// The output rows of one piece of work.
pub(super) struct Piece<'a, T> {
    pub(super) first: usize,
    means: &'a mut [T],
    quats: &'a mut [T],
    pub(super) left_rotations: &'a mut [T],
    log_scales: &'a mut [T],
    opacity_logits: &'a mut [T],
    sh: &'a mut [T],
    pub(super) features: &'a mut [T],
    pub(super) screen: &'a mut [T],
}

/// `out` for `count` Gaussians, cut in pieces of [`CHUNK`] rows.
pub(super) fn pieces<T: Real>(out: &mut Gradients<T>, count: usize) -> Vec<Piece<'_, T>> {
    let (num_features, sh_width) = [&out.features, &out.sh]
        .map(|table| table.len().checked_div(count).unwrap_or(0))
        .into();
    let mut left = out.left_rotations.chunks_mut(9 * CHUNK);
    let mut features = out.features.chunks_mut((num_features * CHUNK).max(1));
    let dense = out
        .means
        .chunks_mut(3 * CHUNK)
        .zip(out.quats.chunks_mut(4 * CHUNK))
        .zip(out.log_scales.chunks_mut(3 * CHUNK))
        .zip(out.opacity_logits.chunks_mut(CHUNK))
        .zip(out.sh.chunks_mut((sh_width * CHUNK).max(1)))
        .zip(out.screen.chunks_mut(CHUNK));
    let mut pieces = Vec::with_capacity(count.div_ceil(CHUNK));
    for (k, (((((means, quats), log_scales), opacity_logits), sh), screen)) in dense.enumerate() {
        pieces.push(Piece {
            first: k * CHUNK,
            means,
            quats,
            left_rotations: left.next().unwrap_or_default(),
            log_scales,
            opacity_logits,
            sh,
            features: features.next().unwrap_or_default(),
            screen,
        });
    }
    pieces
}

/// Gradients of as many Gaussians as a vector has.
pub(super) struct RowGradient<T: Real, S: Simd> {
    pub(super) mean: [Pack<T, S>; 3],
    pub(super) quat: [Pack<T, S>; 4],
    pub(super) log_scale: [Pack<T, S>; 3],
    pub(super) logit: Pack<T, S>,
    pub(super) screen: Pack<T, S>,
    pub(super) colors: ColorGradient<T, S>,
}

impl<T: Real, S: Simd> RowGradient<T, S> {
    /// A sum that is not finite where one of the values is not.
    #[inline(always)]
    pub(super) fn magnitude(&self) -> Pack<T, S> {
        let mut total = self.logit.abs() + self.screen.abs();
        for values in [&self.mean[..], &self.quat, &self.log_scale] {
            for value in values {
                total += value.abs();
            }
        }
        for value in self.colors.v_color {
            // A basis function of SH is under 4.
            total += value.abs() * value.like(4.0);
        }
        total
    }
}

impl<T: Real> Piece<'_, T> {
    /// Writes the gradients of those Gaussians that are kept, from row `first` of the piece on.
    #[inline(always)]
    pub(super) fn put<S: Simd>(
        &mut self,
        first: usize,
        kept: &[bool],
        gradient: &RowGradient<T, S>,
        sh_degree: usize,
    ) {
        put_columns(self.means, first, kept, &gradient.mean);
        put_columns(self.quats, first, kept, &gradient.quat);
        put_columns(self.log_scales, first, kept, &gradient.log_scale);
        put_columns(self.opacity_logits, first, kept, &[gradient.logit]);
        put_columns(self.screen, first, kept, &[gradient.screen]);
        let v_color = arrays(gradient.colors.v_color);
        let stored = self.sh.len() / self.screen.len();
        let used = sh::num_coefficients(sh_degree);
        for l in (0..kept.len()).filter(|l| kept[*l]) {
            let out = self.sh[(first + l) * stored..][..3 * used]
                .as_chunks_mut::<3>()
                .0;
            for (out, basis) in out.iter_mut().zip(&gradient.colors.basis) {
                *out = array(
                    #[inline(always)]
                    |k| basis[l] * v_color[k][l],
                );
            }
        }
    }
}

/// The lanes of Gaussians that are drawn: those with a place in depth order.
#[inline(always)]
pub(super) fn drawn<T: Real, S: Simd>(simd: S, ranks: &[u32]) -> Where<T, S> {
    let is_drawn = Pack::from_fn(
        simd,
        #[inline(always)]
        |l| {
            let is_drawn = ranks.get(l).is_some_and(|rank| *rank != u32::MAX);
            if is_drawn { T::ONE } else { T::ZERO }
        },
    );
    Pack::splat(simd, T::ZERO).less(is_drawn)
}

/// Writes the columns of those Gaussians that are kept, from row `first` on.
#[inline(always)]
pub(super) fn put_columns<T: Real, S: Simd, const C: usize>(
    target: &mut [T],
    first: usize,
    kept: &[bool],
    columns: &[Pack<T, S>; C],
) {
    let columns = arrays(*columns);
    let rows = target[first * C..][..kept.len() * C].chunks_exact_mut(C);
    for (l, row) in rows.enumerate() {
        if kept[l] {
            for (value, column) in row.iter_mut().zip(&columns) {
                *value = column[l];
            }
        }
    }
}

/// Zeros, for Gaussians with so many features.
pub(super) fn no_gradients<T: Real>(
    splats: &SplatSlices<'_, T>,
    num_features: usize,
) -> Gradients<T> {
    let n = splats.len();
    let zeros = |len: usize| filled(T::ZERO, len);
    Gradients {
        means: zeros(3 * n),
        quats: zeros(4 * n),
        left_rotations: zeros(splats.left_rotations.len()),
        log_scales: zeros(3 * n),
        opacity_logits: zeros(n),
        sh: zeros(splats.sh.len()),
        features: zeros(n * num_features),
        cam_from_world: [T::ZERO; 12],
        screen: zeros(n),
    }
}
