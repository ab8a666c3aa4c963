//! One recording run, from the request to the finished file.
//!
//! Between the cycle (real time, no disk) and the recorder (disk, no bus) is a ring; a third thread synchronises the file, a
//! fourth checks the disk ([`Storage`]). A [`Session`] keeps the cycle running between runs. The file is created only when
//! the bus is in operation, so a bus that does not come up leaves no file.

mod cycle_thread;
mod error;
mod homing;
mod live;
mod place;
mod request;
mod session;
mod source;

use std::time::Duration;

use shared::time::UtcNs;

pub use error::RunError;
pub use homing::ActiveHoming;
pub use live::{BUS_FLAGS, LatestSamples, LiveEncoder};
pub(crate) use place::claim_directory;
pub use place::finish_leftovers;
pub use request::{About, BusChoice, RunDetails, RunRequest, Setup, check_text, name_by_time, typed_name};
pub use session::{ActiveRun, Opening, Session};
pub(crate) use source::{open_replay, replaying_segment};

use self::cycle_thread::Pace;
use crate::clock::Clock;
use crate::problem::Fact;
pub use crate::record::{RunSummary, Stop, Storage};
use crate::scheduler::{Pending, Scheduler, Threads, until};
use crate::segment::faults::FaultWindow;

/// Period of attempts to bring up the bus for a run that waits for it.
const RETRY_PERIOD: Duration = Duration::from_secs(1);
/// A bus that takes longer to come into operation is slow: one to two seconds are usual.
const SLOW_AFTER: Duration = Duration::from_secs(5);
const SLOW_BUS: &str = "the bus is not in operation after 5 s: replies are late or lost; check cables and contacts, and \
                        `reply_timeout_us` in daemon.toml";
/// Period in which waiting tasks check whether they are to end.
const STOP_PERIOD: Duration = Duration::from_millis(10);
/// Longest wait for the disk after a request to end, so that the program ends within 2 s: for the creation of a run's file,
/// reference marks, and the recovery of earlier runs, which the next start repeats.
pub(crate) const DISK_WAIT_AT_END: Duration = Duration::from_millis(1500);

/// Begins to bring a bus into operation for several runs. `faults` are injected into a simulated one.
pub fn start_opening(setup: &Setup, bus: &BusChoice, faults: &[FaultWindow]) -> Result<Opening, RunError> {
    let request = RunRequest { bus: bus.clone(), faults: faults.to_vec(), ..RunRequest::default() };
    Session::open(source::prepare(&request, setup)?, setup.clone(), Pace::Clock, &Stop::default())
}

/// A bus in operation over another wire, for tests of the layers above.
#[cfg(test)]
pub(crate) fn open_on_wire(
    wire: Box<dyn crate::segment::FrameWire>,
    setup: &Setup,
) -> Result<Opening, RunError> {
    let prepared = source::PreparedBus::from_config(wire, shared::recording::schema::SIMULATED_BUS, setup);
    Session::open(prepared, setup.clone(), Pace::Clock, &Stop::default())
}

/// Records one run; completes when its file is finished and its bus is closed. The caller waits on the scheduler of `setup`.
pub async fn record(setup: &Setup, request: &RunRequest, stop: &Stop) -> Result<RunSummary, RunError> {
    source::check(request)?;
    let session = open_with_retry(setup, request, stop).await?;
    session.log();
    let outcome = record_in_session(setup, &session, &request.run, stop).await;
    // After an error on virtual time the cycle may wait for a disk that hangs, and there is no real bus to close.
    if outcome.is_ok() || !request.fast {
        session.close().await?;
    }
    outcome
}

/// Claims the directory, records one run in an open session, and waits for its end. If the run is stopped before it has a
/// file, the wait for the disk is limited to [`DISK_WAIT_AT_END`].
async fn record_in_session(
    Setup { scheduler, storage, .. }: &Setup,
    session: &Session,
    details: &RunDetails,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    let (scheduler, clock) = (&**scheduler, scheduler.clock());
    let mut first_stopped_at = None;
    let mut disk_wait_is_over = || {
        let stopped_at = stop.is_stopped().then(|| *first_stopped_at.get_or_insert_with(|| clock.now()));
        stopped_at.is_some_and(|at| clock.now().ns_since(at) > DISK_WAIT_AT_END.as_nanos() as i64)
    };
    let no_file_error = || {
        let silent = || Fact::DiskSilent { directory: None, silent_s: None }.into();
        RunError::NoFile { cause: stop.cause(), problem: storage.problem().unwrap_or_else(silent) }
    };
    // Only now: a run that does not begin creates no directory.
    let claimed_storage = storage.clone();
    let claim_task = Pending::start(scheduler, "claim", move || claim_directory(&claimed_storage));
    let claim_died = |_| Err(RunError::Thread("claim panicked; its cause is in the log".into()));
    // The run is refused if the disk has a problem, so its state must be known before.
    let poll_claim = || storage.is_known().then(|| claim_task.poll()).flatten();
    let _claim = until(scheduler, STOP_PERIOD, || match poll_claim() {
        Some(claim) => Some(claim.unwrap_or_else(claim_died)),
        None => disk_wait_is_over().then(|| Err(no_file_error())),
    })
    .await?;
    // The run has its own stop, also set when it is complete; only `stop`, a request, limits the wait for the disk.
    let run = session.begin(details, None)?;
    until(scheduler, STOP_PERIOD, || {
        if stop.is_stopped() {
            run.stop.stop(&stop.cause());
        }
        let is_given_up = disk_wait_is_over() && !run.progress.is_open();
        run.outcome().or_else(|| is_given_up.then(|| Err(no_file_error())))
    })
    .await
}

/// Brings the bus into operation. If the request waits for the bus, failed attempts are repeated, and the problem is logged
/// whenever it changes.
pub async fn open_with_retry(setup: &Setup, request: &RunRequest, stop: &Stop) -> Result<Session, RunError> {
    let scheduler = &*setup.scheduler;
    let mut logged = String::new();
    loop {
        let (mut run_setup, mut pace) = (setup.clone(), Pace::Clock);
        if request.fast {
            let clock = Clock::virtual_from(UtcNs::from_datetime(chrono::Utc::now()));
            (run_setup.scheduler, pace) = (Threads::on(clock), Pace::Fast);
        }
        let opening = source::prepare(request, &run_setup)
            .and_then(|prepared| Session::open(prepared, run_setup, pace, stop));
        let outcome = match opening {
            Ok(opening) => opened(scheduler, opening).await,
            Err(error) => Err(error),
        };
        let problem = match outcome {
            Err(error) if request.wait && error.is_retryable() => error.to_string(),
            outcome => return outcome,
        };
        if problem != logged {
            tracing::warn!("waiting for the bus: {problem}");
            logged.clone_from(&problem);
        }
        let retry_at = scheduler.clock().now().plus_ns(RETRY_PERIOD.as_nanos() as i64);
        let pause_is_over = || (stop.is_stopped() || scheduler.clock().now() >= retry_at).then_some(());
        until(scheduler, STOP_PERIOD, pause_is_over).await;
        if stop.is_stopped() {
            return Err(RunError::Waiting { cause: stop.cause(), problem });
        }
    }
}

/// Waits until the bus is in operation or has failed, with a warning if that is slow.
async fn opened(scheduler: &dyn Scheduler, mut opening: Opening) -> Result<Session, RunError> {
    let slow_at = scheduler.clock().now().plus_ns(SLOW_AFTER.as_nanos() as i64);
    let is_slow = || scheduler.clock().now() >= slow_at;
    // `Some(None)` ends the first wait, for the warning.
    let opened_or_slow = || opening.poll().map(Some).or_else(|| is_slow().then_some(None));
    if let Some(opened) = until(scheduler, STOP_PERIOD, opened_or_slow).await {
        return opened;
    }
    tracing::warn!("{SLOW_BUS}");
    until(scheduler, STOP_PERIOD, || opening.poll()).await
}
