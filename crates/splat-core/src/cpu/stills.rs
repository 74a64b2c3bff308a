//! What all samples of an exposure share of their Gaussians, kept in the order in which vectors read it.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::body::{Body, Placed, Shapes, column};
use super::exposure::{Exposure, Moved};
use super::geometry::{Lens, view_directions};
use super::packs::{Pack, WIDEST, array, arrays, packs};
use super::project::{CHUNK, check_finite, reach, sh_color, sigmoid};
use super::real::Real;
use super::sh;
use super::types::SplatSlices;
use crate::error::SplatError;

/// As many Gaussians as a vector has.
#[derive(Clone, Debug)]
pub(super) struct Still<T> {
    mean: [[T; WIDEST]; 3],
    rotation: [[T; WIDEST]; 9],
    scale: [[T; WIDEST]; 3],
    /// Opacity and its reach.
    alpha: [[T; WIDEST]; 2],
    /// Seen from the middle of the exposure.
    pub(super) color: [[T; WIDEST]; 3],
}

impl<T: Real> Still<T> {
    /// Where they are while they rest.
    #[inline(always)]
    pub(super) fn placed<S: Simd>(&self, simd: S) -> Placed<T, S> {
        Placed {
            mean: packs(simd, &self.mean),
            rotation: packs(simd, &self.rotation),
            scale: packs(simd, &self.scale),
        }
    }

    /// Opacity and its reach.
    #[inline(always)]
    pub(super) fn alpha<S: Simd>(&self, simd: S) -> [Pack<T, S>; 2] {
        packs(simd, &self.alpha)
    }
}

/// All Gaussians in chunks of [`CHUNK`] rows.
///
/// # Errors
/// A value that is not finite, named with its row.
pub(super) fn stills<T: Real>(
    exposure: &Exposure<'_, T>,
    middle: &Lens<T>,
) -> Result<Vec<Vec<Still<T>>>, SplatError> {
    let splats = exposure.resting();
    let arch = Arch::new();
    let stills: Vec<_> = chunks(splats.len())
        .into_par_iter()
        .map(|rows| {
            arch.dispatch(MakeStills {
                splats: &splats,
                pose: &middle.pose,
                sh_degree: exposure.middle.sh_degree,
                rows,
            })
        })
        .collect();
    // In order, so that the first fault is named whatever the threads do.
    stills.into_iter().collect()
}

/// `count` rows in chunks of [`CHUNK`].
pub(super) fn chunks(count: usize) -> Vec<Range<usize>> {
    let chunks = (0..count).step_by(CHUNK);
    chunks
        .map(|first| first..(first + CHUNK).min(count))
        .collect()
}

struct MakeStills<'a, T> {
    splats: &'a SplatSlices<'a, T>,
    pose: &'a [T; 12],
    sh_degree: usize,
    rows: Range<usize>,
}

impl<T: Real> WithSimd for MakeStills<'_, T> {
    type Output = Result<Vec<Still<T>>, SplatError>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        check_finite(self.splats, self.rows.clone())?;
        let stored = self.splats.sh_coefficients() * 3;
        let used = sh::num_coefficients(self.sh_degree) * 3;
        let mut stills = Vec::with_capacity(self.rows.len().div_ceil(T::lanes::<S>()));
        for first in self.rows.clone().step_by(T::lanes::<S>()) {
            let rows = first..(first + T::lanes::<S>()).min(self.rows.end);
            let shapes = Shapes::new(simd, self.splats, &rows);
            let placed = Body::new(simd, &shapes).placed;
            let opacity = column(simd, self.splats.opacity_logits, 1, &rows, 0).map(sigmoid);
            let (direction, _) = view_directions(self.pose, placed.mean);
            let basis = arrays(sh::basis(self.sh_degree, direction));
            let mut color = [[T::ZERO; WIDEST]; 3];
            for (l, row) in rows.enumerate() {
                let values = sh_color(&self.splats.sh[row * stored..][..used], &basis, l);
                for k in 0..3 {
                    color[k][l] = values[k].max(T::ZERO);
                }
            }
            stills.push(Still {
                mean: arrays(placed.mean),
                rotation: arrays(placed.rotation),
                scale: arrays(placed.scale),
                alpha: arrays([opacity, reach(opacity)]),
                color,
            });
        }
        Ok(stills)
    }
}

/// Gaussians of `rows` in a sample, where one of them moves.
#[inline(always)]
pub(super) fn moved_shapes<T: Real, S: Simd>(
    simd: S,
    splats: &SplatSlices<'_, T>,
    moved: &Moved<'_, T>,
    rows: &Range<usize>,
) -> Option<Shapes<T, S>> {
    (rows.start < moved.rows).then(|| {
        let splats = SplatSlices {
            left_rotations: moved.left_rotations,
            ..*splats
        };
        let mut shapes = Shapes::new(simd, &splats, rows);
        shapes.mean = array(
            #[inline(always)]
            |k| {
                Pack::from_fn(
                    simd,
                    #[inline(always)]
                    |l| {
                        let row = (rows.start + l).min(rows.end - 1);
                        if row < moved.rows {
                            moved.means[3 * row + k]
                        } else {
                            splats.means[3 * row + k]
                        }
                    },
                )
            },
        );
        shapes
    })
}
