//! What is asked about whole tensors, in one number.

use host::Real;

use crate::ops::LARGE_SCALE;

/// See [`TrainerOps::squared_error`](crate::ops::TrainerOps::squared_error): the sum is kept in f64, and only scaled where it
/// lies beyond f32.
pub(crate) fn squared_error<T: Real>(a: &[T], b: &[T], valid: Option<&[bool]>) -> [f64; 2] {
    let squares = a.iter().zip(b).map(|(a, b)| (*a - *b).to_f64().powi(2));
    let sum: f64 = match valid {
        None => squares.sum(),
        Some(valid) => {
            let samples = valid.iter().flat_map(|valid| [*valid; 3]);
            let counted = squares.zip(samples).filter(|(_, valid)| *valid);
            counted.map(|(square, _)| square).sum()
        }
    };
    if sum > f64::from(f32::MAX) {
        [0.0, sum * f64::from(LARGE_SCALE).powi(2)]
    } else {
        [sum, 0.0]
    }
}
