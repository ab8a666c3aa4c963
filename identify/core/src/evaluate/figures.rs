//! Summary statistics of a set of numbers.

use crate::statistics::{mean, quantile};

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
        let mean = mean(&values);
        let [median, p95, max] = [0.5, 0.95, 1.0].map(|part| quantile(&mut values, part));
        Self { mean, median, p95, max }
    }
}
