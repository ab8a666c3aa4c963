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
        matches!(self, Self::Rows { error: RowError::OtherRobot { .. }, .. }) || self.is_of_solve()
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
