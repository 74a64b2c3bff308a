//! Rows of 16 pixels.

use super::{Real, TILE};

/// One value for each of the 16 pixels of a tile's row.
pub(super) type Lanes<T> = [T; TILE];

/// Sum of the lanes, always in the same order.
#[inline(always)]
pub(super) fn sum<T: Real>(mut v: Lanes<T>) -> T {
    for half in [8, 4, 2, 1] {
        for k in 0..half {
            v[k] = v[k] + v[k + half];
        }
    }
    v[0]
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
