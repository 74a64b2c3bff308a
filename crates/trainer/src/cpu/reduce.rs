//! What is asked about whole tensors, in one number.

use super::BLOCK;
use host::Real;
use rayon::prelude::*;

/// Number of values that are infinite or not a number.
pub(crate) fn count_not_finite<T: Real>(values: &[T]) -> usize {
    // Without a branch per value, so that it runs at memory speed.
    let count = |block: &[T]| -> u32 { block.iter().map(|v| u32::from(!v.is_finite())).sum() };
    values
        .par_chunks(BLOCK)
        .map(|block| count(block) as usize)
        .sum()
}

/// Sum of squared differences of two pictures [H, W, 3], over the `valid` pixels [H, W].
pub(crate) fn squared_error<T: Real>(a: &[T], b: &[T], valid: Option<&[bool]>) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| (*a - *b).to_f64().powi(2));
    match valid {
        None => squares.sum(),
        Some(valid) => {
            let samples = valid.iter().flat_map(|valid| [*valid; 3]);
            let counted = squares.zip(samples).filter(|(_, valid)| *valid);
            counted.map(|(square, _)| square).sum()
        }
    }
}
