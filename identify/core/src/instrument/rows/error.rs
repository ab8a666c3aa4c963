//! Why measured rows cannot be used.

use crate::instrument::ContactError;

/// Why measured rows cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RowError {
    /// Too few rows for the unknowns.
    #[error(
        "{rows} usable rows remain for the fit beside the held-out ones, at least {needed} are needed; measure more poses"
    )]
    TooFewRows {
        /// Rows left for fitting.
        rows: usize,
        /// Least number of rows.
        needed: usize,
    },
    /// The controller's flange positions contradict the robot's file.
    #[error(
        "{rejected} of {rows} flange positions of the controller differ from those of the robot's file at the same joints, by \
         {median_mm:.0} mm in the median; give the file of this robot, or correct units and signs of joints or [flange] in the mapping"
    )]
    OtherRobot {
        /// Number of rows that contradict it.
        rejected: usize,
        /// Number of rows in the file.
        rows: usize,
        /// Median distance \[mm\].
        median_mm: f64,
    },
    /// Too few rows for one of several stations or targets.
    #[error(
        "{what} {number} has {rows} rows, at least {needed} are needed to find its place; measure more with it, or remove them"
    )]
    TooFewOfSetUp {
        /// Such as station or target.
        what: &'static str,
        /// From 1, in the order in which the file names them.
        number: usize,
        /// Rows of this station or target.
        rows: usize,
        /// Least number of rows.
        needed: usize,
    },
    /// More stations or targets than have parameters.
    #[error(
        "{count} {what}s, one file can have {most}; check the column of their names in the mapping, or make several \
         files"
    )]
    TooManySetUps {
        /// Such as station or target.
        what: &'static str,
        /// Number of stations or targets.
        count: usize,
        /// Most that have parameters.
        most: usize,
    },
    /// A row is not a measurement.
    #[error("row {row} has {what}; remove or correct it")]
    BadRow {
        /// Number of the row, from 1.
        row: usize,
        /// What is wrong with it.
        what: &'static str,
    },
    /// Most rows contradict the rest.
    #[error(
        "only {kept} of the {rows} rows of the fit agree with each other; check units, signs and zeros of the joint angles \
         and the unit of the lengths"
    )]
    TooManyRejected {
        /// Rows that agree with the rest.
        kept: usize,
        /// Rows that are fitted.
        rows: usize,
    },
    /// Error of the rows of a ball in sockets.
    #[error(transparent)]
    Contact(#[from] ContactError),
}
