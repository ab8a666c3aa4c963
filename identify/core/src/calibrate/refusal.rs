//! Refusals in structured form, from a [`CalibrateError`], for reports that show more than the message on a terminal.

use super::error::CalibrateError;
use crate::cost::CostError;
use crate::instrument::RowError;
use crate::prepare::{Deviations, Place};
use crate::solver::SolveError;

/// Reason why the data gave no calibration.
#[derive(Debug, Clone)]
pub struct CalibrationRefusal<'e> {
    /// Message as on the terminal: the problem, then the remedy.
    pub message: String,
    /// Index of the run, from 0; `None` if the refusal concerns all data.
    pub run: Option<usize>,
    /// Location of the problem within that run.
    pub place: Place,
    /// Deviations on which the refusal is based, if the logs of the run were aligned before it.
    pub deviations: Option<&'e Deviations>,
}

impl CalibrateError {
    /// The refusal; `None` for errors that are not due to the data, such as an invalid option or a cancelled solve.
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

    /// Whether a mistake in a file of rows may be the cause.
    pub(super) fn may_be_a_mistake(&self) -> bool {
        matches!(self, Self::Rows { error: RowError::OtherRobot { .. }, .. }) || self.is_of_solve()
    }

    /// Whether a solve failed because of the samples.
    pub(super) fn is_of_solve(&self) -> bool {
        match self {
            Self::Solve(error) => solve_is_of_data(error),
            Self::Unidentifiable(_) | Self::NotConverged(_) => true,
            _ => false,
        }
    }
}

/// False if no parameter was free or the solve was cancelled.
fn solve_is_of_data(error: &SolveError) -> bool {
    !matches!(error, SolveError::NothingFree | SolveError::Cancelled { .. })
}
