//! Order statistics.

use std::cmp::Ordering;

/// The median of at least one value; of an even number the upper one.
pub(crate) fn median(values: &[f64]) -> f64 {
    quantile(&mut values.to_vec(), 0.5)
}

/// The value above a share of all, of which there is at least one. Values are reordered.
pub(crate) fn quantile(values: &mut [f64], share: f64) -> f64 {
    quantile_by(values, share, f64::total_cmp)
}

/// The same in another order.
pub(crate) fn quantile_by<T: Copy>(
    values: &mut [T],
    share: f64,
    order: impl FnMut(&T, &T) -> Ordering,
) -> T {
    let rank = (share * values.len() as f64) as usize;
    let rank = rank.min(values.len() - 1);
    *values.select_nth_unstable_by(rank, order).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_above_a_share_of_all() {
        let all = || [5.0, 1.0, 3.0, 2.0, 4.0];
        for (share, expected) in [(0.0, 1.0), (0.5, 3.0), (0.79, 4.0), (0.8, 5.0), (1.0, 5.0)] {
            assert_eq!(quantile(&mut all(), share), expected, "{share}");
            let falling = |a: &f64, b: &f64| b.total_cmp(a);
            let other = quantile_by(&mut all(), share, falling);
            assert_eq!(other, 6.0 - expected, "{share}");
        }
        assert_eq!(median(&[2.0, 1.0]), 2.0);
        assert_eq!(median(&[1.0]), 1.0);
    }
}
