//! The float types of the kernels.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

use crate::Vectors;

/// `f32` or `f64`: f32 is what runs, f64 its reference.
pub trait Real:
    Copy
    + Debug
    + Default
    + PartialOrd
    + Send
    + Sync
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + bytemuck::Pod
    + Vectors
    + 'static
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// The nearest value to an `f64`.
    fn of(value: f64) -> Self;
    /// As an `f64`.
    fn to_f64(self) -> f64;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Exponential, to the last bit or so.
    fn exp(self) -> Self;
    /// e^self for a value that is not above 0, within 2 units in the last place; in plain
    /// arithmetic, so that loops over it become vector code. Results under the smallest normal
    /// number are 0.
    fn exp_not_positive(self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// The smaller of two numbers.
    fn min(self, other: Self) -> Self;
    /// The larger of two numbers.
    fn max(self, other: Self) -> Self;
    /// Neither NaN nor infinite.
    fn is_finite(self) -> bool;
}

macro_rules! real {
    ($float:ident, $ln2:expr, $terms:expr) => {
        impl Real for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            #[inline(always)]
            fn of(value: f64) -> Self {
                value as $float
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $float::sqrt(self)
            }
            #[inline(always)]
            fn exp(self) -> Self {
                $float::exp(self)
            }
            #[inline(always)]
            fn exp_not_positive(self) -> Self {
                const MANTISSA: u32 = $float::MANTISSA_DIGITS - 1;
                // Adding it leaves the nearest integer in the lowest bits of the sum.
                const ROUND: $float = 1.5 * (1_u64 << MANTISSA) as $float;
                const LOWEST: $float = ($float::MIN_EXP - 1) as $float * std::$float::consts::LN_2;
                // e^x = 2^n e^r with |r| <= ln(2) / 2, ln(2) split in two so that r is exact.
                let shifted = self * std::$float::consts::LOG2_E + ROUND;
                let n = shifted - ROUND;
                let r = (self - n * $ln2.0) - n * $ln2.1;
                let mut series: $float = 1.0;
                let mut term = $terms;
                while term > 0 {
                    series = 1.0 + series * r * (1.0 / term as $float);
                    term -= 1;
                }
                let bits = shifted.to_bits().wrapping_shl(MANTISSA);
                let result = $float::from_bits(series.to_bits().wrapping_add(bits));
                // A comparison that not a number passes, so that it stays one.
                if self < LOWEST { 0.0 } else { result }
            }
            #[inline(always)]
            fn ln(self) -> Self {
                $float::ln(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                $float::abs(self)
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                if self < other { self } else { other }
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                if self > other { self } else { other }
            }
            #[inline(always)]
            fn is_finite(self) -> bool {
                $float::is_finite(self)
            }
        }
    };
}
real!(f32, (0.693_359_4, -2.121_944_4e-4), 8);
real!(
    f64,
    (6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10),
    14
);

#[cfg(test)]
mod tests {
    use super::Real as _;

    #[test]
    fn the_exponential_is_right_to_the_last_places() {
        for i in 0..200_000 {
            let x = -f64::from(i) * 5e-4;
            let error = (x.exp_not_positive() / x.exp() - 1.0).abs();
            assert!(error < 5e-16, "f64, {x}: {error:e}");
            let x = x as f32;
            if x > -87.0 {
                let error = (f64::from(x.exp_not_positive()) / f64::from(x).exp() - 1.0).abs();
                assert!(error < 2.5e-7, "f32, {x}: {error:e}");
            }
        }
        assert_eq!(0.0_f32.exp_not_positive(), 1.0);
        assert_eq!((-1e4_f32).exp_not_positive(), 0.0);
        assert_eq!(f32::NEG_INFINITY.exp_not_positive(), 0.0);
        assert!(f32::NAN.exp_not_positive().is_nan());
        assert_eq!((-745.0_f64).exp_not_positive(), 0.0);
    }
}
