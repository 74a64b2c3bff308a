//! What is asked about whole tensors, in one number.

use host::Real;

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
