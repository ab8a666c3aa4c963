//! Errors of a run.

use std::path::PathBuf;

use shared::recording::schema::DeviceInfo;
use shared::recording::{ReadError, WriteError};

use crate::bus::BusError;
use crate::claim::Holder;
use crate::problem::{Fact, Problem};
use crate::record::RunSummary;
use crate::segment::OpenError;
use crate::segment::faults::MisplacedFault;

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Invalid request, such as virtual time on a real bus.
    #[error("{0}")]
    Request(&'static str),
    /// A fault to be simulated concerns a device that the bus does not have.
    #[error(transparent)]
    Fault(#[from] MisplacedFault),
    /// The interface cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The bus could not be brought into operation.
    #[error("{error}")]
    Bus {
        /// Cause, as reported by the bus.
        error: BusError,
        /// Devices that identified themselves.
        identified: Vec<DeviceInfo>,
    },
    /// The recording to replay cannot be read.
    #[error("cannot replay: {0}")]
    Replay(#[from] ReadError),
    /// The recording to replay is unsuitable.
    #[error("cannot replay {}: {problem}", path.display())]
    ReplayContent {
        /// Path of the recording.
        path: PathBuf,
        /// Why it is unsuitable.
        problem: String,
    },
    /// The recording cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// Another process records into the directory.
    #[error("{} is in use by {holder}; stop that, or choose another directory", directory.display())]
    InUse {
        /// Directory of the recordings.
        directory: PathBuf,
        /// The process that uses it.
        holder: Holder,
    },
    /// A run with the requested name had crashed and has just been recovered.
    #[error("the name of the run is taken by {}, which has just been recovered after a crash; choose another name", .0.display())]
    NameRecovered(PathBuf),
    /// No run can begin because of a problem of the disk.
    #[error("{0}")]
    Disk(Problem),
    /// The end was requested before the file of the run was created.
    #[error("nothing was recorded: the run ended ({cause}) before the disk had created its file: {problem}")]
    NoFile {
        /// Cause of the end, such as a signal.
        cause: String,
        /// Problem of the disk.
        problem: Problem,
    },
    /// The disk failed during the run, and the run could not continue in the spare directory.
    #[error("{source}; {saved}")]
    Broken {
        /// Error of the disk.
        source: WriteError,
        /// Text about the cycles that were saved.
        saved: String,
        /// The file with the saved cycles, if there is one.
        content: Option<Box<RunSummary>>,
    },
    /// The end was requested before the bus was in operation.
    #[error("nothing was recorded: the run ended ({cause}) before the bus was in operation: {problem}")]
    Waiting {
        /// Cause of the end, such as a signal.
        cause: String,
        /// Problem of the bus.
        problem: String,
    },
    /// The operating system refused to start a thread, or a thread died.
    #[error("a thread of the acquisition failed: {0}; start again")]
    Thread(String),
}

impl RunError {
    /// The error as a problem with its code and remedy.
    pub fn problem(&self) -> Problem {
        match self {
            Self::Bus { error, .. } => error.fact().clone().into(),
            Self::Open(error) => Fact::InterfaceUnusable { error: error.to_string() }.into(),
            Self::Disk(problem) => problem.clone(),
            Self::Write(WriteError::Io { path, source }) => {
                let place = format!("cannot write {}", path.display());
                Fact::DiskError { place, error: source.to_string() }.into()
            }
            Self::Broken { .. } => Fact::FileBroken { error: self.to_string() }.into(),
            error => Fact::RunRefused { error: error.to_string() }.into(),
        }
    }

    /// Whether a person can remove the cause while this program waits, such as a cable, a power supply,
    /// a terminal or an interface.
    pub(super) fn is_retryable(&self) -> bool {
        matches!(
            self,
            Self::Bus { .. }
                | Self::Open(
                    OpenError::NoSuchInterface { .. } | OpenError::InUse { .. } | OpenError::System { .. }
                )
        )
    }
}
