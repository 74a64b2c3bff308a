//! Gram–Schmidt on six numbers and its way back, as [`crate::gram_schmidt`] has it on tensors, of Gaussians side by side.

use host::Real;

use super::lanes::Lanes;
use super::vec3::{Vec3, cross, difference, dot, scaled, sum};
use crate::rotation::{MIN_NORM, MIN_SINE, NEAR_Y_AXIS};

/// Vectors of Gaussians side by side.
pub(crate) type Vectors<T> = Vec3<Lanes<T>>;

/// The columns of rotations, and what the way back needs.
#[derive(Clone, Copy)]
pub(crate) struct Frame<T> {
    x: Vectors<T>,
    y: Vectors<T>,
    z: Vectors<T>,
    /// The second vectors as they count, of length 1 or an axis.
    second: Vectors<T>,
    /// x × second, and how far it lies along x.
    across: Vectors<T>,
    along: Lanes<T>,
    /// By what gradients of the first and the second vectors are scaled; 0 for one that was replaced.
    scales: [Lanes<T>; 2],
    /// 1 / |across - along x|.
    inverse: Lanes<T>,
}

impl<T: Real> Frame<T> {
    /// Of six numbers within ±1e9.
    #[inline(always)]
    pub(crate) fn of(six: [Lanes<T>; 6]) -> Self {
        let [zero, one] = [Lanes::ZERO, Lanes::all(T::ONE)];
        let least = T::of(MIN_NORM * MIN_NORM);
        let [a0, a1, a2, b0, b1, b2] = six;
        let given = dot([a0, a1, a2], [a0, a1, a2]);
        let first = [
            given.below(least, one, a0),
            given.below(least, zero, a1),
            given.below(least, zero, a2),
        ];
        let inverse_first = one / dot(first, first).sqrt();
        let x = scaled(first, inverse_first);

        let square = dot([b0, b1, b2], [b0, b1, b2]);
        let inverse_second = one / square.max(Lanes::all(least)).sqrt();
        let unit = scaled([b0, b1, b2], inverse_second);
        let sine = cross(x, unit);
        let (sine, parallel) = (dot(sine, sine), T::of(MIN_SINE * MIN_SINE));
        let off = x[1] * x[1];
        let y_axis = off.below(T::of(NEAR_Y_AXIS), one, zero);
        let second = [
            sine.below(parallel, zero, unit[0]),
            sine.below(parallel, y_axis, unit[1]),
            sine.below(parallel, one - y_axis, unit[2]),
        ];

        let across = cross(x, second);
        let along = dot(across, x);
        let right = difference(across, scaled(x, along));
        let inverse = one / dot(right, right).sqrt();
        let z = scaled(right, inverse);
        Self {
            x,
            y: cross(z, x),
            z,
            second,
            across,
            along,
            scales: [
                given.below(least, zero, inverse_first),
                sine.below(parallel, zero, inverse_second),
            ],
            inverse,
        }
    }

    /// Row by row.
    #[inline(always)]
    pub(crate) fn rows(&self) -> [Vectors<T>; 3] {
        let Self { x, y, z, .. } = *self;
        [[x[0], y[0], z[0]], [x[1], y[1], z[1]], [x[2], y[2], z[2]]]
    }

    /// The gradient of the six numbers from that of the rotation, row by row.
    #[inline(always)]
    pub(crate) fn backward(&self, gradient: [Vectors<T>; 3]) -> [Lanes<T>; 6] {
        let [r0, r1, r2] = gradient;
        let Self { x, z, .. } = *self;
        let (gx, gy, gz) = (
            [r0[0], r1[0], r2[0]],
            [r0[1], r1[1], r2[1]],
            [r0[2], r1[2], r2[2]],
        );
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
