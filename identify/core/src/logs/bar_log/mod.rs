//! Encoders of the bar from our own recordings, tables of counters, or ROS 2 bags.
//!
//! Tables and bags become records of bus cycles, as recordings have them, so that later steps have one kind of input. Facts
//! that such files lack (validity of single counts, uncertainty of times, restarts of counters) are not invented:
//! [`OtherBarLog::unknown`] lists them.

mod bag;
mod mapping;
mod samples;
mod table;

pub use mapping::{BarLogMapping, EncoderColumn, EncoderUnit};

use std::fs::File;
use std::io::Read;
use std::path::Path;

use shared::config::BallBarConfig;
use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::recording::{ReadError, ReadErrorKind, Recording};

use super::source::LogSource;
use super::{LogError, LogFormat, LogQuality, Unwrapped};

/// Facts that a file may lack, with the assumption for each.
const MISSING_FACTS: [(&str, &str); 5] = [
    ("how certain its times are", "they are taken as exact"),
    ("the times of a second clock", "a clock step is found only from the shifts of parts of the run"),
    (
        "which values are not valid",
        "every row that has all values is used, except rows that repeat the counts before them, or jump away and back",
    ),
    ("where counters restarted", "a place where two or more encoders jump at once is taken as a restart"),
    ("the date of its stamps", "the two clocks are compared by the motion alone"),
];

/// Bytes at the beginning of a file by which a recording is recognised.
const BEGINNING: u64 = 4096;

/// Why the bar's side of a run cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BarLogError {
    /// A recording of ours.
    #[error(transparent)]
    Recording(#[from] ReadError),
    /// A table or a bag.
    #[error(transparent)]
    Other(#[from] LogError),
}

/// The bar's side of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum BarLog {
    /// Made by `ballbard` or `identify simulate`.
    Recording(Box<Recording>),
    /// From a file of another program.
    Other(Box<OtherBarLog>),
}

/// Encoders of the bar from a table or a bag.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OtherBarLog {
    /// Kind of the file, in words.
    pub kind: &'static str,
    /// Name of the clock that made the stamps.
    pub clock: String,
    /// Whether stamps count from 1970; otherwise from an unknown instant.
    pub is_dated: bool,
    /// In the order of the file.
    pub encoders: Vec<EncoderInfo>,
    /// One for each row or message; unusable ones are not valid.
    pub cycles: Vec<CycleRecord>,
    /// Quality of the log; incomplete and repeated rows and excursions are among the cycles and not valid.
    pub quality: LogQuality,
    /// Counters and angles that wrapped and were made continuous.
    pub unwrapped: Vec<Unwrapped>,
    /// Facts that the file does not have.
    pub unknown: Vec<&'static str>,
    /// `ballbard export` wrote it from a recording of the simulated bus.
    pub simulated: bool,
}

impl BarLog {
    /// Reads the file at `path`, recognised by its content. `bar` has the counts per revolution of each encoder.
    ///
    /// # Errors
    /// Every way in which the file cannot be used.
    pub fn load(
        path: &Path,
        bar: &BallBarConfig,
        mapping: Option<&BarLogMapping>,
    ) -> Result<Self, BarLogError> {
        if is_recording(path)? {
            return Ok(Self::Recording(Box::new(Recording::open(path)?)));
        }
        let other = OtherBarLog::read_from(LogSource::open(path)?, bar, mapping)?;
        Ok(Self::Other(Box::new(other)))
    }

    /// All cycles, rows or messages.
    pub fn cycles(&self) -> &[CycleRecord] {
        match self {
            Self::Recording(recording) => &recording.cycles,
            Self::Other(other) => &other.cycles,
        }
    }

    /// Counters and angles that wrapped, in a file of another program: its records do not show it, since their counts wrap as
    /// those of a terminal. `None` for a recording.
    pub fn unwrapped(&self) -> Option<&[Unwrapped]> {
        match self {
            Self::Recording(_) => None,
            Self::Other(other) => Some(&other.unwrapped),
        }
    }

    /// Encoders in the order in which each cycle has them.
    pub fn encoders(&self) -> &[EncoderInfo] {
        match self {
            Self::Recording(recording) => &recording.run.encoders,
            Self::Other(other) => &other.encoders,
        }
    }
}

/// Whether a file is a recording of ours, possibly a damaged one, and so not a bag of another program.
///
/// # Errors
/// [`ReadErrorKind::Io`] if it cannot be read.
pub fn is_recording(path: &Path) -> Result<bool, ReadError> {
    let mut beginning = Vec::new();
    let read = File::open(path).and_then(|file| file.take(BEGINNING).read_to_end(&mut beginning));
    read.map_err(|source| ReadError { path: path.to_owned(), kind: ReadErrorKind::Io(source) })?;
    Ok(Recording::is_begun_by(&beginning))
}

impl OtherBarLog {
    /// Reads a table or a bag from memory; `path` is only named in errors.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn read(
        bytes: &[u8],
        path: &Path,
        bar: &BallBarConfig,
        mapping: Option<&BarLogMapping>,
    ) -> Result<Self, LogError> {
        Self::read_from(LogSource::in_memory(bytes, path), bar, mapping)
    }

    fn read_from(
        source: LogSource<'_>,
        bar: &BallBarConfig,
        mapping: Option<&BarLogMapping>,
    ) -> Result<Self, LogError> {
        let path = source.path;
        match LogFormat::detect(source.beginning(), path) {
            Ok(format @ (LogFormat::Ros2Mcap | LogFormat::Ros2Db3)) => {
                bag::read(&source.whole()?, path, bar, format, mapping)
            }
            Ok(LogFormat::Csv) => table::read(source, bar, mapping),
            Ok(_) | Err(LogError::UnknownFormat { .. }) => Err(LogError::Content {
                path: path.to_owned(),
                problem: "neither a recording, nor a table with counters of the bar, nor a ROS 2 bag with its joints"
                    .into(),
                remedy: "give the file of the ball-bar".into(),
            }),
            Err(error) => Err(error),
        }
    }

    /// Facts that the file lacks, with the assumption for each.
    pub fn unsaid(&self) -> impl Iterator<Item = (&'static str, &'static str)> {
        MISSING_FACTS.into_iter().filter(|(what, _)| self.unknown.contains(what))
    }
}
