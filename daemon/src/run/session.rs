//! A bus in operation, which serves one run after the other without being brought up again.

use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use shared::recording::schema::{DeviceInfo, EncoderInfo, Provenance, ReplayOrigin, RunMetadata};
use shared::recording::{
    Disk, RecordingWriter, Recovery, RunFile, Salvaged, Tap, WriteError, recover_file_on,
};
use shared::time::{MonoNs, UtcNs};

use super::cycle_thread::{self, Interrupts, Job, Ready, RunJob};
use super::error::RunError;
use super::homing::{self, ActiveHoming};
use super::live::Live;
use super::place::finish_leftovers;
use super::request::RunDetails;
use super::source::Prepared;
use crate::bus::BusError;
use crate::claim;
use crate::clock::Clock;
use crate::cycle::RealtimeRequest;
use crate::problem::{Fact, Problem};
use crate::record::{
    self, Limits, Mark, Progress, Recorder, RunLink, RunSummary, STACK_BYTES, Stop, Storage, SyncWork,
};

/// Markers that may wait for the disk.
const MARKS_MAX: usize = 1000;

/// A bus in operation.
pub struct Session {
    jobs: SyncSender<Job>,
    cycle: thread::JoinHandle<()>,
    ready: Ready,
    live: Arc<Live>,
    clock: Clock,
    bus: String,
    replay_of: Option<ReplayOrigin>,
    period: Duration,
    encoders: Vec<EncoderInfo>,
    cycles: Option<u64>,
    daemon: DaemonConfig,
    bar: BallBarConfig,
    storage: Storage,
    ending: Stop,
}

/// A run that is being recorded.
pub struct ActiveRun {
    /// Ends it.
    pub stop: Stop,
    /// How far it is.
    pub progress: Arc<Progress>,
    /// When it began.
    pub started: UtcNs,
    marks: SyncSender<Mark>,
    recorder: thread::JoinHandle<Result<RunSummary, RunError>>,
}

impl Session {
    /// Brings the bus into operation; returns when it is, or why it is not. `opening` ends an
    /// attempt early.
    pub(super) fn open(
        prepared: Prepared,
        daemon: &DaemonConfig,
        bar: &BallBarConfig,
        storage: &Storage,
        opening: &Stop,
    ) -> Result<Self, RunError> {
        let (clock, encoders) = (prepared.clock.clone(), prepared.encoders.clone());
        let (bus, period) = (prepared.plan.name.clone(), prepared.plan.cycle_period);
        let (cycles, replay_of) = (prepared.cycles, prepared.replay_of.clone());
        let (ready_tx, ready_rx) = sync_channel(1);
        let (jobs, jobs_rx) = sync_channel(1);
        let realtime =
            RealtimeRequest { core: daemon.realtime.core, fifo_priority: daemon.realtime.fifo_priority };
        let live = Arc::new(Live::default());
        let seen = Arc::clone(&live);
        let interrupts = Interrupts { opening: opening.clone(), ..Interrupts::default() };
        let ending = interrupts.ending.clone();
        let cycle = spawn("cycle", move || {
            cycle_thread::run(prepared, realtime, &ready_tx, &jobs_rx, &seen, &interrupts);
        })?;
        let Ok(ready) = ready_rx.recv() else {
            join(cycle)?;
            return Err(RunError::Thread("the cycle ended while the bus came up".into()));
        };
        let (daemon, bar, storage) = (daemon.clone(), bar.clone(), storage.clone());
        match ready {
            Ok(ready) => Ok(Self {
                jobs,
                cycle,
                ready,
                live,
                clock,
                bus,
                replay_of,
                period,
                encoders,
                cycles,
                daemon,
                bar,
                storage,
                ending,
            }),
            Err(error) => {
                join(cycle)?;
                Err(error)
            }
        }
    }

    /// Begins a run without waiting for the disk. Its recorder recovers what earlier crashes left, then makes the run's
    /// file, while the cycles wait in the ring; [`Progress::is_open`] once it is there. One run at a time: the one before
    /// must be joined. `tap` is given what is recorded.
    pub fn begin(&self, details: &RunDetails, stop: &Stop, tap: Option<Tap>) -> Result<ActiveRun, RunError> {
        if let Some(problem) = self.storage.problem() {
            return Err(RunError::Disk(problem));
        }
        details.check().map_err(RunError::Request)?;
        let metadata = self.metadata(details);
        let (started, provenance) = (metadata.started, metadata.provenance());
        if !provenance.is_measured() {
            tracing::warn!(run = metadata.name, "{provenance}");
        }
        let ring_cycles = self.daemon.ring_cycles(self.period);
        let (sink, ring) = record::ring(ring_cycles, &self.clock);
        let (marks, marks_rx) = sync_channel(MARKS_MAX);
        let limits = Limits {
            cycle_period: self.period,
            sync_period: self.daemon.sync_period(),
            ring_cycles,
            cycle_waits: !self.clock.is_real(),
        };
        let progress = Arc::new(Progress::new(Arc::clone(ring.handed()), limits, self.clock.clone()));
        self.storage.watch(&progress, stop);
        let link = RunLink {
            marks: marks_rx,
            progress: Arc::clone(&progress),
            storage: self.storage.clone(),
            synchronise: Box::new(SyncWork::spawn),
        };
        let (clock, sync_period, cause) = (self.clock.clone(), self.daemon.sync_period(), stop.clone());
        let utc_minus_monotonic_ns = metadata.utc_minus_monotonic_ns;
        let record = move || {
            let mut writer = create(&link, &metadata)?;
            tap.into_iter().for_each(|tap| writer.set_tap(tap));
            let (progress, disk) = (Arc::clone(&link.progress), link.storage.disk());
            let recorder = Recorder::new(ring, writer, clock, sync_period, &metadata, link);
            recorder.run(|| cause.cause()).map_err(|source| broken(source, &progress, &*disk, cause.cause()))
        };
        let recorder = spawn("recorder", record)?;
        claim::tell(format!("recording run `{}`", details.name));
        let job = RunJob {
            sink,
            stop: stop.clone(),
            cycles: self.cycles_of(details.duration),
            full_fault_cycles: self
                .cycles_of_time(Duration::from_secs(self.daemon.full_fault_s.into()))
                .max(1),
            utc_minus_monotonic_ns,
        };
        // If the cycle has died the recorder finds the ring abandoned and finishes an empty file.
        let _ = self.jobs.send(Job::Run(job));
        Ok(ActiveRun { stop: stop.clone(), progress, started, marks, recorder })
    }

    /// Begins to look for the encoders' reference marks, while a person turns one joint at a time.
    pub fn begin_homing(&self) -> ActiveHoming {
        claim::tell("homing the encoders");
        let (job, active) = homing::begin();
        // If the cycle has died the homing is over at once.
        let _ = self.jobs.send(Job::Home(job));
        active
    }

    /// The encoders, with those reference marks of `details.homing` that their terminals still show.
    fn homed(&self, details: &RunDetails) -> Vec<EncoderInfo> {
        let mut encoders = self.encoders.clone();
        let stale = details.homing.as_ref().map(|homing| homing.apply(&mut encoders, &self.live.latches()));
        if let Some(stale) = stale.filter(|stale| !stale.is_empty()) {
            let problem = Problem::from(Fact::MarksStale { joints: stale });
            tracing::warn!(code = problem.code(), "{problem}");
        }
        encoders
    }

    /// Where runs and reference marks go.
    pub fn disk(&self) -> Arc<dyn Disk> {
        self.storage.disk()
    }

    /// The cycle's thread lives.
    pub fn is_alive(&self) -> bool {
        !self.cycle.is_finished()
    }

    /// Devices on the bus.
    pub fn devices(&self) -> &[DeviceInfo] {
        &self.ready.devices
    }

    /// Encoders in bus order.
    pub fn encoders(&self) -> &[EncoderInfo] {
        &self.encoders
    }

    /// Name of the bus.
    pub fn bus(&self) -> &str {
        &self.bus
    }

    /// The latest sample of each encoder.
    pub fn live(&self) -> &Arc<Live> {
        &self.live
    }

    /// Why the bus does not give whole samples, as far as it is known.
    pub fn outage(&self) -> Option<Fact> {
        let absent = |from| BusError::absent(&self.bus, &self.ready.devices, from).fact();
        self.live.missing_from().map(absent).or_else(|| self.live.outage())
    }

    /// Whether the encoder counts are made up by a program.
    pub fn is_simulated(&self) -> bool {
        Provenance::new(&self.bus, self.replay_of.clone()).simulated
    }

    /// Time between two cycles.
    pub fn period(&self) -> Duration {
        self.period
    }

    /// What the system did not permit the cycle's thread; none if it has all that it asked for.
    pub fn realtime_problem(&self) -> Option<Problem> {
        let report = self.ready.realtime.as_ref().filter(|report| !report.is_complete())?;
        Some(Fact::RealtimeDenied { report: report.to_string() }.into())
    }

    /// Says in the log what the bus is and how the cycle runs.
    pub fn log(&self) {
        let name = |device: &DeviceInfo| format!("{} r{}", device.name, device.revision >> 16);
        let devices: Vec<_> = self.ready.devices.iter().map(name).collect();
        tracing::info!(devices = devices.join(", "), "bus in operation");
        match &self.ready.realtime {
            Some(report) if report.is_complete() => tracing::info!("cycle runs {report}"),
            Some(report) => tracing::warn!("cycle runs {report}"),
            None => {}
        }
    }

    /// Ends the cycle.
    pub fn close(self) -> Result<(), RunError> {
        self.ending.stop("the session is closed");
        drop(self.jobs);
        join(self.cycle)
    }

    fn cycles_of_time(&self, time: Duration) -> u64 {
        u64::try_from(time.as_nanos() / self.period.as_nanos().max(1)).unwrap_or(u64::MAX)
    }

    fn cycles_of(&self, duration: Option<Duration>) -> Option<u64> {
        let wanted = duration.map(|duration| self.cycles_of_time(duration));
        [wanted, self.cycles].into_iter().flatten().min()
    }

    fn metadata(&self, details: &RunDetails) -> RunMetadata {
        // A bus in operation for days outlives the offset of its beginning: each run takes its own.
        let utc_minus_monotonic_ns = if self.clock.is_real() {
            self.clock.utc_minus_monotonic_ns()
        } else {
            self.ready.utc_minus_monotonic_ns
        };
        let about = details.about.clone();
        RunMetadata {
            name: details.name.clone(),
            operator: about.operator,
            robot: about.robot,
            bar: about.bar,
            payload: about.payload,
            note: about.note,
            started: UtcNs(self.clock.now().0 + utc_minus_monotonic_ns),
            software: shared::version::software("ballbard"),
            bus: self.bus.clone(),
            replay_of: self.replay_of.clone(),
            cycle_period_ns: self.period.as_nanos() as u64,
            distributed_clocks: self.daemon.distributed_clocks,
            utc_minus_monotonic_ns,
            encoders: self.homed(details),
            devices: self.ready.devices.clone(),
            daemon_config: toml_text(&self.daemon),
            ball_bar_config: toml_text(&self.bar),
        }
    }
}

impl ActiveRun {
    /// Puts a marker of this instant into the file; whether there is room for it.
    pub fn mark(&self, at: MonoNs, text: String) -> bool {
        self.marks.try_send(Mark { at, text }).is_ok()
    }

    /// The file is finished, or will never be.
    pub fn is_finished(&self) -> bool {
        self.recorder.is_finished()
    }

    /// Waits for the finished file.
    pub fn join(self) -> Result<RunSummary, RunError> {
        drop(self.marks);
        let outcome = join(self.recorder);
        claim::tell("between runs");
        outcome?
    }
}

/// The run's file, when what earlier crashes left is recovered: one of them may have had its name.
fn create(link: &RunLink, run: &RunMetadata) -> Result<RecordingWriter<RunFile>, RunError> {
    let RunLink { progress, storage, .. } = link;
    progress.opening("to recover what earlier runs left");
    let recovered = finish_leftovers(storage);
    progress.opening("to create it");
    // What is known of the disk may be of the place where the run before went on.
    if let Some(full) = storage.full(storage.directory()) {
        return Err(RunError::Disk(full));
    }
    let created = RecordingWriter::create_on(storage.disk(), storage.directory(), run);
    let writer = created.map_err(|error| match error {
        WriteError::Exists(file) if recovered.contains(&file) => RunError::NameRecovered(file),
        error => error.into(),
    })?;
    progress.opened(writer.sink().place().clone());
    Ok(writer)
}

/// A disk that refused: what was written before is made a finished file, if there is room for that.
fn broken(source: WriteError, progress: &Progress, disk: &dyn Disk, cause: String) -> RunError {
    let Some(place) = progress.place() else { return source.into() };
    let (file, content) = match recover_file_on(disk, place.path()) {
        Ok(Recovery::Recovered { file, content, .. } | Recovery::Renamed { file, content }) => {
            (file, content)
        }
        Ok(Recovery::Whole { content }) => (place.path().to_owned(), content),
        Err(_) if place.check().is_err() => {
            return RunError::Broken { source, saved: "nothing of the run is left".into(), content: None };
        }
        Err(error) => {
            let saved = format!(
                "what was written before is in {} and will be recovered when the next run starts ({error})",
                place.path().display()
            );
            return RunError::Broken { source, saved, content: None };
        }
    };
    let lost = progress.get().taken.saturating_sub(content.cycles);
    let saved = format!("{} cycles are saved in {}, the last {lost} are not", content.cycles, file.display());
    let Salvaged { run, cycles, cycles_valid, timing, .. } = *content;
    let provenance = run.provenance();
    let summary =
        RunSummary { path: file, cycles, cycles_valid, cycles_lost: lost, cause, provenance, timing };
    RunError::Broken { source, saved, content: Some(Box::new(summary)) }
}

pub(super) fn spawn<T: Send + 'static>(
    name: &str,
    body: impl FnOnce() -> T + Send + 'static,
) -> Result<thread::JoinHandle<T>, RunError> {
    let thread = thread::Builder::new().name(name.into()).stack_size(STACK_BYTES);
    thread.spawn(body).map_err(|error| RunError::Thread(error.to_string()))
}

pub(super) fn join<T>(handle: thread::JoinHandle<T>) -> Result<T, RunError> {
    let name = handle.thread().name().unwrap_or("a thread").to_owned();
    handle.join().map_err(|_| RunError::Thread(format!("{name} panicked; its cause is in the log")))
}

fn toml_text(config: &impl serde::Serialize) -> String {
    toml::to_string(config).unwrap_or_else(|error| format!("# cannot be shown: {error}"))
}
