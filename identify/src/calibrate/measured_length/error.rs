//! Why measured lengths cannot be used.

use crate::calibrate::ball_bar::CalibrateError;
use crate::model::ModelError;

/// Why lengths cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LengthError {
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
        /// Field of [`super::LengthOptions`].
        option: &'static str,
        /// As given.
        value: f64,
        /// What to give.
        remedy: &'static str,
    },
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
    /// No anchor follows from positions and lengths.
    #[error(
        "no anchor fits the lengths: the poses lie in a plane or too close together; measure poses further apart"
    )]
    NoAnchor,
    /// From the model.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// From the estimate.
    #[error(transparent)]
    Calibrate(#[from] CalibrateError),
}
