//! What is asked of any numbers.

/// The upper median of values, which it reorders; none where there is none.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Smallest and largest; the smallest is infinite and the largest less where there is none.
pub(crate) fn extremes(values: impl IntoIterator<Item = f64>) -> [f64; 2] {
    let wider = |[low, high]: [f64; 2], value: f64| [low.min(value), high.max(value)];
    values.into_iter().fold([f64::INFINITY, f64::NEG_INFINITY], wider)
}

/// Quantile of sorted numbers, linear between them; zero of none.
pub(crate) fn quantile(sorted: &[f64], part: f64) -> f64 {
    let place = part * sorted.len().saturating_sub(1) as f64;
    let at = |index: usize| sorted.get(index).copied().unwrap_or(0.0);
    let below = place.floor();
    at(below as usize) + (place - below) * (at(place.ceil() as usize) - at(below as usize))
}

/// Median of the absolute values; zero of none.
pub(crate) fn median_size(values: impl Iterator<Item = f64>) -> f64 {
    let mut sizes: Vec<f64> = values.map(f64::abs).collect();
    sizes.sort_by(f64::total_cmp);
    quantile(&sizes, 0.5)
}
