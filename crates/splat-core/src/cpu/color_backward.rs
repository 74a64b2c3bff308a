//! Backward of the colours: through SH and the direction in which they are evaluated.

use std::ops::Range;

use pulp::Simd;

use super::geometry::view_directions;
use super::packs::{Number as _, Pack, WIDEST, array, arrays};
use super::project::sh_color;
use super::real::Real;
use super::sh;
use super::types::SplatSlices;

/// What colours were made from.
pub(super) struct Coloring<'a, T> {
    pub(super) splats: &'a SplatSlices<'a, T>,
    pub(super) sh_degree: usize,
    /// Rows [R | t] of the pose from whose centre they are seen.
    pub(super) pose: &'a [T; 12],
}

/// What comes out of [`color_gradient`].
pub(super) struct ColorGradient<T: Real, S: Simd> {
    /// Values of the SH basis.
    pub(super) basis: [[T; WIDEST]; 16],
    /// Gradient of the colours before their clamp at zero.
    pub(super) v_color: [Pack<T, S>; 3],
    /// Gradient of mean - centre.
    pub(super) v_direction: [Pack<T, S>; 3],
}

/// Gradients of the colours' way through SH.
#[inline(always)]
pub(super) fn color_gradient<T: Real, S: Simd>(
    simd: S,
    from: &Coloring<'_, T>,
    rows: &Range<usize>,
    mean: [Pack<T, S>; 3],
    v_color: [Pack<T, S>; 3],
) -> ColorGradient<T, S> {
    let (used, all) = (
        sh::num_coefficients(from.sh_degree),
        from.splats.sh_coefficients(),
    );
    let (direction, length) = view_directions(from.pose, mean);
    let basis = arrays(sh::basis(from.sh_degree, direction));
    let mut passed = arrays(v_color);
    let mut weights = [[T::ZERO; WIDEST]; 16];
    for (l, row) in rows.clone().enumerate() {
        let stored = &from.splats.sh[row * all * 3..][..used * 3];
        let color = sh_color(stored, &basis, l);
        // Where a colour was clamped at zero, nothing passes.
        let v: [T; 3] = array(
            #[inline(always)]
            |k| {
                if color[k] > T::ZERO {
                    passed[k][l]
                } else {
                    T::ZERO
                }
            },
        );
        for k in 0..3 {
            passed[k][l] = v[k];
        }
        for (weight, c) in weights.iter_mut().zip(stored.chunks_exact(3)) {
            weight[l] = c[0] * v[0] + c[1] * v[1] + c[2] * v[2];
        }
    }
    let weights = array(
        #[inline(always)]
        |b| Pack::load(simd, &weights[b]),
    );
    let v_unit = sh::direction_gradient(from.sh_degree, direction, &weights);
    let along = v_unit[0] * direction[0] + v_unit[1] * direction[1] + v_unit[2] * direction[2];
    ColorGradient {
        basis,
        v_color: array(
            #[inline(always)]
            |k| Pack::load(simd, &passed[k]),
        ),
        v_direction: array(
            #[inline(always)]
            |k| (v_unit[k] - direction[k] * along) / length,
        ),
    }
}

/// Adds to the gradient of a pose what comes through its centre -Rᵀ t, from that of the directions mean - centre.
#[inline(always)]
pub(super) fn center_gradient<T: Real, S: Simd>(
    pose: &[T; 12],
    v_direction: &[Pack<T, S>; 3],
    v_pose: &mut [Pack<T, S>; 12],
) {
    for i in 0..3 {
        let row: [_; 4] = array(
            #[inline(always)]
            |k| v_direction[0].like(pose[4 * i + k].to_f64()),
        );
        for j in 0..3 {
            v_pose[4 * i + j] += row[3] * v_direction[j];
            v_pose[4 * i + 3] += row[j] * v_direction[j];
        }
    }
}
