//! Errors of a calibration.

use super::rows::Likely;
use crate::cost::CostError;
use crate::instrument::RowError;
use crate::model::ModelError;
use crate::prepare::PrepareError;
use crate::solver::{NoFreedom, NotConverged, SolveError, Unidentifiable};

/// Reason why a calibration failed.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// The logs of a run cannot be aligned, or are insufficient.
    #[error("{error}")]
    Prepare {
        /// Index of the run, from 0.
        run: usize,
        /// Error of the preparation.
        error: Box<PrepareError>,
    },
    /// A parameter named in the configuration does not exist, or a prior is invalid.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The samples lack data that the cost needs.
    #[error(transparent)]
    Cost(#[from] CostError),
    /// The solve could not start, or was cancelled.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// The input contains neither a ball-bar run nor a file of rows.
    #[error("there is no run to calibrate from; give at least one recording with its robot log")]
    NoRun,
    /// The selection of free parameters is only available in studies, not in calibrations.
    #[error(
        "selection = \"{0}\" is only for studies (`identify study`); leave it out, and change with `free` and `fix` which \
         parameters are estimated"
    )]
    Selection(&'static str),
    /// The configuration sets an option that only affects ball-bar runs, but the input contains none.
    #[error(
        "option `{option}` has an effect only on runs with the ball-bar, and there are none; leave it out"
    )]
    NoEffect {
        /// Key in the configuration.
        option: &'static str,
    },
    /// The rows do not determine the pose of the instrument.
    #[error(
        "data set {data_set}: the rows do not determine the position of the instrument: they lie in a plane, on a line or at a \
         point; measure poses that differ in all three directions"
    )]
    NoPlace {
        /// Number of the data set, from 1. The order is: ball-bars, trackers, wires, contacts, touches.
        data_set: usize,
    },
    /// The logs of a tracker and of the robot cannot be aligned.
    #[error("data set {data_set}: {error}")]
    Align {
        /// Number of the data set, from 1. The order is: ball-bars, trackers, wires, contacts, touches.
        data_set: usize,
        /// Error of the alignment.
        error: Box<PrepareError>,
    },
    /// The rows of a file are insufficient or invalid.
    #[error("data set {data_set}: {error}")]
    Rows {
        /// Number of the data set, from 1. The order is: ball-bars, trackers, wires, contacts, touches.
        data_set: usize,
        /// Error of the rows.
        error: RowError,
    },
    /// The rows are not plausible for the configured robot.
    #[error("{found}; {}", .likely.map_or_else(
        || "check the rows, their mapping and the robot's file; `identify inspect --propose` proposes a mapping".to_owned(),
        |likely| format!("most likely {likely}; correct the mapping or the robot's file"),
    ))]
    Implausible {
        /// Observations that show that the rows are not plausible.
        found: String,
        /// Mistake that explains the rows best: in the file, in its mapping or in the robot's file. `None` if
        /// no known mistake explains the rows.
        likely: Option<Likely>,
    },
    /// The samples do not determine all free parameters.
    #[error(transparent)]
    Unidentifiable(#[from] Unidentifiable),
    /// The solve did not converge to a minimum.
    #[error(transparent)]
    NotConverged(#[from] NotConverged),
    /// The samples do not determine any uncertainty.
    #[error(transparent)]
    NoFreedom(#[from] NoFreedom),
}
