//! A number of each of the Gaussians side by side: every operation is a loop over them, which becomes one or two instructions.

use std::array;
use std::ops::{Add, AddAssign, Div, Index, IndexMut, Mul, Neg, Sub};

use host::Real;

/// Gaussians side by side: a vector of the widest machines in f32.
pub(crate) const LANES: usize = 16;

/// See the module.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lanes<T>(pub(crate) [T; LANES]);

impl<T: Real> Lanes<T> {
    pub(crate) const ZERO: Self = Self([T::ZERO; LANES]);

    #[inline(always)]
    pub(crate) fn all(value: T) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    pub(crate) fn map(self, f: impl Fn(T) -> T) -> Self {
        Self(array::from_fn(
            #[inline(always)]
            |lane| f(self.0[lane]),
        ))
    }

    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(T, T) -> T) -> Self {
        Self(array::from_fn(
            #[inline(always)]
            |lane| f(self.0[lane], other.0[lane]),
        ))
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        self.map(T::sqrt)
    }

    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        self.zip(other, T::max)
    }

    /// `yes` where a number is smaller than `limit`, else `no`.
    #[inline(always)]
    pub(crate) fn below(self, limit: T, yes: Self, no: Self) -> Self {
        Self(array::from_fn(
            #[inline(always)]
            |lane| {
                if self.0[lane] < limit {
                    yes.0[lane]
                } else {
                    no.0[lane]
                }
            },
        ))
    }

    /// The sum, in the order of the lanes.
    #[inline(always)]
    pub(crate) fn total(self) -> T {
        self.0.into_iter().fold(T::ZERO, |sum, value| sum + value)
    }
}

impl<T> Index<usize> for Lanes<T> {
    type Output = T;

    #[inline(always)]
    fn index(&self, lane: usize) -> &T {
        &self.0[lane]
    }
}

impl<T> IndexMut<usize> for Lanes<T> {
    #[inline(always)]
    fn index_mut(&mut self, lane: usize) -> &mut T {
        &mut self.0[lane]
    }
}

impl<T: Real> Neg for Lanes<T> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        self.map(T::neg)
    }
}

impl<T: Real> AddAssign for Lanes<T> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

macro_rules! operator {
    ($operator:ident, $method:ident) => {
        impl<T: Real> $operator for Lanes<T> {
            type Output = Self;

            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                self.zip(other, T::$method)
            }
        }

        /// With the same number in every lane.
        impl<T: Real> $operator<T> for Lanes<T> {
            type Output = Self;

            #[inline(always)]
            fn $method(self, other: T) -> Self {
                self.$method(Self::all(other))
            }
        }
    };
}
operator!(Add, add);
operator!(Sub, sub);
operator!(Mul, mul);
operator!(Div, div);
