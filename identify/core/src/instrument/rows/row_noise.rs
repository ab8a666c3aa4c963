//! Noise of rows whose file states it: an instrument knows its own uncertainty, but not what the robot adds to all rows alike, which is
//! found in the residuals.

use crate::statistics::median_size;

/// Median size of a standard normal number.
pub(in crate::instrument) const MEDIAN_OF_ONE: f64 = 0.6745;
/// Median of the norm of three.
pub(in crate::instrument) const MEDIAN_OF_THREE: f64 = 1.538;

/// Standard deviations of rows, in the unit of what is stated of them: `factor * sqrt(stated^2 + added^2)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::instrument) struct RowNoise {
    factor: f64,
    /// What the robot adds.
    added: f64,
}

impl RowNoise {
    /// Before anything is known all rows count the same.
    pub(in crate::instrument) const ALIKE: Self = Self { factor: 1.0, added: 1.0 };

    /// Behind errors, each with what is stated of its row. `median` is that of an error whose standard deviation is one.
    ///
    /// What errors are larger than is stated the robot adds, where half of the errors are within their median. Where they are
    /// smaller already, all that is stated is too large by one factor. Of rows of which nothing is stated all is added.
    pub(in crate::instrument) fn behind(
        errors: impl Iterator<Item = (f64, Option<f64>)>,
        median: f64,
    ) -> Self {
        /// Data without any noise still need a unit.
        const LEAST: f64 = 1e-9;
        const HALVINGS: usize = 40;
        let errors: Vec<(f64, f64)> = errors.map(|(error, stated)| (error, stated.unwrap_or(0.0))).collect();
        let usual = |added: f64| {
            median_size(errors.iter().map(|(error, stated)| error / stated.hypot(added))) / median
        };
        let most = (median_size(errors.iter().map(|(error, _)| *error)) / median).max(LEAST);
        let (mut low, mut high) = (0.0, most);
        if errors.iter().all(|(_, stated)| *stated == 0.0) {
            low = most;
        } else if usual(LEAST) <= 1.0 {
            return Self { factor: usual(LEAST).max(LEAST), added: LEAST };
        }
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if usual(middle) > 1.0 { low = middle } else { high = middle }
        }
        Self { factor: 1.0, added: high }
    }

    /// Of a row of which this is stated.
    pub(in crate::instrument) fn of(&self, stated: Option<f64>) -> f64 {
        self.factor * stated.unwrap_or(0.0).hypot(self.added)
    }

    /// Of each row, over that of the median one.
    pub(in crate::instrument) fn relative(&self, stated: impl Iterator<Item = Option<f64>>) -> Vec<f64> {
        let each: Vec<f64> = stated.map(|stated| self.of(stated)).collect();
        let usual = median_size(each.iter().copied());
        each.into_iter().map(|one| one / usual).collect()
    }
}
