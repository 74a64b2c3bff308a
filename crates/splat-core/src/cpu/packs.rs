//! Numbers of several Gaussians at a time: a vector with the arithmetic of a number.

use std::fmt;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

use pulp::Simd;

use super::real::Real;

/// Values of a vector, at most.
pub(super) const WIDEST: usize = 16;

/// What formulas are written in.
pub(super) trait Number:
    Copy
    + Add<Output = Self>
    + AddAssign
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// A constant of the same kind.
    fn like(self, value: f64) -> Self;
}

/// `[value(0), value(1), …]`. The library's `array::from_fn` and `map` are not always inlined, and what is not
/// inlined here knows nothing of the machine's vectors; closures for this are `#[inline(always)]` for the same reason.
#[inline(always)]
pub(super) fn array<V: Copy, const N: usize>(value: impl Fn(usize) -> V) -> [V; N] {
    let mut values = [value(0); N];
    for k in 1..N {
        values[k] = value(k);
    }
    values
}

/// As many of the values of each array as a vector has.
#[inline(always)]
pub(super) fn packs<T: Real, S: Simd, const N: usize>(
    simd: S,
    values: &[[T; WIDEST]; N],
) -> [Pack<T, S>; N] {
    array(
        #[inline(always)]
        |k| Pack::load(simd, &values[k]),
    )
}

/// The values of each pack.
#[inline(always)]
pub(super) fn arrays<T: Real, S: Simd, const N: usize>(packs: [Pack<T, S>; N]) -> [[T; WIDEST]; N] {
    array(
        #[inline(always)]
        |k| packs[k].to_array(),
    )
}

/// One number of each of several Gaussians.
#[derive(Clone, Copy)]
pub(super) struct Pack<T: Real, S: Simd> {
    simd: S,
    values: T::Vector<S>,
}

impl<T: Real, S: Simd> fmt::Debug for Pack<T, S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list()
            .entries(&self.to_array()[..T::lanes::<S>()])
            .finish()
    }
}

macro_rules! operator {
    ($trait:ident, $function:ident, $vector:ident) => {
        impl<T: Real, S: Simd> $trait for Pack<T, S> {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                self.with(T::$vector(self.simd, self.values, other.values))
            }
        }
    };
}
operator!(Add, add, vadd);
operator!(Sub, sub, vsub);
operator!(Mul, mul, vmul);
operator!(Div, div, vdiv);

impl<T: Real, S: Simd> AddAssign for Pack<T, S> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl<T: Real, S: Simd> Neg for Pack<T, S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.with(T::vneg(self.simd, self.values))
    }
}

impl<T: Real, S: Simd> Number for Pack<T, S> {
    #[inline(always)]
    fn like(self, value: f64) -> Self {
        Self::splat(self.simd, T::of(value))
    }
}

impl<T: Real, S: Simd> Pack<T, S> {
    #[inline(always)]
    fn with(self, values: T::Vector<S>) -> Self {
        Self { values, ..self }
    }

    #[inline(always)]
    pub(super) fn new(simd: S, values: T::Vector<S>) -> Self {
        Self { simd, values }
    }

    #[inline(always)]
    pub(super) fn values(self) -> T::Vector<S> {
        self.values
    }

    /// The same number for all.
    #[inline(always)]
    pub(super) fn splat(simd: S, value: T) -> Self {
        Self {
            simd,
            values: T::splat(simd, value),
        }
    }

    /// As many of the values as a vector has.
    #[inline(always)]
    pub(super) fn load(simd: S, values: &[T; WIDEST]) -> Self {
        Self {
            simd,
            values: T::vectors::<S>(values)[0],
        }
    }

    /// `value(l)` for the Gaussian in lane l.
    #[inline(always)]
    pub(super) fn from_fn(simd: S, value: impl Fn(usize) -> T) -> Self {
        let mut values = [T::ZERO; WIDEST];
        for (l, target) in values[..T::lanes::<S>()].iter_mut().enumerate() {
            *target = value(l);
        }
        Self::load(simd, &values)
    }

    /// The values; zeros behind them.
    #[inline(always)]
    pub(super) fn to_array(self) -> [T; WIDEST] {
        let mut values = [T::ZERO; WIDEST];
        T::vectors_mut::<S>(&mut values)[0] = self.values;
        values
    }

    /// A function of each value by itself.
    #[inline(always)]
    pub(super) fn map(self, function: impl Fn(T) -> T) -> Self {
        let values = self.to_array();
        Self::from_fn(
            self.simd,
            #[inline(always)]
            |l| function(values[l]),
        )
    }

    #[inline(always)]
    pub(super) fn sqrt(self) -> Self {
        self.with(T::vsqrt(self.simd, self.values))
    }

    #[inline(always)]
    pub(super) fn abs(self) -> Self {
        self.with(T::vabs(self.simd, self.values))
    }

    #[inline(always)]
    pub(super) fn max(self, other: Self) -> Self {
        self.less(other).select(other, self)
    }

    #[inline(always)]
    pub(super) fn min(self, other: Self) -> Self {
        other.less(self).select(other, self)
    }

    /// Where it is smaller; not where one is not a number.
    #[inline(always)]
    pub(super) fn less(self, other: Self) -> Where<T, S> {
        Where {
            simd: self.simd,
            mask: T::less(self.simd, self.values, other.values),
        }
    }

    /// Where it is neither infinite nor not a number.
    #[inline(always)]
    pub(super) fn is_finite(self) -> Where<T, S> {
        self.abs().less(self.like(f64::INFINITY))
    }

    /// Adds each to a total.
    #[inline(always)]
    pub(super) fn add_to(self, totals: &mut [T; WIDEST]) {
        let totals = &mut T::vectors_mut::<S>(totals)[0];
        *totals = T::vadd(self.simd, *totals, self.values);
    }

    /// Sum of the values, always in the same order.
    #[inline(always)]
    pub(super) fn sum(self) -> T {
        T::sum(self.simd, self.values)
    }
}

/// Some of several Gaussians.
#[derive(Clone, Copy)]
pub(super) struct Where<T: Real, S: Simd> {
    simd: S,
    mask: T::Mask<S>,
}

impl<T: Real, S: Simd> fmt::Debug for Where<T, S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.to_array()).finish()
    }
}

impl<T: Real, S: Simd> Where<T, S> {
    /// These of the values, 0 for the others.
    #[inline(always)]
    pub(super) fn only<const N: usize>(self, values: [Pack<T, S>; N]) -> [Pack<T, S>; N] {
        array(
            #[inline(always)]
            |k| self.select(values[k], values[k].like(0.0)),
        )
    }

    /// `yes` for these, `no` for the others.
    #[inline(always)]
    pub(super) fn select(self, yes: Pack<T, S>, no: Pack<T, S>) -> Pack<T, S> {
        yes.with(T::select(self.simd, self.mask, yes.values, no.values))
    }

    /// Those that are in both.
    #[inline(always)]
    pub(super) fn and(self, other: Self) -> Self {
        Self {
            mask: T::and(self.simd, self.mask, other.mask),
            ..self
        }
    }

    /// Whether each is one of them.
    #[inline(always)]
    pub(super) fn to_array(self) -> [bool; WIDEST] {
        let one = Pack::splat(self.simd, T::ONE);
        let zero = Pack::splat(self.simd, T::ZERO);
        let values = self.select(one, zero).to_array();
        array(
            #[inline(always)]
            |l| values[l] != T::ZERO,
        )
    }
}
