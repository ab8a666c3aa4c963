//! Noise of rows, if the file states an uncertainty of each row. The stated uncertainty is that of the instrument. The robot
//! adds an error to every row. The size of these errors is estimated from the residuals.

use crate::statistics::median_size;

/// Median absolute value of a standard normal variable.
pub(in crate::instrument) const MEDIAN_OF_ONE: f64 = 0.6745;
/// Median norm of three independent standard normal variables.
pub(in crate::instrument) const MEDIAN_OF_THREE: f64 = 1.538;
/// Lower limit of a standard deviation. It is needed for data without any noise, because residuals are
/// divided by the standard deviation.
const LEAST: f64 = 1e-9;

/// Robust standard deviation of errors, most of which are normally distributed. `median` is the median absolute value of
/// errors whose standard deviation is one.
pub(in crate::instrument) fn sigma_by_median(errors: impl Iterator<Item = f64>, median: f64) -> f64 {
    (median_size(errors) / median).max(LEAST)
}

/// Model of the standard deviation of each row: `factor * sqrt(stated^2 + added^2)`, in the unit of the stated uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::instrument) struct RowNoise {
    factor: f64,
    /// Standard deviation of the errors that the robot adds.
    added: f64,
}

impl RowNoise {
    /// Almost the same noise for all rows, because `added` is much larger than any stated
    /// uncertainty. Used before the first solve.
    pub(in crate::instrument) const ALIKE: Self = Self { factor: 1.0, added: 1.0 };

    /// Estimates the noise from errors. Each error comes with the stated uncertainty of its row. `median` is the median
    /// absolute value of errors whose standard deviation is one.
    ///
    /// The errors are divided by their standard deviations. `added` is chosen so that the median absolute value of the
    /// results is `median`. If it is smaller than `median` even with the smallest `added`, the stated uncertainties are too
    /// large, and `factor` reduces them. If a row states no uncertainty, its standard deviation is `added` alone.
    pub(in crate::instrument) fn behind(
        errors: impl Iterator<Item = (f64, Option<f64>)>,
        median: f64,
    ) -> Self {
        const HALVINGS: usize = 40;
        let errors: Vec<(f64, f64)> = errors.map(|(error, stated)| (error, stated.unwrap_or(0.0))).collect();
        // Robust standard deviation of the errors, after each error is divided by its assumed standard deviation.
        // It decreases if `added` increases.
        let relative_sigma = |added: f64| {
            median_size(errors.iter().map(|(error, stated)| error / stated.hypot(added))) / median
        };
        let sigma = sigma_by_median(errors.iter().map(|(error, _)| *error), median);
        // Find `added` by bisection. If no row states an uncertainty, `added` is `sigma`.
        let (mut low, mut high) = (0.0, sigma);
        if errors.iter().all(|(_, stated)| *stated == 0.0) {
            low = sigma;
        } else if relative_sigma(LEAST) <= 1.0 {
            return Self { factor: relative_sigma(LEAST).max(LEAST), added: LEAST };
        }
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if relative_sigma(middle) > 1.0 { low = middle } else { high = middle }
        }
        Self { factor: 1.0, added: high }
    }

    /// Standard deviation of a row with this stated uncertainty.
    pub(in crate::instrument) fn sigma(&self, stated: Option<f64>) -> f64 {
        self.factor * stated.unwrap_or(0.0).hypot(self.added)
    }

    /// Standard deviation of each row, divided by that of the median row.
    pub(in crate::instrument) fn relative(&self, stated: impl Iterator<Item = Option<f64>>) -> Vec<f64> {
        let sigmas: Vec<f64> = stated.map(|stated| self.sigma(stated)).collect();
        let median = median_size(sigmas.iter().copied());
        sigmas.into_iter().map(|sigma| sigma / median).collect()
    }
}
