//! Statistics of plain numbers.

use std::borrow::Borrow;

/// A median absolute deviation times this is the standard deviation of normal numbers.
pub(crate) const SIGMA_PER_MEDIAN: f64 = 1.4826;

/// Arithmetic mean; zero without values.
pub fn mean(values: impl IntoIterator<Item: Borrow<f64>>) -> f64 {
    let add = |(count, sum): (usize, f64), value: f64| (count + 1, sum + value);
    let (count, sum) = values.into_iter().map(|value| *value.borrow()).fold((0, 0.0), add);
    sum / count.max(1) as f64
}

/// Root mean square; zero without values.
pub fn rms(values: impl IntoIterator<Item: Borrow<f64>>) -> f64 {
    mean(values.into_iter().map(|value| value.borrow().powi(2))).sqrt()
}

/// The upper median of `values`, which it reorders; `None` if there are no values.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Smallest and largest value; without values infinity and minus infinity.
pub fn extremes(values: impl IntoIterator<Item = f64>) -> [f64; 2] {
    let wider = |[low, high]: [f64; 2], value: f64| [low.min(value), high.max(value)];
    values.into_iter().fold([f64::INFINITY, f64::NEG_INFINITY], wider)
}

/// Largest difference of two numbers at the same place.
pub fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Quantile `part` (0 to 1) of `values`, which it reorders; linear interpolation, zero without values.
pub(crate) fn quantile(values: &mut [f64], part: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let place = part * (values.len() - 1) as f64;
    let (_, below, above) = values.select_nth_unstable_by(place as usize, f64::total_cmp);
    let next = above.iter().copied().min_by(f64::total_cmp).unwrap_or(*below);
    *below + place.fract() * (next - *below)
}

/// Median of the absolute values; zero without values.
pub(crate) fn median_size(values: impl Iterator<Item = f64>) -> f64 {
    quantile(&mut values.map(f64::abs).collect::<Vec<_>>(), 0.5)
}

/// Mean of the values without this fraction of them at either end.
pub(crate) fn trimmed_mean(mut values: Vec<f64>, part: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let ends = (part * values.len() as f64) as usize;
    let kept = values.get(ends..values.len() - ends).filter(|kept| !kept.is_empty())?;
    Some(kept.iter().sum::<f64>() / kept.len() as f64)
}
