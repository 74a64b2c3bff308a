//! Kernels on slices, generic over f32 and f64: f32 is what runs, f64 its reference.
//!
//! Work is cut into pieces of a fixed size, whatever the number of threads, and partial sums are
//! added in the order of the pieces: results have the same bits with any number of threads.

pub(crate) mod composite;
pub(crate) mod conv;
pub(crate) mod conv_backward;
pub(crate) mod instance_norm;
pub(crate) mod predict;
pub(crate) mod predict_backward;
mod product;
pub(crate) mod upsample;

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, Sub};

use pulp::{Simd, WithSimd};
use rayon::iter::ParallelIterator as _;

/// f32 or f64, and the machine's vectors of them.
pub(crate) trait Real:
    Copy
    + Debug
    + Send
    + Sync
    + PartialOrd
    + bytemuck::Pod
    + Add<Output = Self>
    + AddAssign
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// The nearest value to an f64.
    fn from_f64(value: f64) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// e^self for a value that is not above 0, within 2 units in the last place; in plain
    /// arithmetic, so that loops over it become vector code. Results under the smallest normal
    /// number are 0.
    fn exp_not_positive(self) -> Self;

    /// A vector of values.
    type Vector<S: Simd>: Copy + Send + Sync + bytemuck::Pod;
    /// The value in all lanes.
    fn splat<S: Simd>(simd: S, value: Self) -> Self::Vector<S>;
    /// `a * b + c`.
    fn mul_add<S: Simd>(
        simd: S,
        a: Self::Vector<S>,
        b: Self::Vector<S>,
        c: Self::Vector<S>,
    ) -> Self::Vector<S>;
    /// The values as whole vectors, and the rest.
    fn as_vectors<S: Simd>(values: &[Self]) -> (&[Self::Vector<S>], &[Self]);
    /// Values per vector.
    fn lanes<S: Simd>() -> usize {
        size_of::<Self::Vector<S>>() / size_of::<Self>()
    }
}

macro_rules! real {
    ($float:ident, $vector:ident, $splat:ident, $mul_add:ident, $as_simd:ident, $ln2:expr, $terms:expr) => {
        impl Real for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $float
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$float>::sqrt(self)
            }
            #[inline(always)]
            fn exp_not_positive(self) -> Self {
                const MANTISSA: u32 = <$float>::MANTISSA_DIGITS - 1;
                // Adding it leaves the nearest integer in the lowest bits of the sum.
                const ROUND: $float = 1.5 * (1_u64 << MANTISSA) as $float;
                const LOWEST: $float =
                    (<$float>::MIN_EXP - 1) as $float * std::$float::consts::LN_2;
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
                let result = <$float>::from_bits(series.to_bits().wrapping_add(bits));
                // A comparison that not a number passes, so that it stays one.
                if self < LOWEST { 0.0 } else { result }
            }

            type Vector<S: Simd> = S::$vector;
            #[inline(always)]
            fn splat<S: Simd>(simd: S, value: Self) -> Self::Vector<S> {
                simd.$splat(value)
            }
            #[inline(always)]
            fn mul_add<S: Simd>(
                simd: S,
                a: Self::Vector<S>,
                b: Self::Vector<S>,
                c: Self::Vector<S>,
            ) -> Self::Vector<S> {
                simd.$mul_add(a, b, c)
            }
            #[inline(always)]
            fn as_vectors<S: Simd>(values: &[Self]) -> (&[Self::Vector<S>], &[Self]) {
                S::$as_simd(values)
            }
        }
    };
}
real!(
    f32,
    f32s,
    splat_f32s,
    mul_add_e_f32s,
    as_simd_f32s,
    (0.693_359_4, -2.121_944_4e-4),
    8
);
real!(
    f64,
    f64s,
    splat_f64s,
    mul_add_e_f64s,
    as_simd_f64s,
    (6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10),
    14
);

/// A large buffer of zeros, filled by all threads: one alone takes longer for it than many a kernel for its work.
fn zeros<T: Real>(count: usize) -> Vec<T> {
    rayon::iter::repeat_n(T::ZERO, count).collect()
}

/// Runs `work` with the machine's vectors. (pulp takes closures as they are too, but calls them in a way that is not always
/// inlined, and what is not knows nothing of the vectors.)
fn vectorized<R>(work: impl FnMut() -> R) -> R {
    struct Work<F>(F);
    impl<R, F: FnMut() -> R> WithSimd for Work<F> {
        type Output = R;
        #[inline(always)]
        fn with_simd<S: Simd>(mut self, _: S) -> R {
            (self.0)()
        }
    }
    pulp::Arch::new().dispatch(Work(work))
}

/// Running sums of a reduction: they are the lanes of a vector, in a fixed order.
const LANES: usize = 16;

/// Combines the values of a row with `combine`, beginning with `start` in every lane.
#[inline(always)]
fn reduce<T: Real>(row: &[T], start: T, combine: impl Fn(T, T) -> T) -> T {
    let (chunks, rest) = row.as_chunks::<LANES>();
    let mut lanes = [start; LANES];
    for chunk in chunks {
        for lane in 0..LANES {
            lanes[lane] = combine(lanes[lane], chunk[lane]);
        }
    }
    let rest = rest.iter().fold(start, |all, &x| combine(all, x));
    lanes.into_iter().fold(rest, &combine)
}

/// Inner product.
#[inline(always)]
fn dot<T: Real>(a: &[T], b: &[T]) -> T {
    let (a_chunks, a_rest) = a.as_chunks::<LANES>();
    let (b_chunks, b_rest) = b.as_chunks::<LANES>();
    let mut sums = [T::ZERO; LANES];
    for (a, b) in a_chunks.iter().zip(b_chunks) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let rest = a_rest
        .iter()
        .zip(b_rest)
        .fold(T::ZERO, |sum, (&a, &b)| sum + a * b);
    sums.into_iter().fold(rest, |a, b| a + b)
}

#[cfg(test)]
mod tests {
    use super::*;

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
