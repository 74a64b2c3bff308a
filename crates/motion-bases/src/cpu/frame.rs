//! Gram–Schmidt on six numbers and its way back, as [`crate::gram_schmidt`] has it on tensors.

use host::Real;

use super::vec3::{Vec3, cross, difference, dot, scaled, select, sum};
use crate::rotation::{MIN_NORM, MIN_SINE, NEAR_Y_AXIS};

/// The columns of a rotation, and what the way back needs.
#[derive(Clone, Copy)]
pub(crate) struct Frame<T> {
    x: Vec3<T>,
    y: Vec3<T>,
    z: Vec3<T>,
    /// The second vector as it counts, of length 1 or an axis.
    second: Vec3<T>,
    /// x × second, and how far it lies along x.
    across: Vec3<T>,
    along: T,
    /// By what gradients of the first and the second vector are scaled; 0 for one that was replaced.
    scales: [T; 2],
    /// 1 / |across - along x|.
    inverse: T,
}

impl<T: Real> Frame<T> {
    /// Of six numbers within ±1e9.
    #[inline(always)]
    pub(crate) fn of(six: [T; 6]) -> Self {
        let least = T::of(MIN_NORM * MIN_NORM);
        let [a0, a1, a2, b0, b1, b2] = six;
        let first: Vec3<T> = [a0, a1, a2];
        let none = dot(first, first) < least;
        let first = select(none, [T::ONE, T::ZERO, T::ZERO], first);
        let inverse_first = T::ONE / dot(first, first).sqrt();
        let x = scaled(first, inverse_first);

        let given: Vec3<T> = [b0, b1, b2];
        let inverse_second = T::ONE / dot(given, given).max(least).sqrt();
        let unit = scaled(given, inverse_second);
        let sine = cross(x, unit);
        let parallel = dot(sine, sine) < T::of(MIN_SINE * MIN_SINE);
        let near = x[1] * x[1] > T::of(NEAR_Y_AXIS);
        let axis = select(near, [T::ZERO, T::ZERO, T::ONE], [T::ZERO, T::ONE, T::ZERO]);
        let second = select(parallel, axis, unit);

        let across = cross(x, second);
        let along = dot(across, x);
        let right = difference(across, scaled(x, along));
        let inverse = T::ONE / dot(right, right).sqrt();
        let z = scaled(right, inverse);
        Self {
            x,
            y: cross(z, x),
            z,
            second,
            across,
            along,
            scales: [
                if none { T::ZERO } else { inverse_first },
                if parallel { T::ZERO } else { inverse_second },
            ],
            inverse,
        }
    }

    /// Row by row.
    #[inline(always)]
    pub(crate) fn rows(&self) -> [Vec3<T>; 3] {
        [0, 1, 2].map(|i| [self.x[i], self.y[i], self.z[i]])
    }

    /// The gradient of the six numbers from that of the rotation, row by row.
    #[inline(always)]
    pub(crate) fn backward(&self, gradient: [Vec3<T>; 3]) -> [T; 6] {
        let column = |c: usize| [gradient[0][c], gradient[1][c], gradient[2][c]];
        let Self { x, z, .. } = *self;
        let (gx, gy, gz) = (column(0), column(1), column(2));
        // y = z × x
        let gz = sum(gz, cross(x, gy));
        let gx = sum(gx, cross(gy, z));
        // z = right / |right|
        let right = scaled(difference(gz, scaled(z, dot(z, gz))), self.inverse);
        // right = across - (across · x) x
        let along = -dot(right, x);
        let across = sum(right, scaled(x, along));
        let gx = sum(
            gx,
            difference(scaled(self.across, along), scaled(right, self.along)),
        );
        // across = x × second
        let gx = sum(gx, cross(self.second, across));
        let [s0, s1, s2] = scaled(cross(across, x), self.scales[1]);
        // x = first / |first|
        let [f0, f1, f2] = scaled(difference(gx, scaled(x, dot(x, gx))), self.scales[0]);
        [f0, f1, f2, s0, s1, s2]
    }
}
