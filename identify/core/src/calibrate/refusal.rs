//! Refusals taken apart: a page says more of them than a line on a terminal.

use super::error::CalibrateError;
use super::selection::structure::StructureError;
use crate::cost::CostError;
use crate::prepare::{Deviations, Place};
use crate::solver::SolveError;

/// Why the data gave no calibration.
#[derive(Debug, Clone)]
pub struct Refusal<'e> {
    /// As on the terminal: what is wrong, then what to do.
    pub message: String,
    /// Which run, from 0; none where it is all of them together.
    pub run: Option<usize>,
    /// Where in that run.
    pub place: Place,
    /// What it rests on, where the logs of the run were brought together before it.
    pub deviations: Option<&'e Deviations>,
}

impl CalibrateError {
    /// The refusal; none where the data are not to blame: something was mistyped, or somebody ended the solve.
    pub fn refusal(&self) -> Option<Refusal<'_>> {
        let of_data = match self {
            Self::Model(_) | Self::Structure(StructureError::Model(_)) => false,
            Self::NoRun | Self::Selection(_) | Self::NoEffect { .. } => false,
            Self::Prepare { error, .. } => !error.is_mistyped(),
            Self::Cost(error) | Self::Structure(StructureError::Cost(error)) => cost_is_of_data(error),
            Self::Solve(error) | Self::Structure(StructureError::Solve(error)) => solve_is_of_data(error),
            Self::NoPlace { .. } | Self::Rows { .. } | Self::Implausible { .. } => true,
            Self::Align { .. } => true,
            Self::Unidentifiable(_) | Self::NotConverged { .. } => true,
        };
        let of_all = of_data.then(|| of_all(self.to_string()))?;
        Some(match self {
            Self::Prepare { run, error } => {
                Refusal { run: Some(*run), place: error.place(), deviations: error.deviations(), ..of_all }
            }
            _ => of_all,
        })
    }
}

impl CalibrateError {
    /// The samples that were given did not lead a solve to its end.
    pub(super) fn is_of_solve(&self) -> bool {
        match self {
            Self::Solve(error) => solve_is_of_data(error),
            Self::Unidentifiable(_) | Self::NotConverged(_) => true,
            _ => false,
        }
    }
}

fn of_all(message: String) -> Refusal<'static> {
    Refusal { message, run: None, place: Place::default(), deviations: None }
}

fn cost_is_of_data(error: &CostError) -> bool {
    !matches!(error, CostError::BadSigma { .. })
}

/// Nothing was freed, or somebody pressed Ctrl-C.
fn solve_is_of_data(error: &SolveError) -> bool {
    !matches!(error, SolveError::NothingFree | SolveError::Cancelled { .. })
}
