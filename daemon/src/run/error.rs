//! Why a run failed.

use std::path::PathBuf;

use shared::recording::schema::DeviceInfo;
use shared::recording::{ReadError, WriteError};

use crate::bus::BusError;
use crate::claim::Holder;
use crate::problem::{Fact, Problem};
use crate::record::RunSummary;
use crate::segment::OpenError;

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Virtual time on a real bus, or without an end.
    #[error("{0}")]
    Request(&'static str),
    /// The interface cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The bus does not come up.
    #[error("{error}")]
    Bus {
        /// Cause, as it is reported.
        error: BusError,
        /// Devices that identified themselves.
        identified: Vec<DeviceInfo>,
    },
    /// The recording to replay cannot be read.
    #[error("cannot replay: {0}")]
    Replay(#[from] ReadError),
    /// The recording to replay does not suit.
    #[error("cannot replay {}: {problem}", path.display())]
    ReplayContent {
        /// The recording.
        path: PathBuf,
        /// Why not.
        problem: String,
    },
    /// The recording cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// Another process records into the directory.
    #[error("{} is in use by {holder}; stop that, or choose another directory", directory.display())]
    InUse {
        /// The directory.
        directory: PathBuf,
        /// Who has it.
        holder: Holder,
    },
    /// The name that was asked for is that of a run that a crash left behind.
    #[error("{}: a run of this name was left behind by a crash and has just been recovered; choose another name", .0.display())]
    NameRecovered(PathBuf),
    /// The disk does not take a run.
    #[error("{0}")]
    Disk(Problem),
    /// Asked to end while the disk had not yet given the run a file.
    #[error("{cause} before the run had a file; nothing was recorded: {problem}")]
    NoFile {
        /// Cause of the end, such as a signal.
        cause: String,
        /// What the disk did.
        problem: Problem,
    },
    /// The disk refused while the run went on, and so did the spare place.
    #[error("{source}; {saved}")]
    Broken {
        /// What went wrong.
        source: WriteError,
        /// What became of the cycles before.
        saved: String,
        /// The file that has them, if there is one.
        content: Option<Box<RunSummary>>,
    },
    /// Asked to end before the bus was there.
    #[error("{cause} while waiting for the bus; nothing was recorded: {missing}")]
    Waiting {
        /// Who asked.
        cause: String,
        /// What was missing.
        missing: String,
    },
    /// The system refused a thread, or one died.
    #[error("a thread of the acquisition failed: {0}")]
    Thread(String),
}

impl RunError {
    /// As it is reported.
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

    /// Somebody at the bus can set it right while this program waits: a cable, power, a terminal, an interface.
    pub(super) fn may_pass(&self) -> bool {
        matches!(
            self,
            Self::Bus { .. }
                | Self::Open(
                    OpenError::NoSuchInterface { .. } | OpenError::InUse { .. } | OpenError::System { .. }
                )
        )
    }
}
