//! Random cases for the tests of this crate, the same in every run.

use arbtest::arbitrary::{Result, Unstructured};
use arbtest::arbtest;

/// Tries a property on five hundred cases.
pub(crate) fn cases(mut property: impl FnMut(&mut Unstructured<'_>) -> Result<()>) {
    for case in 0..500_u64 {
        // The upper half of arbtest's seed is random, the lower half is the number of bytes.
        arbtest(&mut property).seed(case << 32 | 1 << 14).run();
    }
}
