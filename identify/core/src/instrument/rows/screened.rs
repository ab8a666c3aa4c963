//! Rows without outliers, from residuals at a solution and a robust standard deviation (median). Outliers are determined again
//! after each solve: single rows with gross residuals, and runs of consecutive rows that are off together.

use super::{MEDIAN_OF_ONE, Standing, sigma_by_median};
use crate::instrument::PoseError;
use crate::statistics::median_size;

/// Standard deviations beyond which a single row is gross: no row of a normal distribution, and few rows of a heavy-tailed one.
const GROSS: f64 = 8.0;

/// Why a row is left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rejection {
    /// Controller position and joint angles contradict each other.
    FlangeContradicts {
        /// Distance of the two positions \[m\].
        distance_m: f64,
    },
    /// The measurement is far from the prediction of all other rows.
    GrossResidual {
        /// Predicted minus measured length, or distance of the two positions \[m\].
        residual_m: f64,
    },
    /// The row is in a run of rows that are off together.
    FaultyRun {
        /// Median size of the residuals of neighbouring rows \[m\].
        median_m: f64,
    },
}

/// A row that is left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RejectedRow {
    /// Number of the row, from 0.
    pub row: usize,
    /// Reason for leaving it out.
    pub why: Rejection,
}

/// Rows of one set-up, with and without outliers.
#[derive(Debug, Clone)]
pub(in crate::instrument) struct Screened<R> {
    /// All rows of the file.
    pub(in crate::instrument) all: Standing<R>,
    /// Outliers among `all`, ascending.
    pub(in crate::instrument) rejected: Vec<RejectedRow>,
    /// Rows of `all` in use.
    pub(in crate::instrument) at: Standing<R>,
}

impl<R: Copy> Screened<R> {
    /// All rows are in use.
    pub(in crate::instrument) fn new(all: Standing<R>) -> Self {
        Self { rejected: Vec::new(), at: all.clone(), all }
    }

    /// [`Standing::group`] while all rows are in use.
    pub(in crate::instrument) fn group(&mut self, groups: &[usize], seed: u64) {
        self.all.group(groups, seed);
        self.at.group(groups, seed);
    }

    /// Determines the outliers from the residuals of all rows \[m\] and their noise relative to the median row. Nothing changes
    /// if more than half of the rows were outliers, or if the other rows would not be sufficient. Returns whether the set of
    /// rows in use has changed.
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

/// Rows that a fit must not use: single rows of the fit (`fitting`) with gross residuals, and every row, also a held-out one,
/// inside a run in which most rows of the fit are off. `residuals_m` are of all rows \[m\], `relative_noise` is relative to the
/// median row; the standard deviation is that of the `kept` rows.
pub(crate) fn faulty(
    residuals_m: &[f64],
    relative_noise: &[f64],
    fitting: &[usize],
    kept: &[usize],
) -> Vec<RejectedRow> {
    /// Limit of the median of neighbouring rows, in standard deviations: independent rows exceed it less than once in a
    /// million.
    const RUN: f64 = 3.0;
    // As if all rows were as uncertain as the median one.
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

/// Rows that are far from both the nominal and the calibrated robot, from the errors of all rows and their noise relative to
/// the median row.
pub(crate) fn gross_rows(
    nominal: &[PoseError],
    calibrated: &[PoseError],
    relative_noise: &[f64],
) -> Vec<bool> {
    /// Limit for the nominal robot, in robust standard deviations of distances: about seven of a single coordinate.
    const OF_NOMINAL: f64 = 3.0;
    let far_from_nominal = beyond(nominal, relative_noise, OF_NOMINAL);
    let far_from_calibrated = beyond(calibrated, relative_noise, GROSS);
    far_from_nominal.iter().zip(&far_from_calibrated).map(|(a, b)| *a && *b).collect()
}

/// Errors of position or rotation that exceed this number of robust standard deviations.
fn beyond(errors: &[PoseError], relative_noise: &[f64], sigmas: f64) -> Vec<bool> {
    // As if all rows were as uncertain as the median one.
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

/// Median size of the residuals of the fitting rows just before or just after a row, whichever is larger: a run ends
/// sharply, and a row at its edge belongs to it.
fn neighbour_median_m(residuals_m: &[f64], fitting: &[usize], row: usize) -> f64 {
    const ROWS_EACH_SIDE: usize = 5;
    // A fitting row belongs to both sides.
    let begin = fitting.partition_point(|&fitting_row| fitting_row < row);
    let end = begin + usize::from(fitting.get(begin) == Some(&row));
    let sides = [end.saturating_sub(ROWS_EACH_SIDE)..end, begin..(begin + ROWS_EACH_SIDE).min(fitting.len())];
    // A side with few rows has no median to compare.
    let complete = sides.into_iter().filter(|side| side.len() == ROWS_EACH_SIDE);
    complete.map(|side| median_size(fitting[side].iter().map(|&row| residuals_m[row]))).fold(0.0, f64::max)
}

/// Rows that are not rejected.
pub(crate) fn without(rows: &[usize], rejected: &[RejectedRow]) -> Vec<usize> {
    rows.iter().copied().filter(|row| rejected.binary_search_by_key(row, |one| one.row).is_err()).collect()
}
