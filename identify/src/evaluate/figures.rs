//! Figures of a set of numbers.

/// Mean, median, 95 % and largest of a set.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Quantiles {
    /// Arithmetic mean.
    pub mean: f64,
    /// Half of the set is below.
    pub median: f64,
    /// 95 % of the set is below.
    pub p95: f64,
    /// Largest.
    pub max: f64,
}

impl Quantiles {
    /// Of a set; zeros for an empty one.
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        Self {
            mean: values.iter().sum::<f64>() / values.len().max(1) as f64,
            median: quantile(&values, 0.5),
            p95: quantile(&values, 0.95),
            max: quantile(&values, 1.0),
        }
    }
}

/// The value that this part of an ascending set does not exceed (nearest rank); zero for an empty one.
pub(super) fn quantile(ascending: &[f64], part: f64) -> f64 {
    let rank = (part * ascending.len() as f64).ceil().max(1.0) as usize;
    ascending.get(rank.min(ascending.len()).saturating_sub(1)).copied().unwrap_or(0.0)
}

/// Root of the mean square; zero for an empty set.
pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum) = values.fold((0usize, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    (sum / count.max(1) as f64).sqrt()
}
