//! Order statistics.

/// The median of at least one value; of an even number the upper one.
pub(crate) fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

/// The value above a share of them, of at least one.
pub(crate) fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let rank = (share * sorted.len() as f64) as usize;
    sorted[rank.min(sorted.len() - 1)]
}
