//! One recording run, from the request to the finished file.
//!
//! The cycle (real time, no disk) and the recorder (disk, no bus) have a ring between them; a third thread synchronises
//! what the recorder wrote, a fourth looks at the disk ([`Storage`]). A [`Session`] keeps the cycle going between runs.
//! The file is begun only when the bus is in operation, so a bus that does not come up leaves no file.

mod cycle_thread;
mod error;
mod homing;
mod live;
mod place;
mod request;
mod session;
mod source;

use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use shared::config::{BallBarConfig, DaemonConfig};
use shared::time::UtcNs;

pub use error::RunError;
pub use homing::ActiveHoming;
pub use live::{BUS_FLAGS, Live, LiveEncoder};
pub(crate) use place::claim_directory;
pub use place::finish_leftovers;
pub use request::{About, BusChoice, RunDetails, RunRequest, check_text, name_by_time, typed_name};
pub use session::{ActiveRun, Opening, Session};

use self::cycle_thread::Pace;
use crate::clock::Clock;
use crate::problem::Fact;
pub use crate::record::{RunSummary, Stop, Storage};
use crate::scheduler::{Pending, Scheduler, Threads};
use crate::segment::faults::FaultWindow;

/// Between two attempts to bring up the bus that a run waits for.
const RETRY_PERIOD: Duration = Duration::from_secs(1);
/// How often whoever waits looks whether it is to end.
const STOP_PERIOD: Duration = Duration::from_millis(10);
/// So long is waited for a disk that is asked for what the next start would find as it is: the end takes less than 2 s.
pub(crate) const LEAVES_WITHIN: Duration = Duration::from_millis(1500);

/// Begins to bring a bus into operation, to record several runs from it. `faults` go wrong on a simulated one.
pub fn begin_to_open(
    bus: &BusChoice,
    faults: &[FaultWindow],
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    storage: &Storage,
    scheduler: &Arc<dyn Scheduler>,
) -> Result<Opening, RunError> {
    let request = RunRequest { bus: bus.clone(), faults: faults.to_vec(), ..RunRequest::default() };
    let prepared = source::prepare(&request, daemon, bar, scheduler.clock().clone())?;
    Session::open(prepared, daemon, bar, storage, &Stop::default(), (scheduler, Pace::Clock))
}

/// A bus in operation over another wire, for tests of what stands above it.
#[cfg(test)]
pub(crate) fn open_on(
    wire: Box<dyn crate::segment::Wire>,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    storage: &Storage,
) -> Result<Opening, RunError> {
    let scheduler = (&Threads::on(Clock::Real), Pace::Clock);
    Session::open(source::on_wire(wire, daemon, bar), daemon, bar, storage, &Stop::default(), scheduler)
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
    let claim = Pending::start(&*Threads::on(Clock::Real), "claim", move || claim_directory(&place));
    let died = |_| Err(RunError::Thread("claim panicked; its cause is in the log".into()));
    let _claim = wait(storage, stop, || claim.poll(), || false)?.unwrap_or_else(died)?;
    // What ends the run by itself leaves the disk its time.
    let run = session.begin(details, &Stop::default(), None)?;
    // Asked each time: it passes on what ends the run as well.
    let is_open = || {
        if stop.is_stopped() {
            run.stop.stop(&stop.cause());
        }
        run.progress.is_open()
    };
    wait(storage, stop, || run.outcome(), is_open)?
}

/// Waits until the disk is done. Since `stop` it has only its time, unless what it does is worth waiting for.
fn wait<T>(
    storage: &Storage,
    stop: &Stop,
    result: impl Fn() -> Option<T>,
    is_worth_it: impl Fn() -> bool,
) -> Result<T, RunError> {
    let mut stopped = None;
    loop {
        if let Some(result) = result() {
            return Ok(result);
        }
        let is_stopped = stop.is_stopped().then(|| *stopped.get_or_insert_with(Instant::now));
        if !is_worth_it() && is_stopped.is_some_and(|since| since.elapsed() > LEAVES_WITHIN) {
            let silent = || Fact::DiskSilent { directory: None, silent_s: None }.into();
            let problem = storage.problem().unwrap_or_else(silent);
            return Err(RunError::NoFile { cause: stop.cause(), problem });
        }
        thread::sleep(STOP_PERIOD);
    }
}

/// A bus in operation. One that is to be waited for is tried until it is, and what is missing is said whenever that
/// changes.
pub fn connect(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    storage: &Storage,
    stop: &Stop,
) -> Result<Session, RunError> {
    let mut said = String::new();
    loop {
        let (clock, pace) = if request.fast {
            (Clock::virtual_from(UtcNs::from_datetime(chrono::Utc::now())), Pace::Fast)
        } else {
            (Clock::Real, Pace::Clock)
        };
        let scheduler = (&Threads::on(clock.clone()), pace);
        let outcome = source::prepare(request, daemon, bar, clock)
            .and_then(|prepared| Session::open(prepared, daemon, bar, storage, stop, scheduler)?.wait());
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
