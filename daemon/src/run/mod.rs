//! One recording run, from the request to the finished file.
//!
//! The cycle (real time, no disk) and the recorder (disk, no bus) have a ring between them; a third thread synchronises
//! what the recorder wrote, a fourth looks at the disk ([`Storage`]). A [`Session`] keeps the cycle going between runs.
//! The file is begun only when the bus is in operation, so a bus that does not come up leaves no file.

mod cycle_thread;
mod disk;
mod homing;
mod progress;
mod session;
mod source;
mod stop;

use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use shared::config::{BallBarConfig, DaemonConfig, HomingConfig};
use shared::recording::{Leftover, ReadError, Recovery, WriteError, recover_leftovers_on, run_name};

pub use disk::Storage;
pub use homing::ActiveHoming;
pub use progress::{BUS_FLAGS, Handed, Limits, Live, LiveEncoder, Progress, Snapshot, Synced};
pub(crate) use session::STACK_BYTES;
pub use session::{ActiveRun, Session};
pub use stop::Stop;

use crate::bus::BusError;
use crate::claim::{Claim, Holder};
use crate::problem::{Fact, Problem};
use crate::recorder::RunSummary;
use crate::segment::OpenError;
use crate::segment::faults::FaultWindow;

/// Between two attempts to bring up the bus that a run waits for.
const RETRY_PERIOD: Duration = Duration::from_secs(1);
/// How often whoever waits looks whether it is to end.
const STOP_PERIOD: Duration = Duration::from_millis(10);
/// So long is waited for a disk that is asked for what the next start would find as it is: the end takes less than 2 s.
pub(crate) const LEAVES_WITHIN: Duration = Duration::from_millis(1500);

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

/// What people say of a run, for its file.
#[derive(Debug, Clone, Default, PartialEq, Eq, clap::Args)]
pub struct About {
    /// Who records
    #[arg(long, default_value = "")]
    pub operator: String,
    /// Which robot
    #[arg(long, default_value = "")]
    pub robot: String,
    /// Which bar and ball pair
    #[arg(long, default_value = "")]
    pub bar: String,
    /// What the robot carries beside the bar
    #[arg(long, default_value = "")]
    pub payload: String,
    /// Free text
    #[arg(long, default_value = "")]
    pub note: String,
}

/// What to record, and from where.
#[derive(Debug, Clone, Default)]
pub struct RunRequest {
    /// Name of the run, and of its file.
    pub name: String,
    /// What people say of it.
    pub about: About,
    /// How long; none: until stopped, or to the end of a replay.
    pub duration: Option<Duration>,
    /// Which bus.
    pub bus: BusChoice,
    /// What goes wrong on the simulated bus, on purpose.
    pub faults: Vec<FaultWindow>,
    /// A bus that does not come up is tried again until it does.
    pub wait: bool,
    /// Reference marks of the encoders, used where the terminals still show them; not for a replay, whose recording
    /// has its own.
    pub homing: Option<HomingConfig>,
    /// Virtual time, as fast as the machine allows. Simulated bus only.
    pub fast: bool,
}

/// One run of a bus that is in operation.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunDetails {
    /// Name of the run, and of its file.
    pub name: String,
    /// What people say of it.
    pub about: About,
    /// How long; none: until stopped.
    pub duration: Option<Duration>,
    /// Reference marks of the encoders, used where the terminals still show them.
    pub homing: Option<HomingConfig>,
}

impl RunDetails {
    /// Refuses texts that would play with the terminals of those who read them.
    pub fn check(&self) -> Result<(), &'static str> {
        let About { operator, robot, bar, payload, note } = &self.about;
        [operator, robot, bar, payload, note].into_iter().try_for_each(|text| check_text(text))
    }
}

/// A run's name where nobody chose one: the date and time of this place.
pub fn name_by_time() -> String {
    chrono::Local::now().format("%Y-%m-%d_%H-%M-%S").to_string()
}

/// The name of a run from what was typed: see [`run_name`].
pub fn typed_name(typed: &str) -> Result<String, String> {
    run_name(typed)
        .ok_or_else(|| format!("run name {typed:?} has no letter or digit; type another, or leave it out"))
}

/// Longest name, note and so on \[bytes\].
const TEXT_BYTES_MAX: usize = 4000;

/// Text that people give with a run: no longer than anybody reads, and nothing but text.
pub fn check_text(text: &str) -> Result<(), &'static str> {
    if text.len() > TEXT_BYTES_MAX {
        return Err("a text is longer than 4000 bytes; shorten it");
    }
    if text.chars().any(|c| c.is_control() && c != '\n' && c != '\t') {
        return Err("a text has control characters; leave them out");
    }
    Ok(())
}

impl RunRequest {
    fn details(&self) -> RunDetails {
        RunDetails {
            name: self.name.clone(),
            about: self.about.clone(),
            duration: self.duration,
            homing: self.homing.clone().filter(|_| !matches!(self.bus, BusChoice::Replay(_))),
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
            Self::Bus(error) => error.fact().into(),
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
    fn may_pass(&self) -> bool {
        matches!(
            self,
            Self::Bus(_)
                | Self::Open(
                    OpenError::NoSuchInterface { .. } | OpenError::InUse { .. } | OpenError::System { .. }
                )
        )
    }
}

/// Brings a bus into operation, to record several runs from it. `faults` go wrong on a simulated one.
pub fn open(
    bus: &BusChoice,
    faults: &[FaultWindow],
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    storage: &Storage,
) -> Result<Session, RunError> {
    let request = RunRequest { bus: bus.clone(), faults: faults.to_vec(), ..RunRequest::default() };
    Session::open(source::prepare(&request, daemon, bar)?, daemon, bar, storage, &Stop::default())
}

/// A bus in operation over another wire, for tests of what stands above it.
#[cfg(test)]
pub(crate) fn open_on(
    wire: Box<dyn crate::segment::Wire>,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    storage: &Storage,
) -> Result<Session, RunError> {
    Session::open(source::on_wire(wire, daemon, bar), daemon, bar, storage, &Stop::default())
}

/// Records one run and returns when its file is finished.
pub fn record(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    let storage = Storage::new(daemon).map_err(|error| RunError::Thread(error.to_string()))?;
    record_on(&storage, request, daemon, bar, stop)
}

/// [`record`] on another disk.
pub fn record_on(
    storage: &Storage,
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    source::check(request)?;
    let session = connect(request, daemon, bar, storage, stop)?;
    session.log();
    let outcome = record_from(&session, storage, &request.details(), stop);
    // On virtual time there is no bus to leave in order, and the cycle may wait for a disk that hangs.
    if outcome.is_ok() || !request.fast {
        session.close()?;
    }
    outcome
}

/// One that is asked to end while it has no file yet does not wait for the disk that should give it one.
fn record_from(
    session: &Session,
    storage: &Storage,
    details: &RunDetails,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    // Only now: what does not come to record leaves no directory.
    let place = storage.clone();
    let claim = session::spawn("claim", move || claim_directory(&place))?;
    wait(storage, stop, || claim.is_finished(), || false)?;
    let _claim = session::join(claim)??;
    // What ends the run by itself leaves the disk its time.
    let run = session.begin(details, &Stop::default(), None)?;
    // Asked each time: it passes on what ends the run as well.
    let is_open = || {
        if stop.is_stopped() {
            run.stop.stop(&stop.cause());
        }
        run.progress.is_open()
    };
    wait(storage, stop, || run.is_finished(), is_open)?;
    run.join()
}

/// Waits until the disk is done. Since `stop` it has only its time, unless what it does is worth waiting for.
fn wait(
    storage: &Storage,
    stop: &Stop,
    is_done: impl Fn() -> bool,
    is_worth_it: impl Fn() -> bool,
) -> Result<(), RunError> {
    let mut stopped = None;
    while !is_done() {
        let is_stopped = stop.is_stopped().then(|| *stopped.get_or_insert_with(Instant::now));
        if !is_worth_it() && is_stopped.is_some_and(|since| since.elapsed() > LEAVES_WITHIN) {
            let silent = || Fact::DiskSilent { directory: None, silent_s: None }.into();
            let problem = storage.problem().unwrap_or_else(silent);
            return Err(RunError::NoFile { cause: stop.cause(), problem });
        }
        thread::sleep(STOP_PERIOD);
    }
    Ok(())
}

/// A bus in operation. One that is to be waited for is tried until it is, and what is missing is said whenever that
/// changes.
fn connect(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    storage: &Storage,
    stop: &Stop,
) -> Result<Session, RunError> {
    let mut said = String::new();
    loop {
        let outcome = source::prepare(request, daemon, bar)
            .and_then(|prepared| Session::open(prepared, daemon, bar, storage, stop));
        let missing = match outcome {
            Err(error) if request.wait && error.may_pass() => error.to_string(),
            outcome => return outcome,
        };
        if missing != said {
            tracing::warn!("waiting for the bus: {missing}");
            said.clone_from(&missing);
        }
        let retry_at = Instant::now() + RETRY_PERIOD;
        while Instant::now() < retry_at {
            if stop.is_stopped() {
                return Err(RunError::Waiting { cause: stop.cause(), missing });
            }
            thread::sleep(STOP_PERIOD);
        }
    }
}

/// Keeps other processes from recording into the directory, which is made where it is missing. One that cannot be made
/// is not claimed: whoever records into it is told why it cannot.
pub(crate) fn claim_directory(storage: &Storage) -> Result<Option<Claim>, RunError> {
    let directory = storage.directory();
    let disk = storage.disk();
    if disk.make_directory(directory).is_err() {
        return Ok(None);
    }
    Claim::directory(&*disk, directory)
        .map_err(|holder| RunError::InUse { directory: directory.to_owned(), holder })
}

/// Makes finished recordings of what earlier crashes left where recordings go, and says so in the log. Gives their files.
pub fn finish_leftovers(storage: &Storage) -> Vec<PathBuf> {
    let (disk, places) = (storage.disk(), [storage.directory(), storage.spare()]);
    let leftovers = places.into_iter().flat_map(|place| recover_leftovers_on(&*disk, place));
    let mut finished = Vec::new();
    for Leftover { file, outcome } in leftovers {
        match outcome {
            Ok(Recovery::Recovered { file, content, .. } | Recovery::Renamed { file, content }) => {
                tracing::warn!(
                    file = %file.display(),
                    cycles = content.cycles,
                    "a run left behind by a crash was recovered"
                );
                finished.push(file);
            }
            Ok(Recovery::Whole { .. }) => {}
            Err(error) => tracing::warn!(file = %file.display(), "a file left behind: {error}"),
        }
    }
    finished
}
