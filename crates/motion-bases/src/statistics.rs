//! Medians and quantiles of slices. The callers see to it that no value is NaN.

use glam::DVec3;

/// The median; the mean of the middle two for an even count. 0 for an empty slice.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    let n = values.len();
    if n == 0 {
        return 0.0;
    }
    let (below, upper, _) = values.select_nth_unstable_by(n / 2, f64::total_cmp);
    let upper = *upper;
    if n % 2 == 1 {
        return upper;
    }
    let lower = below.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    0.5 * (lower + upper)
}

/// The median of each coordinate.
pub(crate) fn median_point(points: impl Iterator<Item = DVec3> + Clone) -> DVec3 {
    let axis = |k: usize| median(&mut points.clone().map(|p| p[k]).collect::<Vec<_>>());
    DVec3::new(axis(0), axis(1), axis(2))
}

/// The value below which a share of the values lies: the entry of rank floor(share (n - 1)).
/// 0 for an empty slice.
pub(crate) fn quantile(values: &mut [f64], share: f64) -> f64 {
    let n = values.len();
    if n == 0 {
        return 0.0;
    }
    let rank = (share * (n - 1) as f64).floor() as usize;
    *values
        .select_nth_unstable_by(rank.min(n - 1), f64::total_cmp)
        .1
}

/// Half of the largest axis-aligned range of the points, from their 5 % to their 95 % quantile.
pub(crate) fn half_range(points: impl Iterator<Item = DVec3> + Clone) -> f64 {
    let range = |k: usize| {
        let mut values: Vec<f64> = points.clone().map(|p| p[k]).collect();
        quantile(&mut values, 0.95) - quantile(&mut values, 0.05)
    };
    0.5 * range(0).max(range(1)).max(range(2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_and_quantiles_of_small_slices() {
        assert_eq!(median(&mut []), 0.0);
        assert_eq!(median(&mut [3.0]), 3.0);
        assert_eq!(median(&mut [9.0, 1.0, 4.0]), 4.0);
        assert_eq!(median(&mut [9.0, 1.0, 4.0, 2.0]), 3.0);
        assert_eq!(quantile(&mut [5.0, 1.0, 3.0, 2.0, 4.0], 0.5), 3.0);
        assert_eq!(quantile(&mut [5.0, 1.0, 3.0, 2.0, 4.0], 1.0), 5.0);
        assert_eq!(quantile(&mut [2.0], 0.95), 2.0);
    }
}
