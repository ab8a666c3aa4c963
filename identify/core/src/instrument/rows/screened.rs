//! Detects outliers among rows. Residuals at a solution are compared with a robust standard deviation, which is computed
//! from their median. The outliers are determined again after each solve. There are two types: single rows with gross
//! residuals, and faulty runs, which are consecutive rows with a common error.

use super::{MEDIAN_OF_ONE, Standing, sigma_by_median};
use crate::instrument::PoseError;
use crate::statistics::median_size;

/// A single row is an outlier if its residual exceeds this number of standard deviations. No row of a normal distribution
/// does, and only few rows of a heavy-tailed distribution do.
const GROSS: f64 = 8.0;

/// Reason why a row is excluded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rejection {
    /// The flange position reported by the controller contradicts the joint angles.
    FlangeContradicts {
        /// Distance between the two flange positions \[m\].
        distance_m: f64,
    },
    /// The measurement is far from the prediction of all other rows.
    GrossResidual {
        /// Predicted minus measured length, or distance between predicted and measured position \[m\].
        residual_m: f64,
    },
    /// The row is in a faulty run: consecutive rows with a common error.
    FaultyRun {
        /// Median of the absolute residuals of the row and its neighbours \[m\]. Each residual is
        /// divided by the relative noise of its row.
        median_m: f64,
    },
}

/// A row that is excluded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RejectedRow {
    /// Number of the row, from 0.
    pub row: usize,
    /// Reason why it is excluded.
    pub why: Rejection,
}

/// The rows of one file, with the outliers that are currently excluded.
#[derive(Debug, Clone)]
pub(in crate::instrument) struct Screened<R> {
    /// All rows of the file.
    pub(in crate::instrument) all: Standing<R>,
    /// Outliers among `all`, in ascending order.
    pub(in crate::instrument) rejected: Vec<RejectedRow>,
    /// The rows of `all` that are not outliers.
    pub(in crate::instrument) at: Standing<R>,
}

impl<R: Copy> Screened<R> {
    /// Creates the rows without outliers: all rows are used.
    pub(in crate::instrument) fn new(all: Standing<R>) -> Self {
        Self { rejected: Vec::new(), at: all.clone(), all }
    }

    /// Sets the groups, see [`Standing::group`]. Must be called while all rows are used.
    pub(in crate::instrument) fn group(&mut self, groups: &[usize], seed: u64) {
        self.all.group(groups, seed);
        self.at.group(groups, seed);
    }

    /// Determines the outliers from the residuals of all rows \[m\], and from the noise of all rows relative to the median
    /// row. Returns whether the set of used rows has changed. If more than half of the rows are outliers, or if the other
    /// rows are not sufficient, nothing changes.
    pub(in crate::instrument) fn screen(
        &mut self,
        residuals_m: &[f64],
        relative_noise: &[f64],
        are_sufficient: impl Fn(&[R]) -> bool,
    ) -> bool {
        let all: Vec<usize> = (0..residuals_m.len()).collect();
        let kept = without(&all, &self.rejected);
        let rejected = faulty(residuals_m, relative_noise, &all, &kept);
        let number = |rejected: &RejectedRow| rejected.row;
        let same = rejected.iter().map(number).eq(self.rejected.iter().map(number));
        if same || 2 * rejected.len() > all.len() {
            return false;
        }
        let used = self.all.chosen(&without(&all, &rejected));
        if !are_sufficient(&used.rows) {
            return false;
        }
        (self.at, self.rejected) = (used, rejected);
        true
    }
}

/// Finds rows that a fit must not use. There are two types. The first is a single fitted row with a gross
/// residual. The second is a faulty run: rows among which most fitted rows have large residuals. All rows of a
/// faulty run are returned, fitted or held out.
///
/// `residuals_m` contains the residuals of all rows \[m\]. `relative_noise` is relative to the median row. `fitting`
/// contains the fitted rows. The standard deviation of the residuals is estimated from the rows `kept`.
pub(crate) fn faulty(
    residuals_m: &[f64],
    relative_noise: &[f64],
    fitting: &[usize],
    kept: &[usize],
) -> Vec<RejectedRow> {
    /// A row belongs to a faulty run if the median absolute residual of neighbouring rows exceeds this number of standard
    /// deviations. If errors are independent, less than one row in a million exceeds it.
    const RUN: f64 = 3.0;
    // Divide residuals by the relative noise. The results have the noise of the median row.
    let scaled_m: Vec<f64> = residuals_m.iter().zip(relative_noise).map(|(r, noise)| r / noise).collect();
    let sigma_m = sigma_by_median(kept.iter().map(|&row| scaled_m[row]), MEDIAN_OF_ONE);
    let single = |&row: &usize| {
        let is_gross = scaled_m[row].abs() > GROSS * sigma_m;
        let residual_m = residuals_m[row];
        is_gross.then_some(RejectedRow { row, why: Rejection::GrossResidual { residual_m } })
    };
    let in_run = |row: usize| {
        let median_m = neighbour_median_m(&scaled_m, fitting, row);
        let is_faulty = median_m > RUN * sigma_m;
        is_faulty.then_some(RejectedRow { row, why: Rejection::FaultyRun { median_m } })
    };
    let mut rejected: Vec<RejectedRow> = (0..scaled_m.len()).filter_map(in_run).collect();
    let outside_runs: Vec<usize> = without(fitting, &rejected);
    rejected.extend(outside_runs.iter().filter_map(single));
    rejected.sort_by_key(|rejected| rejected.row);
    rejected
}

/// Finds rows that are far from both the nominal and the calibrated robot. Uses the errors of all rows and their noise
/// relative to the median row.
pub(crate) fn gross_rows(
    nominal: &[PoseError],
    calibrated: &[PoseError],
    relative_noise: &[f64],
) -> Vec<bool> {
    /// Limit of the distance from the nominal robot, in robust standard deviations of distances. It corresponds to about
    /// seven standard deviations of a single coordinate.
    const OF_NOMINAL: f64 = 3.0;
    let far_from_nominal = beyond(nominal, relative_noise, OF_NOMINAL);
    let far_from_calibrated = beyond(calibrated, relative_noise, GROSS);
    far_from_nominal.iter().zip(&far_from_calibrated).map(|(a, b)| *a && *b).collect()
}

/// For each error, whether its position or its rotation exceeds this number of robust standard deviations.
fn beyond(errors: &[PoseError], relative_noise: &[f64], sigmas: f64) -> Vec<bool> {
    // Divide errors by the relative noise. The results have the noise of the median row.
    let scaled = |(error, noise): (&PoseError, &f64)| PoseError {
        position_m: error.position_m / noise,
        rotation_rad: error.rotation_rad.map(|angle| angle / noise),
    };
    let errors: Vec<PoseError> = errors.iter().zip(relative_noise).map(scaled).collect();
    let sizes: [Vec<f64>; 2] = [
        errors.iter().map(|error| error.position_m).collect(),
        errors.iter().filter_map(|error| error.rotation_rad).collect(),
    ];
    let limits = sizes.map(|sizes| sigmas * sigma_by_median(sizes.into_iter(), MEDIAN_OF_ONE));
    let is_beyond = |error: &PoseError| {
        error.position_m > limits[0] || error.rotation_rad.is_some_and(|angle| angle > limits[1])
    };
    errors.iter().map(is_beyond).collect()
}

/// Returns the larger one of two medians of absolute residuals: of the fitted rows just before a row, and of those just
/// after it. A faulty run ends abruptly, so at its edge only the rows on one side have large residuals.
fn neighbour_median_m(residuals_m: &[f64], fitting: &[usize], row: usize) -> f64 {
    const ROWS_EACH_SIDE: usize = 5;
    // If the row itself is fitted, it counts as a row of both sides.
    let begin = fitting.partition_point(|&fitting_row| fitting_row < row);
    let end = begin + usize::from(fitting.get(begin) == Some(&row));
    let sides = [end.saturating_sub(ROWS_EACH_SIDE)..end, begin..(begin + ROWS_EACH_SIDE).min(fitting.len())];
    // Ignore a side that has too few rows for a median.
    let complete = sides.into_iter().filter(|side| side.len() == ROWS_EACH_SIDE);
    complete.map(|side| median_size(fitting[side].iter().map(|&row| residuals_m[row]))).fold(0.0, f64::max)
}

/// The rows that are not in `rejected`, which is in ascending order.
pub(crate) fn without(rows: &[usize], rejected: &[RejectedRow]) -> Vec<usize> {
    rows.iter().copied().filter(|row| rejected.binary_search_by_key(row, |one| one.row).is_err()).collect()
}
