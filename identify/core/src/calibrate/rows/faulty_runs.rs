//! Finds possible causes of faulty runs, which are consecutive rows with a common error. Input: the rejected rows and the
//! residuals at the solution. To test a cause, its error is corrected in the rows of the run. The report lists the result,
//! so that the user can correct the file. The data are not changed.

use crate::instrument::{Instrument, Mistake, RejectedRow, Rejection};
use crate::logs::JointMistake;
use crate::model::Model;
use crate::statistics::{median_size, quantile};

/// Possible cause of the errors of a faulty run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RunCause {
    /// The offset of the instrument changed.
    ZeroMoved {
        /// Change of the offset \[m\].
        by_m: f64,
    },
    /// A joint was logged with the opposite sign.
    SignReversed {
        /// Number of the joint, from 1.
        joint: usize,
    },
}

/// Consecutive rows with a common error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FaultyRun {
    /// First row, from 0.
    pub first: usize,
    /// Last row, from 0.
    pub last: usize,
    /// Median of the absolute residuals \[m\].
    pub median_m: f64,
    /// The cause whose correction reduces the median most, if it reduces the median to a
    /// third or less. `None` if no cause does.
    pub cause: Option<RunCause>,
}

/// Finds the faulty runs among the rejected rows, which are in ascending order.
pub(super) fn runs(model: &Model, all: &Instrument, rejected: &[RejectedRow]) -> Vec<FaultyRun> {
    let faulty: Vec<usize> =
        rejected.iter().filter(|r| matches!(r.why, Rejection::FaultyRun { .. })).map(|r| r.row).collect();
    let residuals_m = all.residuals_m(&model.geometry(&[]));
    let consecutive = faulty.chunk_by(|a, b| a + 1 == *b);
    let run = |members: &[usize]| {
        let (&first, &last) = (members.first()?, members.last()?);
        let of_run_m = residuals_m.get(first..=last)?;
        let median_m = median_size(of_run_m.iter().copied());
        let cause = explain(model, &all.part(members), of_run_m, median_m);
        Some(FaultyRun { first, last, median_m, cause })
    };
    consecutive.filter_map(run).collect()
}

/// Finds the cause whose correction reduces the residuals of a run most. `rows` contains only the rows of the run.
/// `median_m` is the median of their absolute residuals.
fn explain(model: &Model, rows: &Instrument, residuals_m: &[f64], median_m: f64) -> Option<RunCause> {
    /// A cause must reduce the residuals to this fraction or less.
    const PART_LEFT: f64 = 1.0 / 3.0;
    (0..model.axes())
        .filter_map(|joint| sign_reversed(model, rows, joint))
        .chain([zero_moved(residuals_m)])
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .filter(|(corrected_m, _)| *corrected_m <= PART_LEFT * median_m)
        .map(|(_, cause)| cause)
}

/// Median of the absolute residuals after the sign of a joint is reversed \[m\].
fn sign_reversed(model: &Model, rows: &Instrument, joint: usize) -> Option<(f64, RunCause)> {
    let reversed = Mistake::Joints(JointMistake::Reversed(joint));
    let corrected = rows.undone(reversed, model.robot()).into_iter().next()?;
    let median_m = median_size(corrected.residuals_m(&model.geometry(&[])).into_iter());
    Some((median_m, RunCause::SignReversed { joint: joint + 1 }))
}

/// Median of the absolute residuals after a changed offset is corrected \[m\]. Residuals are robot minus measurement, so the
/// change of the offset is the negative median of the residuals.
fn zero_moved(residuals_m: &[f64]) -> (f64, RunCause) {
    let median_m = quantile(&mut residuals_m.to_vec(), 0.5);
    (median_size(residuals_m.iter().map(|r| r - median_m)), RunCause::ZeroMoved { by_m: -median_m })
}
