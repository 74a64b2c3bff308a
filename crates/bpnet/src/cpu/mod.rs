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

use host::Real;

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
