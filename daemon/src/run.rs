//! One recording run, from the request to the finished file.
//!
//! Two threads: the cycle (real time, no disk) and the recorder (disk, no bus), with a ring between them.
//! The file is begun only when the bus is in operation, so a bus that does not come up leaves no file.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use shared::recording::schema::{DeviceInfo, EncoderInfo, RunMetadata};
use shared::recording::{ReadError, Recording, RecordingWriter, RunFile, WriteError};
use shared::time::{NS_PER_S, UtcNs};

use crate::bus::{Bus, BusError, BusPlan};
use crate::clock::Clock;
use crate::cycle::{Acquisition, RealtimeReport, RealtimeRequest};
use crate::recorder::{self, CycleSink, Recorder, RunSummary};
use crate::segment::simulated::{Replay, ReplayHandle, SegmentConfig, SimulatedSegment, SmoothMotion};
use crate::segment::{EthernetWire, InProcessWire, OpenError, Wire};

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

/// What the cycle's thread reports before the run begins.
struct Ready {
    devices: Vec<DeviceInfo>,
    utc_minus_monotonic_ns: i64,
    realtime: Option<RealtimeReport>,
}

/// Everything that the request decides before a thread starts.
struct Prepared {
    wire: Box<dyn Wire>,
    clock: Clock,
    plan: BusPlan,
    encoders: Vec<EncoderInfo>,
    replay: Option<(ReplayHandle, UtcNs)>,
    cycles: Option<u64>,
}

/// Records one run and returns when its file is finished.
pub fn record(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
    stop: &Stop,
) -> Result<RunSummary, RunError> {
    let prepared = prepare(request, daemon, bar)?;
    let (clock, encoders) = (prepared.clock.clone(), prepared.encoders.clone());
    let period = prepared.plan.cycle_period;
    let bus_name = prepared.plan.name.clone();
    let capacity = (u64::from(daemon.ring_s) * NS_PER_S as u64 / period.as_nanos().max(1) as u64).max(64);
    let (sink, source) = recorder::ring(capacity as usize, &clock);
    let (ready_tx, ready_rx) = sync_channel(1);
    let (go_tx, go_rx) = sync_channel(1);
    let realtime =
        RealtimeRequest { core: daemon.realtime.core, fifo_priority: daemon.realtime.fifo_priority };
    let cycle_stop = stop.clone();
    let cycle =
        spawn("cycle", move || cycle_thread(prepared, realtime, sink, &ready_tx, &go_rx, &cycle_stop))?;

    let begun = ready_rx.recv().map_err(|_| RunError::Thread("the cycle died while the bus came up".into()));
    let outcome = begun.and_then(|ready| ready).and_then(|ready| {
        report_ready(&ready, &bus_name);
        let metadata = RunMetadata {
            name: request.name.clone(),
            operator: request.operator.clone(),
            robot: request.robot.clone(),
            note: request.note.clone(),
            started: UtcNs(clock.now().0 + ready.utc_minus_monotonic_ns),
            software: concat!("ballbard ", env!("CARGO_PKG_VERSION")).into(),
            bus: bus_name,
            cycle_period_ns: period.as_nanos() as u64,
            distributed_clocks: daemon.distributed_clocks,
            utc_minus_monotonic_ns: ready.utc_minus_monotonic_ns,
            encoders,
            devices: ready.devices,
            daemon_config: toml_text(daemon),
            ball_bar_config: toml_text(bar),
        };
        let writer = RecordingWriter::<RunFile>::create(&daemon.directory, &metadata)?;
        let sync_period = Duration::from_millis(daemon.sync_period_ms.into());
        let recorder = Recorder::new(
            source,
            writer,
            clock,
            sync_period,
            metadata.cycle_period_ns,
            ready.utc_minus_monotonic_ns,
        );
        let cause = stop.clone();
        let recording = spawn("recorder", move || recorder.run(|| cause.cause()))?;
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

fn report_ready(ready: &Ready, bus: &str) {
    let devices: Vec<_> =
        ready.devices.iter().map(|device| format!("{} r{}", device.name, device.revision >> 16)).collect();
    tracing::info!(bus, devices = devices.join(", "), "bus in operation");
    match &ready.realtime {
        Some(report) if report.is_complete() => tracing::info!("cycle runs {report}"),
        Some(report) => tracing::warn!("cycle runs {report}"),
        None => {}
    }
}

/// Bus, cycles, and the end of the run. Everything that may block is behind the ring or before the first cycle.
fn cycle_thread(
    prepared: Prepared,
    realtime: RealtimeRequest,
    mut sink: CycleSink,
    ready: &SyncSender<Result<Ready, RunError>>,
    go: &Receiver<()>,
    stop: &Stop,
) {
    let Prepared { wire, clock, plan, replay, cycles, .. } = prepared;
    let realtime = clock.is_real().then(|| realtime.apply());
    let bus = Bus::new(wire, clock.clone(), plan.reply_timeout);
    let mut acquisition = match Acquisition::start(bus, &plan, clock.clone()) {
        Ok(acquisition) => acquisition,
        Err(error) => {
            let _ = ready.send(Err(error.into()));
            return;
        }
    };
    if let Some((_, first_sample)) = &replay {
        acquisition.set_first_sample_time(*first_sample);
    }
    let devices = acquisition.devices().to_vec();
    let utc_minus_monotonic_ns = acquisition.utc_minus_monotonic_ns();
    let _ = ready.send(Ok(Ready { devices, utc_minus_monotonic_ns, realtime }));
    if !wait_for_go(&mut acquisition, &clock, go) {
        return;
    }
    acquisition.begin_run(|first_sample| {
        if let Some((replay, _)) = &replay {
            replay.start_at(first_sample.0);
        }
    });
    let mut done = 0;
    while !stop.is_stopped() && !sink.is_abandoned() && cycles.is_none_or(|wanted| done < wanted) {
        acquisition.next_cycle(&mut |record| {
            if cycles.is_none_or(|wanted| record.cycle < wanted) {
                sink.push(record);
                done = record.cycle + 1;
            }
        });
    }
    stop.stop(if replay.is_some() { "end of the replayed recording" } else { "duration reached" });
    tracing::info!(
        late_us_max = acquisition.late_ns_max() as f64 * 1e-3,
        wire = ?acquisition.wire_counters(),
        "cycle ended"
    );
}

/// Keeps the bus going until the recorder is ready; false if there will be no run.
fn wait_for_go(acquisition: &mut Acquisition, clock: &Clock, go: &Receiver<()>) -> bool {
    use std::sync::mpsc::TryRecvError;
    if !clock.is_real() {
        // Nothing happens on virtual time while nobody asks for it.
        return go.recv().is_ok();
    }
    loop {
        match go.try_recv() {
            Ok(()) => return true,
            Err(TryRecvError::Disconnected) => return false,
            Err(TryRecvError::Empty) => acquisition.idle(),
        }
    }
}

fn prepare(request: &RunRequest, daemon: &DaemonConfig, bar: &BallBarConfig) -> Result<Prepared, RunError> {
    let mut plan = BusPlan {
        name: "simulated".into(),
        encoders: bar.encoders.clone(),
        cycle_period: daemon.cycle_period(),
        distributed_clocks: daemon.distributed_clocks,
        sync0_shift: daemon.cycle_period() / 2,
        reply_timeout: daemon.reply_timeout(),
    };
    let mut encoders: Vec<EncoderInfo> = bar
        .encoders
        .iter()
        .map(|encoder| EncoderInfo { joint: encoder.joint, scale: encoder.scale() })
        .collect();
    let clock = if request.fast {
        Clock::virtual_from(UtcNs::from_datetime(chrono::Utc::now()))
    } else {
        Clock::Real
    };
    let mut cycles = None;
    let mut replay = None;
    let wire: Box<dyn Wire> = match &request.bus {
        BusChoice::Interface(_) if request.fast => {
            return Err(RunError::Request(
                "--fast is virtual time: a real bus cannot follow it; leave it out",
            ));
        }
        BusChoice::Interface(name) => {
            plan.name.clone_from(name);
            Box::new(EthernetWire::open(name)?)
        }
        BusChoice::Simulated if request.fast && request.duration.is_none() => {
            return Err(RunError::Request("--fast without --duration would not end; add --duration"));
        }
        BusChoice::Simulated => {
            // One motion for all encoders of the bar, whose discs are alike.
            let lines = bar.encoders.first().map_or(0, |encoder| encoder.lines);
            let source = SmoothMotion::new(bar.encoders.len(), lines, SegmentConfig::default().seed);
            in_process(plan.encoders.len(), Box::new(source), &clock)
        }
        BusChoice::Replay(path) => {
            let recording = Recording::open(path)?;
            let (source, handle) = follow(path.clone(), &recording, &mut plan)?;
            encoders.clone_from(&recording.run.encoders);
            cycles = Some(recording.cycles.len() as u64);
            replay = recording.cycles.first().map(|first| (handle, first.sample_time));
            in_process(plan.encoders.len(), Box::new(source), &clock)
        }
    };
    if let Some(duration) = request.duration {
        let wanted = (duration.as_nanos() / plan.cycle_period.as_nanos().max(1)) as u64;
        cycles = Some(cycles.map_or(wanted, |all: u64| all.min(wanted)));
    }
    Ok(Prepared { wire, clock, plan, encoders, replay, cycles })
}

fn in_process(
    terminals: usize,
    source: Box<dyn crate::segment::simulated::EncoderSource>,
    clock: &Clock,
) -> Box<dyn Wire> {
    let segment = SimulatedSegment::new(&SegmentConfig { terminals, ..SegmentConfig::default() }, source);
    Box::new(InProcessWire::new(segment, clock.clone()))
}

/// Lets the simulated encoders follow a recording; period and encoders are then those of the recording.
fn follow(
    path: PathBuf,
    recording: &Recording,
    plan: &mut BusPlan,
) -> Result<(Replay, ReplayHandle), RunError> {
    let unsuitable = |problem: String| RunError::ReplayContent { path: path.clone(), problem };
    let ordered = |info: &EncoderInfo| shared::config::EncoderConfig {
        joint: info.joint,
        lines: info.scale.lines,
        interpolation_bits: info.scale.interpolation_bits,
        direction: info.scale.direction,
    };
    plan.encoders = recording.run.encoders.iter().map(ordered).collect();
    plan.cycle_period = Duration::from_nanos(recording.run.cycle_period_ns);
    plan.sync0_shift = plan.cycle_period / 2;
    let counts =
        recording.cycles.iter().flat_map(|record| record.encoders().iter().map(|encoder| encoder.count));
    Replay::new(counts.collect(), plan.encoders.len(), recording.run.cycle_period_ns as i64)
        .map_err(|error| unsuitable(error.to_string()))
}
