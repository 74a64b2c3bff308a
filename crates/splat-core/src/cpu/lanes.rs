//! Rows of 16 pixels.

use super::{Real, TILE};

/// One value for each of the 16 pixels of a tile's row.
pub(super) type Lanes<T> = [T; TILE];

/// sum += a * b, lane by lane. Values are loaded before any is stored, so that the compiler need not
/// prove that they do not overlap.
#[inline(always)]
pub(super) fn add_product<T: Real>(sum: &mut Lanes<T>, a: &Lanes<T>, b: &Lanes<T>) {
    let (old, a, b) = (*sum, *a, *b);
    *sum = std::array::from_fn(|l| old[l] + a[l] * b[l]);
}

/// sum += a * factor, lane by lane.
#[inline(always)]
pub(super) fn add_scaled<T: Real>(sum: &mut Lanes<T>, a: &Lanes<T>, factor: T) {
    let (old, a) = (*sum, *a);
    *sum = std::array::from_fn(|l| old[l] + a[l] * factor);
}

/// Sum of the lanes of each row, always in the same order.
///
/// Not inlined: under AVX-512 the compiler would sum several rows at a time with gathers, which
/// costs more than all the rest of the backward pass.
#[inline(never)]
pub(super) fn sum_lanes<T: Real>(rows: &[Lanes<T>], sums: &mut [T]) {
    for (row, sum) in rows.iter().zip(sums) {
        let a: [T; 8] = std::array::from_fn(|k| row[k] + row[k + 8]);
        let b: [T; 4] = std::array::from_fn(|k| a[k] + a[k + 4]);
        *sum = (b[0] + b[2]) + (b[1] + b[3]);
    }
}

/// Values per channel whose number is known at compile time where it is small: the compiler then
/// keeps them in registers.
pub(super) trait PerChannel<V> {
    fn values(&mut self) -> &mut [V];
}

impl<V, const C: usize> PerChannel<V> for [V; C] {
    #[inline(always)]
    fn values(&mut self) -> &mut [V] {
        self
    }
}

impl<V> PerChannel<V> for Vec<V> {
    #[inline(always)]
    fn values(&mut self) -> &mut [V] {
        self
    }
}
