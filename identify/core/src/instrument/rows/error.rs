//! Why measured rows cannot be used.

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
        "{what} {number} has {rows} rows, at least {needed} are needed to estimate its position; measure more with it, or remove them"
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
    /// The table does not contain the socket.
    #[error("row {row} is of a socket that the table of sockets does not have; correct one of them")]
    UnknownSocket {
        /// Number of the row, from 1.
        row: usize,
    },
    /// Only one socket was visited.
    #[error(
        "all rows are of socket `{socket}`: they do not determine the scale of the robot; seat the ball in at least two sockets whose \
         distance is known"
    )]
    OneSocket {
        /// Name of the only visited socket.
        socket: String,
    },
    /// A socket was visited only once.
    #[error(
        "socket `{socket}` has one row, which contains no information; seat the ball in it in at least two postures, or remove the row"
    )]
    VisitedOnce {
        /// Name of the socket with one row.
        socket: String,
    },
    /// None of the visited sockets has a known distance.
    #[error(
        "no distance is known between the sockets of these rows ({}): they do not determine the scale of the robot; give places \
         or distances of at least two of them",
        .sockets.join(", ")
    )]
    NoDistance {
        /// Names of the sockets that were visited.
        sockets: Vec<String>,
    },
    /// Too few rows in sockets for the unknowns.
    #[error(
        "{rows} rows in {sockets} sockets are too few, at least {needed} are needed; seat the ball in more postures"
    )]
    TooFewInSockets {
        /// Number of rows in the file.
        rows: usize,
        /// Number of visited sockets.
        sockets: usize,
        /// Least number of rows.
        needed: usize,
    },
}
