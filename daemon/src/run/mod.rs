//! One recording run, from the request to the finished file.
//!
//! Two threads: the cycle (real time, no disk) and the recorder (disk, no bus), with a ring between them.
//! The file is begun only when the bus is in operation, so a bus that does not come up leaves no file.

mod cycle_thread;
mod source;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use shared::recording::schema::RunMetadata;
use shared::recording::{ReadError, RecordingWriter, RunFile, WriteError};
use shared::time::UtcNs;

use self::cycle_thread::Ready;
use crate::bus::BusError;
use crate::cycle::RealtimeRequest;
use crate::recorder::{self, Recorder, RunSummary};
use crate::segment::OpenError;

/// Which bus to record from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BusChoice {
    /// The simulated segment in this process, moving by itself.
    Simulated,
    /// The simulated segment, its encoders following a recording.
    Replay(PathBuf),
    /// A network interface.
    Interface(String),
}

/// What to record.
#[derive(Debug, Clone)]
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
    /// The system refused a thread, or one died.
    #[error("a thread of the acquisition failed: {0}")]
    Thread(String),
}

/// Asks a run to end, from any thread or a signal.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    stopped: Arc<AtomicBool>,
    cause: Arc<OnceLock<String>>,
}

impl Stop {
    /// Ends the run; the first cause given is the one that the file states.
    pub fn stop(&self, cause: &str) {
        let _ = self.cause.set(cause.to_owned());
        self.stopped.store(true, Ordering::Release);
    }

    fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Acquire)
    }

    fn cause(&self) -> String {
        self.cause.get().cloned().unwrap_or_else(|| "the cycle ended by itself".into())
    }
}

/// Records one run and returns when its file is finished.
pub fn record(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    let prepared = source::prepare(request, daemon, bar)?;
    let (clock, encoders) = (prepared.clock.clone(), prepared.encoders.clone());
    let (bus, period) = (prepared.plan.name.clone(), prepared.plan.cycle_period);
    let metadata = |ready: &Ready| RunMetadata {
        name: request.name.clone(),
        operator: request.operator.clone(),
        robot: request.robot.clone(),
        note: request.note.clone(),
        started: UtcNs(clock.now().0 + ready.utc_minus_monotonic_ns),
        software: concat!("ballbard ", env!("CARGO_PKG_VERSION")).into(),
        bus,
        cycle_period_ns: period.as_nanos() as u64,
        distributed_clocks: daemon.distributed_clocks,
        utc_minus_monotonic_ns: ready.utc_minus_monotonic_ns,
        encoders,
        devices: ready.devices.clone(),
        daemon_config: toml_text(daemon),
        ball_bar_config: toml_text(bar),
    };
    let ring_cycles = Duration::from_secs(daemon.ring_s.into()).as_nanos() / period.as_nanos().max(1);
    let (sink, ring) = recorder::ring(ring_cycles.max(64) as usize, &clock);
    let (ready_tx, ready_rx) = sync_channel(1);
    let (go_tx, go_rx) = sync_channel(1);
    let realtime =
        RealtimeRequest { core: daemon.realtime.core, fifo_priority: daemon.realtime.fifo_priority };
    let cycle_stop = stop.clone();
    let cycle =
        spawn("cycle", move || cycle_thread::run(prepared, realtime, sink, &ready_tx, &go_rx, &cycle_stop))?;

    let begun = ready_rx.recv().map_err(|_| RunError::Thread("the cycle died while the bus came up".into()));
    let outcome = begun.and_then(|ready| ready).and_then(|ready| {
        report_ready(&ready);
        let metadata = metadata(&ready);
        let writer = RecordingWriter::<RunFile>::create(&daemon.directory, &metadata)?;
        let recorder = Recorder::new(ring, writer, clock.clone(), daemon.sync_period(), &metadata);
        let cause = stop.clone();
        let recording = spawn("recorder", move || recorder.run(|| cause.cause()))?;
        // The cycle waits for this; if it has died meanwhile the recorder finds the ring abandoned.
        let _ = go_tx.send(());
        join(recording)?.map_err(RunError::from)
    });
    if outcome.is_err() {
        stop.stop("the run failed");
    }
    drop(go_tx);
    join(cycle)?;
    outcome
}

fn spawn<T: Send + 'static>(
    name: &str,
    body: impl FnOnce() -> T + Send + 'static,
) -> Result<thread::JoinHandle<T>, RunError> {
    thread::Builder::new().name(name.into()).spawn(body).map_err(|error| RunError::Thread(error.to_string()))
}

fn join<T>(handle: thread::JoinHandle<T>) -> Result<T, RunError> {
    let name = handle.thread().name().unwrap_or("a thread").to_owned();
    handle.join().map_err(|_| RunError::Thread(format!("{name} panicked; its cause is in the log")))
}

fn toml_text(config: &impl serde::Serialize) -> String {
    toml::to_string(config).unwrap_or_else(|error| format!("# cannot be shown: {error}"))
}

fn report_ready(ready: &Ready) {
    let devices: Vec<_> =
        ready.devices.iter().map(|device| format!("{} r{}", device.name, device.revision >> 16)).collect();
    tracing::info!(devices = devices.join(", "), "bus in operation");
    match &ready.realtime {
        Some(report) if report.is_complete() => tracing::info!("cycle runs {report}"),
        Some(report) => tracing::warn!("cycle runs {report}"),
        None => {}
    }
}
