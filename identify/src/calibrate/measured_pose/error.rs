//! Why measured poses cannot be used.

use super::implausible::Likely;
use crate::calibrate::ball_bar::CalibrateError;
use crate::model::ModelError;

/// Why measured poses cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PoseError {
    /// Too few rows for the unknowns.
    #[error("{rows} usable rows are too few, at least {needed} are needed; measure more poses")]
    TooFewRows {
        /// Rows left for fitting.
        rows: usize,
        /// Least number.
        needed: usize,
    },
    /// A row is not a measurement.
    #[error("row {row} has a number that is not finite; take it out or mend it")]
    BadRow {
        /// Row from 1.
        row: usize,
    },
    /// Options that make no sense.
    #[error("option {option} is {value}; {remedy}")]
    BadOption {
        /// Field of [`super::PoseOptions`].
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
