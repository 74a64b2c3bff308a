//! The dynamic mask's loss.

use crate::real::{constant_like, wide_values, with_real};
use burn::tensor::Tensor;

/// The share of pixels, inside and outside the mask each, that the trimmed loss keeps at least.
const KEPT: f64 = 0.98;

/// The band's width in pixels for a picture of this width: 2 at 256, in proportion, at least 1.
#[must_use]
pub fn mask_band(width: usize) -> usize {
    ((width + 64) / 128).max(1)
}

/// Trimmed L1 between the rendered dynamic mask and the given one, both [H, W].
///
/// Pixels within `band` pixels (in rows and columns) of the edge between inside (`target` above 0.5) and outside
/// carry no loss: blurred movers spill over it. Of the others the largest errors are left out, those above the 98 % quantile,
/// inside and outside **each by itself**: a mover under 2 % of the picture would otherwise have no loss.
/// Pixels that are not `valid` (the holes of an unseen view) carry none either.
/// The result is the mean over what is kept; zero where nothing is. Shape `[1]`.
///
/// # Panics
/// Panics if `target` or `valid` does not have H W entries.
#[must_use]
pub fn mask_loss(
    rendered: Tensor<2>,
    target: &[f32],
    valid: Option<&[bool]>,
    band: usize,
) -> Tensor<1> {
    let [height, width] = rendered.dims();
    assert_eq!(
        target.len(),
        height * width,
        "one target per rendered pixel"
    );
    assert!(
        valid.is_none_or(|valid| valid.len() == target.len()),
        "one validity per rendered pixel"
    );
    let errors: Vec<f64> = wide_values(&rendered)
        .iter()
        .zip(target)
        .map(|(r, t)| (r - f64::from(*t)).abs())
        .collect();
    let near = sides_within(target, width, height, band);
    let mut kept = vec![false; errors.len()];
    for side in [INSIDE, OUTSIDE] {
        let candidates: Vec<usize> = (0..errors.len())
            .filter(|k| near[*k] == side && valid.is_none_or(|valid| valid[*k]))
            .collect();
        if let Some(limit) = quantile(candidates.iter().map(|k| errors[*k]).collect()) {
            for k in candidates {
                kept[k] = errors[k] <= limit;
            }
        }
    }
    let count = kept.iter().filter(|kept| **kept).count().max(1);
    let known = rendered.clone().inner();
    let (target, weight) = with_real!(known.dtype(), T => (
        constant_like(target.iter().map(|t| *t as T).collect(), &known),
        constant_like(
            kept.iter().map(|kept| if *kept { 1.0 / count as T } else { 0.0 }).collect(),
            &known,
        ),
    ));
    ((rendered - target).abs() * weight).sum()
}

const INSIDE: u8 = 1;
const OUTSIDE: u8 = 2;

/// Which sides of the mask occur within `band` pixels of each pixel: bits, [H, W].
fn sides_within(target: &[f32], width: usize, height: usize, band: usize) -> Vec<u8> {
    let side: Vec<u8> = target
        .iter()
        .map(|t| if *t > 0.5 { INSIDE } else { OUTSIDE })
        .collect();
    let mut along_rows = vec![0; side.len()];
    let mut out = vec![0; side.len()];
    for y in 0..height {
        for x in 0..width {
            let from = y * width + x.saturating_sub(band);
            let to = y * width + (x + band + 1).min(width);
            along_rows[y * width + x] = side[from..to].iter().fold(0, |bits, side| bits | side);
        }
    }
    for y in 0..height {
        for source in y.saturating_sub(band)..(y + band + 1).min(height) {
            for x in 0..width {
                out[y * width + x] |= along_rows[source * width + x];
            }
        }
    }
    out
}

/// The largest value that is at most the 98 % quantile; `None` of nothing.
fn quantile(mut values: Vec<f64>) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let place = (KEPT * last as f64).floor() as usize;
    Some(*values.select_nth_unstable_by(place, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_band_grows_with_the_picture() {
        assert_eq!(
            [32, 128, 256, 512].map(mask_band),
            [1, 1, 2, 4],
            "two pixels at 256"
        );
    }

    #[test]
    fn both_sides_are_near_within_the_band_only() {
        // A mover of one pixel in the middle of 7x5.
        let mut target = vec![0.0; 35];
        target[2 * 7 + 3] = 1.0;
        let near = sides_within(&target, 7, 5, 1);
        for y in 0..5_usize {
            for x in 0..7_usize {
                let close = y.abs_diff(2) <= 1 && x.abs_diff(3) <= 1;
                let expected = if close { INSIDE | OUTSIDE } else { OUTSIDE };
                assert_eq!(near[y * 7 + x], expected, "at {x}, {y}");
            }
        }
    }

    #[test]
    fn the_quantile_keeps_ties_and_everything_small() {
        assert_eq!(quantile(vec![]), None);
        assert_eq!(quantile(vec![3.0]), Some(3.0));
        let values: Vec<f64> = (0..=100).rev().map(f64::from).collect();
        assert_eq!(quantile(values), Some(98.0));
        assert_eq!(quantile(vec![0.0; 50]), Some(0.0));
    }
}
