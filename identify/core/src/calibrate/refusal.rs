//! Converts a [`CalibrateError`] to a refusal in structured form. A refusal is an error whose cause is in the data. Reports
//! use it to show more than the message for the terminal.

use super::error::CalibrateError;
use crate::cost::CostError;
use crate::instrument::RowError;
use crate::prepare::{Deviations, Place};
use crate::solver::SolveError;

/// A refusal: the reason why the data do not give a calibration.
#[derive(Debug, Clone)]
pub struct CalibrationRefusal<'e> {
    /// Message as on the terminal: first the problem, then the remedy.
    pub message: String,
    /// Index of the run, from 0; `None` if the refusal concerns all data.
    pub run: Option<usize>,
    /// Location of the problem within that run.
    pub place: Place,
    /// Residuals on which the refusal is based. `None` if the logs of the run could not be aligned.
    pub deviations: Option<&'e Deviations>,
}

impl CalibrateError {
    /// Converts the error to a refusal. Returns `None` if the cause is not in the data. Examples are an
    /// invalid option or a cancelled solve.
    pub fn refusal(&self) -> Option<CalibrationRefusal<'_>> {
        let of_data = match self {
            Self::Model(_) | Self::NoRun | Self::Selection(_) | Self::NoEffect { .. } => false,
            Self::Prepare { error, .. } => !error.is_mistyped(),
            Self::Cost(error) => !matches!(error, CostError::BadSigma { .. }),
            Self::Solve(error) => solve_is_of_data(error),
            Self::NoPlace { .. } | Self::Rows { .. } | Self::Implausible { .. } => true,
            Self::Align { .. } => true,
            Self::Unidentifiable(_) | Self::NotConverged(_) | Self::NoFreedom(_) => true,
        };
        let (run, place, deviations) = match self {
            Self::Prepare { run, error } => (Some(*run), error.place(), error.deviations()),
            _ => (None, Place::default(), None),
        };
        of_data.then(|| CalibrationRefusal { message: self.to_string(), run, place, deviations })
    }

    /// Whether a mistake in a file of rows may be the cause of this error.
    pub(super) fn may_be_a_mistake(&self) -> bool {
        matches!(self, Self::Rows { error: RowError::OtherRobot { .. }, .. }) || self.may_need_all_rows()
    }

    /// Whether the rows that remain after rows were held out may be too few, which causes this error.
    pub(super) fn may_need_all_rows(&self) -> bool {
        matches!(self, Self::NoPlace { .. }) || self.is_of_solve()
    }

    /// The message of an error that [may be a mistake](Self::may_be_a_mistake), without its remedy. In these messages the
    /// problem ends at the first semicolon, which a test checks for each of them.
    pub(super) fn problem(&self) -> String {
        let message = self.to_string();
        message.split_once("; ").map_or(message.as_str(), |(problem, _)| problem).to_owned()
    }

    /// Whether this error means that a solve failed because of the samples.
    pub(super) fn is_of_solve(&self) -> bool {
        match self {
            Self::Solve(error) => solve_is_of_data(error),
            Self::Unidentifiable(_) | Self::NotConverged(_) => true,
            _ => false,
        }
    }
}

/// Whether the samples caused this error of a solve. False if no parameter was free or the solve was cancelled.
fn solve_is_of_data(error: &SolveError) -> bool {
    !matches!(error, SolveError::NothingFree | SolveError::Cancelled { .. })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::{NotConverged, Summary, Termination, Unidentifiable};

    #[test]
    fn the_problem_of_an_error_that_may_be_a_mistake_is_its_message_without_the_remedy() {
        let (what, fix) = ("ra1|ox; rd2|rd3".into(), "ra1,rd2".into());
        let summary = Summary {
            termination: Termination::NoDecrease,
            iterations: 7,
            evaluations: 9,
            cost_end: 1.0,
            residual_rms_start: 1.0,
            residual_rms: 1.0,
            samples_used: 50,
            samples_left_out: 0,
        };
        let other_robot = RowError::OtherRobot { rejected: 40, rows: 80, median_mm: 300.0 };
        let cases: [(CalibrateError, &str); 7] = [
            (CalibrateError::Rows { data_set: 2, error: other_robot }, "by 300 mm in the median"),
            (CalibrateError::NoPlace { data_set: 2 }, "at a point"),
            (SolveError::NoSamples { samples: 80 }.into(), "at the initial values"),
            (SolveError::NotFinite { sample: 3 }.into(), "at the initial values"),
            (SolveError::Dependent.into(), "depend on each other"),
            (Unidentifiable { rank: 1, columns: 3, what, fix }.into(), "parameters are identified"),
            (NotConverged { summary }.into(), "residual RMS 1.000e0)"),
        ];
        for (error, end) in cases {
            assert!(error.may_be_a_mistake() && error.problem().ends_with(end), "{}", error.problem());
        }
    }
}
