//! Reads the encoders of the bar from recordings of this project, from tables of counts or angles, or from ROS 2 bags.
//!
//! Tables and bags are converted to records of bus cycles, as in recordings, so that later steps have only one form of
//! input. Such files lack some information that recordings contain: the validity of each count, the uncertainty of times,
//! restarts of counters. [`OtherBarLog::unknown`] lists the missing information.

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

/// Information that a file of another program may lack, each with the assumption that is made instead.
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

/// Number of bytes at the beginning of a file that are read to recognise a recording.
const BEGINNING: u64 = 4096;

/// Why the log of the bar cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BarLogError {
    /// The file is a recording of this project.
    #[error(transparent)]
    Recording(#[from] ReadError),
    /// The file is a table or a bag.
    #[error(transparent)]
    Other(#[from] LogError),
}

/// The log of the bar's encoders during a run.
#[derive(Debug, Clone, PartialEq)]
pub enum BarLog {
    /// A recording by `ballbard` or `identify simulate`.
    Recording(Box<Recording>),
    /// A table or a bag by another program.
    Other(Box<OtherBarLog>),
}

/// Encoders of the bar from a table or a bag.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OtherBarLog {
    /// Description of the kind of file, for messages.
    pub kind: &'static str,
    /// Name of the clock of the stamps.
    pub clock: String,
    /// Whether the stamps count from 1970. Otherwise they count from an unknown time.
    pub is_dated: bool,
    /// Encoders in the order of the file.
    pub encoders: Vec<EncoderInfo>,
    /// A record for each row or message. The values of rows that cannot be used are marked as not valid.
    pub cycles: Vec<CycleRecord>,
    /// Quality of the log. Incomplete rows, repeated rows and excursions are not removed from `cycles`, but
    /// marked as not valid.
    pub quality: LogQuality,
    /// Encoders whose counters or angles wrapped and were made continuous.
    pub unwrapped: Vec<Unwrapped>,
    /// Names of the information that the file does not contain.
    pub unknown: Vec<&'static str>,
    /// Whether `ballbard export` wrote the file from a recording of the simulated bus.
    pub simulated: bool,
}

impl BarLog {
    /// Reads the file at `path`. The kind of file is recognised by the content. `bar` contains the counts per
    /// revolution of each encoder.
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

    /// The records of all bus cycles, rows or messages.
    pub fn cycles(&self) -> &[CycleRecord] {
        match self {
            Self::Recording(recording) => &recording.cycles,
            Self::Other(other) => &other.cycles,
        }
    }

    /// Encoders whose counters or angles wrapped, in a file of another program; `None` for a recording. The records do
    /// not show these wraps, because their counts were made continuous. The counts of the records wrap only at 32
    /// bits, like the counts of a terminal.
    pub fn unwrapped(&self) -> Option<&[Unwrapped]> {
        match self {
            Self::Recording(_) => None,
            Self::Other(other) => Some(&other.unwrapped),
        }
    }

    /// Encoders, in the order of the samples in each cycle.
    pub fn encoders(&self) -> &[EncoderInfo] {
        match self {
            Self::Recording(recording) => &recording.run.encoders,
            Self::Other(other) => &other.encoders,
        }
    }
}

/// Whether a file is a recording of this project, possibly a damaged one. MCAP bags of other programs are not recordings.
///
/// # Errors
/// [`ReadErrorKind::Io`] if the file cannot be read.
pub fn is_recording(path: &Path) -> Result<bool, ReadError> {
    let mut beginning = Vec::new();
    let read = File::open(path).and_then(|file| file.take(BEGINNING).read_to_end(&mut beginning));
    read.map_err(|source| ReadError { path: path.to_owned(), kind: ReadErrorKind::Io(source) })?;
    Ok(Recording::is_begun_by(&beginning))
}

impl OtherBarLog {
    /// Reads a table or a bag from memory. `path` is only used in error messages.
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
            Ok(_) | Err(LogError::UnknownFormat { .. }) => {
                let problem = "neither a recording, nor a table with counters of the bar, nor a ROS 2 bag with its joints";
                Err(LogError::content(path, problem, "give the file of the ball-bar"))
            }
            Err(error) => Err(error),
        }
    }

    /// Information that the file does not contain, each with the assumption that is made instead.
    pub fn unsaid(&self) -> impl Iterator<Item = (&'static str, &'static str)> {
        MISSING_FACTS.into_iter().filter(|(what, _)| self.unknown.contains(what))
    }
}
