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

use std::sync::Arc;
use std::time::Duration;

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
/// How long the end waits for work on disk that the next start would repeat: the end takes less than 2 s.
pub(crate) const LEAVES_WITHIN: Duration = Duration::from_millis(1500);

/// Begins to bring a bus into operation for several runs. `faults` are injected into a simulated one.
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

/// A bus in operation over another wire, for tests of the layers above.
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

/// Records one run; completes when its file is finished and its bus is left. The caller waits on `scheduler`.
pub async fn record(
    scheduler: &Arc<dyn Scheduler>,
    storage: &Storage,
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    source::check(request)?;
    let session = connect(scheduler, storage, request, daemon, bar, stop).await?;
    session.log();
    let outcome = record_from(&**scheduler, storage, &session, &request.run, stop).await;
    // On virtual time no bus must be left in order, and the cycle may wait for a disk that hangs.
    if outcome.is_ok() || !request.fast {
        session.close().await?;
    }
    outcome
}

/// A run that is stopped before it has a file does not wait for the disk that should create it.
async fn record_from(
    scheduler: &dyn Scheduler,
    storage: &Storage,
    session: &Session,
    details: &RunDetails,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    let clock = scheduler.clock();
    let mut stopped = None;
    let mut is_too_late = || {
        let since = stop.is_stopped().then(|| *stopped.get_or_insert_with(|| clock.now()));
        since.is_some_and(|since| clock.now().ns_since(since) > LEAVES_WITHIN.as_nanos() as i64)
    };
    let no_file = || {
        let silent = || Fact::DiskSilent { directory: None, silent_s: None }.into();
        RunError::NoFile { cause: stop.cause(), problem: storage.problem().unwrap_or_else(silent) }
    };
    // Only now: a run that does not begin creates no directory.
    let place = storage.clone();
    let claim = Pending::start(scheduler, "claim", move || claim_directory(&place));
    let died = |_| Err(RunError::Thread("claim panicked; its cause is in the log".into()));
    let claimed = || storage.is_known().then(|| claim.poll()).flatten();
    let _claim = until(scheduler, STOP_PERIOD, || match claimed() {
        Some(claim) => Some(claim.unwrap_or_else(died)),
        None => is_too_late().then(|| Err(no_file())),
    })
    .await?;
    // A run that ends without a request waits for the disk.
    let run = session.begin(details, &Stop::default(), None)?;
    until(scheduler, STOP_PERIOD, || {
        if stop.is_stopped() {
            run.stop.stop(&stop.cause());
        }
        let is_given_up = is_too_late() && !run.progress.is_open();
        run.outcome().or_else(|| is_given_up.then(|| Err(no_file())))
    })
    .await
}

/// A bus in operation. If the request waits for the bus, the attempt is repeated, and its problem is logged whenever it
/// changes.
pub async fn connect(
    scheduler: &Arc<dyn Scheduler>,
    storage: &Storage,
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<Session, RunError> {
    let mut logged = String::new();
    loop {
        let (own, pace) = if request.fast {
            let clock = Clock::virtual_from(UtcNs::from_datetime(chrono::Utc::now()));
            (Threads::on(clock), Pace::Fast)
        } else {
            (Arc::clone(scheduler), Pace::Clock)
        };
        let opening = source::prepare(request, daemon, bar, own.clock().clone())
            .and_then(|prepared| Session::open(prepared, daemon, bar, storage, stop, (&own, pace)));
        let outcome = match opening {
            Ok(mut opening) => {
                let slow_at = scheduler.clock().now().plus_ns(SLOW_AFTER.as_nanos() as i64);
                let is_slow = || scheduler.clock().now() >= slow_at;
                let opened = || opening.poll().map(Some).or_else(|| is_slow().then_some(None));
                match until(&**scheduler, STOP_PERIOD, opened).await {
                    Some(opened) => opened,
                    None => {
                        tracing::warn!("{SLOW_BUS}");
                        until(&**scheduler, STOP_PERIOD, || opening.poll()).await
                    }
                }
            }
            Err(error) => Err(error),
        };
        let missing = match outcome {
            Err(error) if request.wait && error.may_pass() => error.to_string(),
            outcome => return outcome,
        };
        if missing != logged {
            tracing::warn!("waiting for the bus: {missing}");
            logged.clone_from(&missing);
        }
        let retry_at = scheduler.clock().now().plus_ns(RETRY_PERIOD.as_nanos() as i64);
        let is_over = || (stop.is_stopped() || scheduler.clock().now() >= retry_at).then_some(());
        until(&**scheduler, STOP_PERIOD, is_over).await;
        if stop.is_stopped() {
            return Err(RunError::Waiting { cause: stop.cause(), missing });
        }
    }
}
