//! Why a log cannot be used: what, where (file, line, column) and what to do.

use std::path::{Path, PathBuf};

use super::robot::writer::seconds_text;

/// Place of one value in a text file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cell {
    /// The file.
    pub path: PathBuf,
    /// Line in the file, the first is 1.
    pub line: u64,
    /// Name of the column in the header.
    pub column: String,
}

impl std::fmt::Display for Cell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} line {} column `{}`", self.path.display(), self.line, self.column)
    }
}

/// Why a robot log or a table of measured lengths cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {source}; check the path and its permissions", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {source}; check the folder, its permissions and free space", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The bytes are neither text nor a workbook with one table.
    #[error("{}: no table of text ({problem}); save the table alone, as \"CSV UTF-8\"", path.display())]
    NotText {
        /// The file.
        path: PathBuf,
        /// What was found instead.
        problem: String,
    },
    /// A row does not have the header's number of cells, or quotes are open.
    #[error("{} line {line}: {problem}; every row needs the header's number of cells", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line in the file.
        line: u64,
        /// What is wrong with the row.
        problem: String,
    },
    /// There is no header row.
    #[error("{}: no header row; the first line that is not a `#` comment must name the columns", path.display())]
    NoHeader {
        /// The file.
        path: PathBuf,
    },
    /// A column that is needed is absent.
    #[error("{}: column `{column}` is missing; found: {found}. {remedy}", path.display())]
    MissingColumn {
        /// The file.
        path: PathBuf,
        /// The column looked for.
        column: String,
        /// The columns that are there.
        found: String,
        /// What to do.
        remedy: String,
    },
    /// Two columns have the same name.
    #[error("{}: column `{column}` is there twice; remove or rename one", path.display())]
    RepeatedColumn {
        /// The file.
        path: PathBuf,
        /// Its name.
        column: String,
    },
    /// The header's unit and the robot's configuration disagree.
    #[error(
        "{}: column `{column}` is in {in_header} but the configuration of {robot} (log.unit) says {in_config}; \
         correct whichever is wrong, the values are not converted on a guess", path.display()
    )]
    UnitMismatch {
        /// The file.
        path: PathBuf,
        /// The column as the header names it.
        column: String,
        /// Unit that the header states.
        in_header: &'static str,
        /// Unit that the configuration states.
        in_config: &'static str,
        /// The robot's name.
        robot: String,
    },
    /// One value cannot be used.
    #[error("{cell}: {problem}; {remedy}")]
    BadValue {
        /// Where it is.
        cell: Cell,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        remedy: &'static str,
    },
    /// Not enough rows.
    #[error("{}: {rows} usable rows, at least {needed} are needed; was the export cut short?", path.display())]
    TooFewRows {
        /// The file.
        path: PathBuf,
        /// How many there are.
        rows: usize,
        /// How many are needed.
        needed: usize,
    },
    /// Time stands still or runs backwards.
    #[error(
        "{} {what} {line}: time goes from {before_s} s ({what} {before_line}) to {after_s} s; \
         sort the rows, or split the file where the clock was set", path.display()
    )]
    TimeNotIncreasing {
        /// The file.
        path: PathBuf,
        /// What rows are called in this format.
        what: &'static str,
        /// Line of the later row.
        line: u64,
        /// Line of the row before it.
        before_line: u64,
        /// Its stamp as written.
        before_s: String,
        /// The stamp of the later row as written.
        after_s: String,
    },
    /// Joint values that the robot cannot reach.
    #[error(
        "{} {what} {line}: joint {joint} would be at {value} \
         ({rows_beyond} of {rows} rows beyond a limit); {remedy}", path.display()
    )]
    BeyondLimits {
        /// The file.
        path: PathBuf,
        /// What rows are called in this format.
        what: &'static str,
        /// Line of the first such row.
        line: u64,
        /// Joint from 1.
        joint: usize,
        /// Its value and the limits of the configuration, with their unit.
        value: String,
        /// Rows with a joint beyond a limit.
        rows_beyond: usize,
        /// All rows.
        rows: usize,
        /// The likely cause and what to do.
        remedy: String,
    },
    /// The file is none of the formats that are known.
    #[error(
        "{}: not a robot log of any kind that is known; say which with --log-format, or export a CSV", path.display()
    )]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// The file has nothing of the bar.
    #[error(
        "{}: neither a recording, nor a table with counters of the bar, nor a ROS 2 bag with its joints; is it the file of \
         the ball-bar?", path.display()
    )]
    NoBarLog {
        /// The file.
        path: PathBuf,
    },
    /// A record of a binary file or a telegram of an XML file cannot be used.
    #[error("{} {place}: {problem}; {remedy}", path.display())]
    BadRecord {
        /// The file.
        path: PathBuf,
        /// Which record, such as `message 12`.
        place: String,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        remedy: &'static str,
    },
    /// The file as a whole does not hold what its format promises.
    #[error("{}: {problem}; {remedy}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
        /// What to do.
        remedy: String,
    },
    /// The robot's configuration describes motors, the log has joints.
    #[error(
        "{}: it has joint angles ({format}), but the configuration of {robot} says how its motors become joints; \
         say how the controller's joints become the model's with --log-mapping, see config/robot_log.toml",
        path.display()
    )]
    NeedsMapping {
        /// The file.
        path: PathBuf,
        /// Its format.
        format: &'static str,
        /// The robot's name.
        robot: String,
    },
    /// The conversion of the robot's configuration cannot be inverted.
    #[error(
        "log.raw_to_joint of the robot's configuration is singular: some joint does not follow from the log; \
             check rows (log columns) and columns (joints)"
    )]
    SingularConversion,
    /// Not enough stamps close to each other to interpolate.
    #[error(
        "the robot log has no {needed} stamps in a row that are less than {gap_limit_s} s apart; \
             log faster or without pauses"
    )]
    NoContinuousPart {
        /// Stamps needed in a row.
        needed: usize,
        /// Longest distance that is bridged \[s\].
        gap_limit_s: f64,
    },
}

impl LogError {
    /// [`Self::TooFewRows`] where `rows` are less than `needed`.
    pub(super) fn unless_enough(path: &Path, rows: usize, needed: usize) -> Result<(), Self> {
        if rows < needed { Err(Self::TooFewRows { path: path.to_owned(), rows, needed }) } else { Ok(()) }
    }

    /// [`Self::TimeNotIncreasing`] between two rows, each with its place in the file and its stamp \[ns\].
    pub(super) fn time_not_increasing(
        path: &Path,
        what: &'static str,
        (before_line, before_ns): (u64, i64),
        (line, after_ns): (u64, i64),
    ) -> Self {
        let (before_s, after_s) = (seconds_text(before_ns), seconds_text(after_ns));
        Self::TimeNotIncreasing { path: path.to_owned(), what, line, before_line, before_s, after_s }
    }
}
