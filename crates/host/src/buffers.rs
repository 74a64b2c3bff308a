//! Buffers of the kernels.

use rayon::iter::ParallelIterator as _;

/// A large buffer, filled by all threads: one alone takes longer for it than many a kernel for its work.
#[must_use]
pub fn filled<V: Copy + Send + Sync>(value: V, count: usize) -> Vec<V> {
    rayon::iter::repeat_n(value, count).collect()
}
