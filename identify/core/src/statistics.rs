//! Statistics of sequences of numbers: means, medians, quantiles and extremes.

use std::borrow::Borrow;

use serde::{Deserialize, Serialize};

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

/// The median of `values`, or `None` without values. For an even number of values, it is the larger of the two
/// middle values. Reorders `values`.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Smallest and largest value. Without values the result is `[INFINITY, NEG_INFINITY]`.
pub fn extremes(values: impl IntoIterator<Item = f64>) -> [f64; 2] {
    let wider = |[low, high]: [f64; 2], value: f64| [low.min(value), high.max(value)];
    values.into_iter().fold([f64::INFINITY, f64::NEG_INFINITY], wider)
}

/// Largest absolute value; zero without values.
pub(crate) fn largest_size(values: impl IntoIterator<Item: Borrow<f64>>) -> f64 {
    values.into_iter().map(|value| value.borrow().abs()).fold(0.0, f64::max)
}

/// Largest absolute difference of two numbers at the same index.
pub fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    largest_size(a.iter().zip(b).map(|(a, b)| a - b))
}

/// Quantile of `values` at the fraction `part` (0 to 1), by linear interpolation; zero without values. Reorders `values`.
pub(crate) fn quantile(values: &mut [f64], part: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let place = part * (values.len() - 1) as f64;
    let (_, below, above) = values.select_nth_unstable_by(place as usize, f64::total_cmp);
    let next = above.iter().copied().min_by(f64::total_cmp).unwrap_or(*below);
    *below + place.fract() * (next - *below)
}

/// Statistics of the magnitudes of errors, all in one unit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Sizes {
    /// Arithmetic mean of the sizes.
    pub mean: f64,
    /// Root of the mean square.
    pub rms: f64,
    /// 50 % quantile. It is not stored in files, and is therefore zero after reading a file.
    #[serde(skip)]
    pub median: f64,
    /// 95 % quantile.
    pub p95: f64,
    /// Largest of the sizes.
    pub max: f64,
}

impl Sizes {
    /// Statistics of these sizes; zeros for an empty set.
    pub fn from_values(sizes: impl Iterator<Item = f64>) -> Self {
        let mut sizes: Vec<f64> = sizes.collect();
        let (mean, rms) = (mean(&sizes), rms(&sizes));
        let [median, p95, max] = [0.5, 0.95, 1.0].map(|part| quantile(&mut sizes, part));
        Self { mean, rms, median, p95, max }
    }
}

/// Median of the absolute values; zero without values.
pub(crate) fn median_size(values: impl Iterator<Item = f64>) -> f64 {
    quantile(&mut values.map(f64::abs).collect::<Vec<_>>(), 0.5)
}

/// Trimmed mean: the mean after a fraction `part` of the values has been removed at each end, the smallest values at one end
/// and the largest at the other. `None` if no values remain.
pub(crate) fn trimmed_mean(mut values: Vec<f64>, part: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let ends = (part * values.len() as f64) as usize;
    let kept = values.get(ends..values.len() - ends).filter(|kept| !kept.is_empty())?;
    Some(mean(kept))
}
