//! Errors of rows: reasons why measured rows cannot be used.

/// Reason why measured rows cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RowError {
    /// There are fewer rows than the number of unknowns requires.
    #[error(
        "{rows} usable rows remain for the fit beside the held-out ones, at least {needed} are needed; measure more poses"
    )]
    TooFewRows {
        /// Number of rows that remain for the fit.
        rows: usize,
        /// Minimum number of rows.
        needed: usize,
    },
    /// The controller's flange positions contradict the robot's file.
    #[error(
        "{rejected} of {rows} flange positions of the controller differ from those of the robot's file at the same joints, by \
         {median_mm:.0} mm in the median; give the file of this robot, or correct units and signs of joints or [flange] in the mapping"
    )]
    OtherRobot {
        /// Number of rows whose flange position contradicts the file.
        rejected: usize,
        /// Number of rows in the file.
        rows: usize,
        /// Median distance between the two flange positions \[mm\].
        median_mm: f64,
    },
    /// There are two or more stations or targets, and one of them has too few rows.
    #[error(
        "{what} {number} has {rows} rows, at least {needed} are needed to estimate its position; measure more with it, or remove them"
    )]
    TooFewOfSetUp {
        /// Type of the part, such as station or target.
        what: &'static str,
        /// Number of the station or target, from 1, in the order in which the file names them.
        number: usize,
        /// Number of rows of this station or target.
        rows: usize,
        /// Minimum number of rows.
        needed: usize,
    },
    /// The file contains more stations or targets than a model has parameters for.
    #[error(
        "{count} {what}s, one file can have {most}; check the column of their names in the mapping, or make several \
         files"
    )]
    TooManySetUps {
        /// Type of the part, such as station or target.
        what: &'static str,
        /// Number of stations or targets.
        count: usize,
        /// Maximum number for which a model has parameters.
        most: usize,
    },
    /// A row contains an invalid number.
    #[error("row {row} has {what}; remove or correct it")]
    BadRow {
        /// Number of the row, from 1.
        row: usize,
        /// Description of the invalid number.
        what: &'static str,
    },
    /// Most of the fitted rows contradict each other.
    #[error(
        "only {kept} of the {rows} rows of the fit agree with each other; check units, signs and zeros of the joint angles \
         and the unit of the lengths"
    )]
    TooManyRejected {
        /// Number of fitted rows that agree with each other.
        kept: usize,
        /// Number of fitted rows.
        rows: usize,
    },
    /// A row names a socket that the table of sockets does not contain.
    #[error("row {row} is of a socket that the table of sockets does not have; correct one of them")]
    UnknownSocket {
        /// Number of the row, from 1.
        row: usize,
    },
    /// All rows are of the same socket.
    #[error(
        "all rows are of socket `{socket}`: they do not determine the scale of the robot; seat the ball in at least two sockets whose \
         distance is known"
    )]
    OneSocket {
        /// Name of the only visited socket.
        socket: String,
    },
    /// All rows of a socket have the same posture.
    #[error(
        "the rows of socket `{socket}` have one posture, which contains no information; seat the ball in it in at least two postures, or \
         remove these rows"
    )]
    VisitedOnce {
        /// Name of the socket with one posture.
        socket: String,
    },
    /// No distance between the visited sockets is known.
    #[error(
        "no distance is known between the sockets of these rows ({}): they do not determine the scale of the robot; give places \
         or distances of at least two of them",
        .sockets.join(", ")
    )]
    NoDistance {
        /// Names of the visited sockets.
        sockets: Vec<String>,
    },
    /// There are fewer rows in sockets than the number of unknowns requires.
    #[error(
        "{rows} rows in {sockets} sockets are too few, at least {needed} are needed; seat the ball in more postures"
    )]
    TooFewInSockets {
        /// Number of rows in the file.
        rows: usize,
        /// Number of visited sockets.
        sockets: usize,
        /// Minimum number of rows.
        needed: usize,
    },
}
