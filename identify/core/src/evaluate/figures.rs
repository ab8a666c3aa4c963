//! Summary statistics of a set of numbers.

use crate::statistics::quantile;

/// Mean, median, 95 % quantile and maximum of a set.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Quantiles {
    /// Arithmetic mean of the set.
    pub mean: f64,
    /// 50 % quantile of the set.
    pub median: f64,
    /// 95 % quantile of the set.
    pub p95: f64,
    /// Largest value of the set.
    pub max: f64,
}

impl Quantiles {
    /// Statistics of a set; zeros for an empty one.
    pub fn of(mut values: Vec<f64>) -> Self {
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        let [median, p95, max] = [0.5, 0.95, 1.0].map(|part| quantile(&mut values, part));
        Self { mean, median, p95, max }
    }
}

/// Root mean square; zero for an empty set.
pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum) = values.fold((0usize, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    (sum / count.max(1) as f64).sqrt()
}
