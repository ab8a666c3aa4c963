//! One recording run, from the request to the finished file.
//!
//! Two threads: the cycle (real time, no disk) and the recorder (disk, no bus), with a ring between them. A [`Session`]
//! keeps the cycle going between runs.
//! The file is begun only when the bus is in operation, so a bus that does not come up leaves no file.

mod cycle_thread;
mod disk;
mod progress;
mod session;
mod source;
mod stop;

use std::path::{Path, PathBuf};
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use shared::recording::{Leftover, ReadError, Recovery, WriteError, recover_leftovers};

pub use disk::DiskFloor;
pub use progress::{Live, LiveEncoder, Progress, Synced};
pub use session::{ActiveRun, Session};
pub use stop::Stop;

use crate::bus::BusError;
use crate::recorder::RunSummary;
use crate::segment::OpenError;

/// Which bus to record from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum BusChoice {
    /// The simulated segment in this process, moving by itself.
    #[default]
    Simulated,
    /// The simulated segment, its encoders following a recording.
    Replay(PathBuf),
    /// A network interface.
    Interface(String),
}

/// What to record, and from where.
#[derive(Debug, Clone, Default)]
pub struct RunRequest {
    /// Name of the run, and of its file.
    pub name: String,
    /// Who records.
    pub operator: String,
    /// Which robot.
    pub robot: String,
    /// Free text.
    pub note: String,
    /// How long; none: until stopped, or to the end of a replay.
    pub duration: Option<Duration>,
    /// Which bus.
    pub bus: BusChoice,
    /// Virtual time, as fast as the machine allows. Simulated bus only.
    pub fast: bool,
}

/// One run of a bus that is in operation.
#[derive(Debug, Clone, Default)]
pub struct RunDetails {
    /// Name of the run, and of its file.
    pub name: String,
    /// Who records.
    pub operator: String,
    /// Which robot.
    pub robot: String,
    /// Free text.
    pub note: String,
    /// How long; none: until stopped.
    pub duration: Option<Duration>,
}

impl RunRequest {
    fn details(&self) -> RunDetails {
        RunDetails {
            name: self.name.clone(),
            operator: self.operator.clone(),
            robot: self.robot.clone(),
            note: self.note.clone(),
            duration: self.duration,
        }
    }
}

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
    #[error(transparent)]
    Bus(#[from] BusError),
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
    /// The disk is too full to begin.
    #[error("{0}")]
    Disk(String),
    /// The disk refused while the run went on.
    #[error("{source}; {saved}")]
    Broken {
        /// What went wrong.
        source: WriteError,
        /// What became of the cycles before.
        saved: String,
    },
    /// The system refused a thread, or one died.
    #[error("a thread of the acquisition failed: {0}")]
    Thread(String),
}

/// Brings a bus into operation, to record several runs from it.
pub fn open(bus: &BusChoice, daemon: &DaemonConfig, bar: &BallBarConfig) -> Result<Session, RunError> {
    let request = RunRequest { bus: bus.clone(), ..RunRequest::default() };
    Session::open(source::prepare(&request, daemon, bar)?, daemon, bar)
}

/// Records one run and returns when its file is finished.
pub fn record(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    let prepared = source::prepare(request, daemon, bar)?;
    finish_leftovers(&daemon.directory);
    let session = Session::open(prepared, daemon, bar)?;
    session.log();
    let outcome = session.begin(&request.details(), stop).and_then(ActiveRun::join);
    session.close()?;
    outcome
}

/// Makes finished recordings of what earlier crashes left in `directory`, and says so in the log.
pub fn finish_leftovers(directory: &Path) {
    for Leftover { file, outcome } in recover_leftovers(directory) {
        match outcome {
            Ok(Recovery::Recovered { file, content, .. } | Recovery::Renamed { file, content }) => {
                tracing::warn!(
                    file = %file.display(),
                    cycles = content.cycles,
                    "a run left behind by a crash was recovered"
                );
            }
            Ok(Recovery::Whole { .. }) => {}
            Err(error) => tracing::warn!(file = %file.display(), "a file left behind: {error}"),
        }
    }
}
