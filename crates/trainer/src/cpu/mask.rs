//! Which pixels the dynamic mask's loss keeps.

use host::Real;

/// The share of pixels, inside and outside the mask each, that the trimmed loss keeps, about: of a handful it leaves one out.
const KEPT: f64 = 0.98;

/// The weight of every pixel [H, W] in a trimmed mean of the errors: one over the number of those kept, or zero.
pub(crate) fn mask_weights<T: Real>(
    rendered: &[T],
    target: &[T],
    valid: Option<&[bool]>,
    [height, width]: [usize; 2],
    band: usize,
) -> Vec<T> {
    let errors: Vec<f64> = rendered
        .iter()
        .zip(target)
        .map(|(r, t)| (r.to_f64() - t.to_f64()).abs())
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
    let weight = T::ONE / T::of(count as f64);
    kept.iter()
        .map(|kept| if *kept { weight } else { T::ZERO })
        .collect()
}

pub(crate) const INSIDE: u8 = 1;
pub(crate) const OUTSIDE: u8 = 2;

/// Which sides of the mask occur within `band` pixels of each pixel: bits, [H, W].
fn sides_within<T: Real>(target: &[T], width: usize, height: usize, band: usize) -> Vec<u8> {
    let side: Vec<u8> = target
        .iter()
        .map(|t| if t.to_f64() > 0.5 { INSIDE } else { OUTSIDE })
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
