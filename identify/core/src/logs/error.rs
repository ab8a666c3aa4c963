//! Errors when logs are read or written. Each message contains the problem, its place (file, line, column) and a remedy.

use std::path::{Path, PathBuf};

use super::robot::writer::seconds_text;

/// Why a log or a table cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {source}; check the path and its permissions", path.display())]
    Unreadable {
        /// Path of the file concerned.
        path: PathBuf,
        /// Text of the system's error.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {source}; check the folder, its permissions and free space", path.display())]
    Unwritable {
        /// Path of the file concerned.
        path: PathBuf,
        /// Text of the system's error.
        source: std::io::Error,
    },
    /// The bytes are neither text nor a workbook with exactly one table.
    #[error("{}: not a table ({problem}); save the table alone, as \"CSV UTF-8\"", path.display())]
    NotText {
        /// Path of the file concerned.
        path: PathBuf,
        /// What the bytes contain instead.
        problem: String,
    },
    /// A row has another number of cells than the header.
    #[error("{} line {line}: {problem}; every row needs the header's number of cells", path.display())]
    Malformed {
        /// Path of the file concerned.
        path: PathBuf,
        /// Line in the file.
        line: u64,
        /// What is wrong with the row.
        problem: String,
    },
    /// The table has no header row.
    #[error("{}: no header row; the first line that is not a `#` comment must name the columns", path.display())]
    NoHeader {
        /// Path of the file concerned.
        path: PathBuf,
    },
    /// A required column is missing.
    #[error("{}: column `{column}` is missing; found: {found}. {remedy}", path.display())]
    MissingColumn {
        /// Path of the file concerned.
        path: PathBuf,
        /// Name of the missing column.
        column: String,
        /// Names of the columns in the file.
        found: String,
        /// What the user can do.
        remedy: String,
    },
    /// The header and the robot's configuration contain different units for a column.
    #[error(
        "{}: column `{column}` is in {in_header} by its header, but in {in_config} by log.unit of {robot}'s configuration; \
         correct the wrong one (values are not converted)", path.display()
    )]
    UnitMismatch {
        /// Path of the file concerned.
        path: PathBuf,
        /// The column as the header names it.
        column: String,
        /// Unit in the header.
        in_header: &'static str,
        /// Unit in the configuration.
        in_config: &'static str,
        /// The robot's name.
        robot: String,
    },
    /// The log has too few rows.
    #[error("{}: {rows} usable rows, at least {needed} are needed; export the log of the whole run", path.display())]
    TooFewRows {
        /// Path of the file concerned.
        path: PathBuf,
        /// Number of usable rows.
        rows: usize,
        /// Smallest allowed number of rows.
        needed: usize,
    },
    /// The stamp of a row is not later than the stamp of the row before.
    #[error(
        "{} {what} {line}: time goes from {before_s} s ({what} {before_line}) to {after_s} s; \
         sort the rows, or split the file where the clock was set", path.display()
    )]
    TimeNotIncreasing {
        /// Path of the file concerned.
        path: PathBuf,
        /// Name of a row in this format, such as `line`.
        what: &'static str,
        /// Line of the later row.
        line: u64,
        /// Line of the row before it.
        before_line: u64,
        /// The stamp of the row before \[s\], as text.
        before_s: String,
        /// The stamp of the later row \[s\], as text.
        after_s: String,
    },
    /// The format of the file is unknown.
    #[error(
        "{}: not a known kind of robot log; name its kind with --log-format, or export a CSV", path.display()
    )]
    UnknownFormat {
        /// Path of the file concerned.
        path: PathBuf,
    },
    /// A value of a table, a record of a binary file or a telegram of an XML file cannot be used.
    #[error("{} {place}: {problem}; {remedy}", path.display())]
    BadRecord {
        /// Path of the file concerned.
        path: PathBuf,
        /// Name of the record, such as `message 12`, or of the cell.
        place: String,
        /// What is wrong with it.
        problem: String,
        /// What the user can do.
        remedy: String,
    },
    /// The problem concerns the whole file, not one record.
    #[error("{}: {problem}; {remedy}", path.display())]
    Content {
        /// Path of the file concerned.
        path: PathBuf,
        /// What is wrong with the file.
        problem: String,
        /// What the user can do.
        remedy: String,
    },
    /// The matrix `log.raw_to_joint` of the robot's configuration cannot be inverted.
    #[error(
        "log.raw_to_joint of the robot's configuration is singular: the log does not determine all joints; \
         check its rows (log columns) and columns (joints)"
    )]
    SingularConversion,
    /// The log has no segment without gaps that is long enough to interpolate.
    #[error(
        "the robot log has no {needed} consecutive samples less than {gap_limit_s} s apart; log at a higher rate, or without \
         pauses"
    )]
    NoContinuousPart {
        /// Number of consecutive rows without a gap that interpolation needs.
        needed: usize,
        /// Longest gap that is interpolated \[s\].
        gap_limit_s: f64,
    },
}

impl LogError {
    /// [`Self::Content`] of the file at `path`.
    pub(super) fn content(path: &Path, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Content { path: path.to_owned(), problem: problem.into(), remedy: remedy.into() }
    }

    /// [`Self::BadRecord`] of the record `place` in the file at `path`.
    pub(super) fn bad_record(path: &Path, place: String, problem: String, remedy: &str) -> Self {
        Self::BadRecord { path: path.to_owned(), place, problem, remedy: remedy.to_owned() }
    }

    /// [`Self::TooFewRows`] if `rows` is less than `needed`.
    pub(super) fn unless_enough(path: &Path, rows: usize, needed: usize) -> Result<(), Self> {
        if rows < needed { Err(Self::TooFewRows { path: path.to_owned(), rows, needed }) } else { Ok(()) }
    }

    /// Refuses names of columns or joints in a mapping if two of them are equal.
    pub(super) fn unless_distinct(path: &Path, names: &[impl AsRef<str>]) -> Result<(), Self> {
        let names: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
        let repeated = names.iter().enumerate().find(|(index, name)| names[..*index].contains(name));
        let Some((_, name)) = repeated else { return Ok(()) };
        let remedy = "each joint or component has a column of its own: correct one of the two names";
        Err(Self::content(path, format!("the mapping names `{name}` twice"), remedy))
    }

    /// [`Self::TimeNotIncreasing`] for two successive rows, each with its line number in the file and its stamp \[ns\].
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
