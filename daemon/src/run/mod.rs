//! One recording run, from the request to the finished file.
//!
//! Four threads share the work. The cycle thread executes the bus cycles in real time and never uses the disk. It passes the
//! cycles through a ring to the recorder. The recorder writes the cycles to the file and never uses the bus. A third thread
//! synchronises the file with the disk. A fourth thread checks whether the disk works ([`Storage`]).
//!
//! A [`Session`] keeps the bus cycles running between runs. The file of a run is created only when the bus is in operation,
//! so a bus that cannot be brought into operation leaves no file.

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

/// Pause between two attempts to bring the bus into operation, for a run that waits for the bus.
const RETRY_PERIOD: Duration = Duration::from_secs(1);
/// If the bus takes longer to come into operation, a warning is logged. One to two seconds are usual.
const SLOW_AFTER: Duration = Duration::from_secs(5);
const SLOW_BUS: &str = "the bus is not in operation after 5 s: replies are late or lost; check cables and contacts, and \
                        `reply_timeout_us` in daemon.toml";
/// Period in which waiting tasks check whether they should end.
const STOP_PERIOD: Duration = Duration::from_millis(10);
/// Longest wait for the disk after the end was requested, so that the program ends within 2 s. The limit
/// applies to the creation of a run's file, to the saving of reference marks, and to the recovery of
/// earlier runs. The next start of the program repeats the recovery.
pub(crate) const DISK_WAIT_AT_END: Duration = Duration::from_millis(1500);

/// Starts to bring a bus into operation, for several runs. `faults` are injected into a simulated bus.
pub fn start_opening(setup: &Setup, bus: &BusChoice, faults: &[FaultWindow]) -> Result<Opening, RunError> {
    let request = RunRequest { bus: bus.clone(), faults: faults.to_vec(), ..RunRequest::default() };
    Session::open(source::prepare(&request, setup)?, setup.clone(), Pace::Clock, &Stop::default())
}

/// Starts to bring a bus into operation over another wire, for tests of the layers above.
#[cfg(test)]
pub(crate) fn open_on_wire(
    wire: Box<dyn crate::segment::FrameWire>,
    setup: &Setup,
) -> Result<Opening, RunError> {
    let prepared = source::PreparedBus::from_config(wire, shared::recording::schema::SIMULATED_BUS, setup);
    Session::open(prepared, setup.clone(), Pace::Clock, &Stop::default())
}

/// Records one run. Completes when the file is finished and the bus is closed. The future sleeps on the
/// scheduler of `setup`.
pub async fn record(setup: &Setup, request: &RunRequest, stop: &Stop) -> Result<RunSummary, RunError> {
    source::check(request)?;
    let session = open_with_retry(setup, request, stop).await?;
    session.log();
    let outcome = record_in_session(setup, &session, &request.run, stop).await;
    // After an error on virtual time, the session is not closed, because the cycle thread may be waiting for a disk that
    // hangs. This is harmless: a request with virtual time always has a simulated bus.
    if outcome.is_ok() || !request.fast {
        session.close().await?;
    }
    outcome
}

/// Claims the directory, records one run in an open session, and waits for its end. If the run is stopped before its file
/// exists, the wait for the disk is limited to [`DISK_WAIT_AT_END`].
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
    // Claim the directory only now, so that a run that does not begin creates no directory.
    let claimed_storage = storage.clone();
    let claim_task = Pending::start(scheduler, "claim", move || claim_directory(&claimed_storage));
    let claim_died = |_| Err(RunError::Thread("claim panicked; its cause is in the log".into()));
    // The run is refused if the disk has a problem, so wait until the state of the disk is known.
    let poll_claim = || storage.is_known().then(|| claim_task.poll()).flatten();
    let _claim = until(scheduler, STOP_PERIOD, || match poll_claim() {
        Some(claim) => Some(claim.unwrap_or_else(claim_died)),
        None => disk_wait_is_over().then(|| Err(no_file_error())),
    })
    .await?;
    // The stop of the run, `run.stop`, is also set when the run is complete. Only the caller's request
    // `stop` limits the wait for the disk.
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

/// Brings the bus into operation. If the request has the option to wait for the bus, failed attempts are repeated. The
/// problem is logged whenever it changes.
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

/// Waits until the bus is in operation or has failed. Logs a warning if that takes long.
async fn opened(scheduler: &dyn Scheduler, mut opening: Opening) -> Result<Session, RunError> {
    let slow_at = scheduler.clock().now().plus_ns(SLOW_AFTER.as_nanos() as i64);
    let is_slow = || scheduler.clock().now() >= slow_at;
    // `Some(None)` ends the first wait when the bus is slow, so that the warning can be logged.
    let opened_or_slow = || opening.poll().map(Some).or_else(|| is_slow().then_some(None));
    if let Some(opened) = until(scheduler, STOP_PERIOD, opened_or_slow).await {
        return opened;
    }
    tracing::warn!("{SLOW_BUS}");
    until(scheduler, STOP_PERIOD, || opening.poll()).await
}
