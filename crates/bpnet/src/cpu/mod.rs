//! Kernels on slices, generic over f32 and f64: f32 is what runs, f64 its reference.
//!
//! Work is cut into pieces of a fixed size, whatever the number of threads, and partial sums are
//! added in the order of the pieces: results have the same bits with any number of threads.

pub(crate) mod blur;

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, Sub};

/// f32 or f64.
pub(crate) trait Real:
    Copy
    + Debug
    + Send
    + Sync
    + PartialOrd
    + Add<Output = Self>
    + AddAssign
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + 'static
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// `self * a + b`, rounded once.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// The nearest value to an f64.
    fn from_f64(value: f64) -> Self;
}

macro_rules! real {
    ($float:ty) => {
        impl Real for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                <$float>::mul_add(self, a, b)
            }
            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $float
            }
        }
    };
}
real!(f32);
real!(f64);
