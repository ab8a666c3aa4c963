//! Why there is no calibration.

use super::rows::Likely;
use super::selection::structure::StructureError;
use crate::cost::CostError;
use crate::instrument::RowError;
use crate::model::ModelError;
use crate::prepare::PrepareError;
use crate::solver::{NotConverged, SolveError, Unidentifiable};

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// The logs do not fit together, or are not enough.
    #[error("{error}")]
    Prepare {
        /// Which run, from 0.
        run: usize,
        /// What is wrong with it.
        error: Box<PrepareError>,
    },
    /// A named parameter or prior does not exist.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The samples do not suit the cost.
    #[error(transparent)]
    Cost(#[from] CostError),
    /// The solve could not start.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// What the samples determine cannot be found.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// Nothing was given.
    #[error("there is no run to calibrate from; give at least one recording with its robot log")]
    NoRun,
    /// Another set of free parameters than that which calibrations have.
    #[error(
        "`selection` is \"{0}\", which is for the estimators of a study (`identify study`); leave it out, and change with `free` \
         and `fix` what is free"
    )]
    Selection(&'static str),
    /// An option that has no effect on rows.
    #[error("option `{option}` is for runs with the ball-bar, and there are none; leave it out")]
    NoEffect {
        /// In the configuration.
        option: &'static str,
    },
    /// Where an instrument stands does not follow from its rows.
    #[error(
        "data set {data_set}: where the instrument stands does not follow from its rows, which lie in a plane, on a line or \
         in a point; measure poses further apart"
    )]
    NoPlace {
        /// From 1: ball-bars, trackers, wires, contacts, each in their order.
        data_set: usize,
    },
    /// A tracker's log and the robot's do not fit together.
    #[error("data set {data_set}: {error}")]
    Align {
        /// From 1: ball-bars, trackers, wires, contacts, each in their order.
        data_set: usize,
        /// What is wrong with them.
        error: Box<PrepareError>,
    },
    /// Rows that calibrate no robot.
    #[error("data set {data_set}: {error}")]
    Rows {
        /// From 1: ball-bars, trackers, wires, contacts, each in their order.
        data_set: usize,
        /// What is wrong with it.
        error: RowError,
    },
    /// No robot like the configured one gives such rows.
    #[error("{found}; {}", .likely.map_or_else(
        || "rows, their mapping, the table of sockets or the robot's file are wrong; see `identify inspect --propose`".to_owned(),
        |likely| format!("most likely {likely}; mend the mapping or the robot's file"),
    ))]
    Implausible {
        /// What gave it away.
        found: String,
        /// What went wrong.
        likely: Option<Likely>,
    },
    /// The samples do not determine what is free.
    #[error(transparent)]
    Unidentifiable(#[from] Unidentifiable),
    /// The solve ended elsewhere than at a minimum.
    #[error(transparent)]
    NotConverged(#[from] NotConverged),
}
