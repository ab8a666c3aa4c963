//! Why measured rows cannot be used.

use super::implausible::Likely;
use crate::calibrate::ball_bar::CalibrateError;
use crate::model::ModelError;

/// Why measured rows cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RowError {
    /// Too few rows for the unknowns.
    #[error("{rows} usable rows are too few, at least {needed} are needed; measure more poses")]
    TooFewRows {
        /// Rows left for fitting.
        rows: usize,
        /// Least number.
        needed: usize,
    },
    /// A row is not a measurement.
    #[error("row {row} has {what}; take it out or mend it")]
    BadRow {
        /// Row from 1.
        row: usize,
        /// What is wrong.
        what: &'static str,
    },
    /// Options that make no sense.
    #[error("option {option} is {value}; {remedy}")]
    BadOption {
        /// Field of [`super::RowOptions`].
        option: &'static str,
        /// As given.
        value: f64,
        /// What to give.
        remedy: &'static str,
    },
    /// No place of the tracker follows from the positions.
    #[error(
        "the measured positions lie on a line or in a point: where the tracker stands does not follow; \
         measure poses further apart"
    )]
    PosesOnALine,
    /// No anchor follows from positions and lengths.
    #[error(
        "no anchor fits the lengths: the poses lie in a plane or too close together; measure poses further apart"
    )]
    NoAnchor,
    /// Most rows contradict the rest.
    #[error(
        "only {kept} of {rows} fitting rows agree with each other; check units, signs and zero of the joint angles and \
         the unit of the lengths"
    )]
    TooManyRejected {
        /// Rows that agree.
        kept: usize,
        /// Fitting rows.
        rows: usize,
    },
    /// No robot like the configured one gives such rows.
    #[error("{found}; {}", .likely.map_or_else(
        || "rows, their mapping or the robot's file are wrong; see `identify inspect --propose`".to_owned(),
        |likely| format!("most likely {likely}; mend the mapping or the robot's file"),
    ))]
    Implausible {
        /// What gave it away.
        found: String,
        /// What went wrong.
        likely: Option<Likely>,
    },
    /// From the model.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// From the estimate.
    #[error(transparent)]
    Calibrate(#[from] CalibrateError),
}
