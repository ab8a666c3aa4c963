//! A bus in operation, on which one run after the other is recorded. [`Session::open`] starts the cycle thread, which brings
//! the bus into operation. A run adds three things: a ring, a job for that thread, and a recorder that creates the file and
//! writes the cycles from the ring. `run::record` opens a session for one run. The service keeps one session for all runs.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use shared::config;
use shared::recording::schema::{DeviceInfo, EncoderInfo, Provenance, ReplayOrigin, RunMetadata, flags};
use shared::recording::{
    Disk, FINISHED_ENDING, RecordingWriter, Recovery, RunFile, Salvaged, Tap, WriteError, recover_file_on,
};
use shared::time::{MonoNs, UtcNs};

use super::cycle_thread::{CycleChannels, CycleLoop, Job, Pace, Ready, RunJob};
use super::error::RunError;
use super::homing::{self, ActiveHoming};
use super::live::LatestSamples;
use super::place::finish_leftovers;
use super::request::{RunDetails, Setup};
use super::source::PreparedBus;
use crate::bus::{DeviceClock, absent};
use crate::claim;
use crate::clock::Clock;
use crate::cycle::RealtimeReport;
use crate::problem::{Fact, Problem};
use crate::record::{
    self, CycleSink, CycleSource, FullRing, Limits, Marker, Recorder, RunLink, RunProgress, RunSummary, Stop,
};
use crate::scheduler::{Died, Scheduler, Stepper, received, until};
use crate::segment::faults::FaultHandle;

/// Capacity of the queue of jobs. If several jobs are queued, only the last job belongs to a current run. The earlier jobs
/// belong to runs that have ended.
const JOBS_MAX: usize = 8;
/// Capacity of the queue of markers for the recorder.
const MARKS_MAX: usize = 1000;
/// Period in which [`Session::close`] checks whether the cycle thread has ended.
const CLOSE_PERIOD: Duration = Duration::from_millis(1);

/// A bus in operation.
pub struct Session {
    jobs: SyncSender<Job>,
    /// Receives a message when the cycle thread has ended. Disconnected if that thread has panicked.
    cycle_over: Receiver<()>,
    /// What the cycle thread reported. Empty until the bus is in operation.
    ready: Ready,
    /// The latest sample of each encoder.
    pub live: Arc<LatestSamples>,
    pace: Pace,
    /// Name of the bus.
    pub bus: String,
    replay_of: Option<ReplayOrigin>,
    /// Time between two cycles.
    pub period: Duration,
    /// Encoders in bus order.
    pub encoders: Vec<EncoderInfo>,
    /// Number of cycles of the replayed recording; `None` without a replay.
    replay_cycles: Option<u64>,
    /// Scheduler, disk and configuration.
    pub setup: Setup,
    /// Ends attempts of the cycle thread to restore the bus. This stop request is set when the session is closed.
    ending: Stop,
    /// Controls faults of the simulated bus; `None` for a real bus and for a replay.
    pub faults: Option<FaultHandle>,
}

/// A run that is being recorded.
pub struct ActiveRun {
    /// Requests the end of the run.
    pub stop: Stop,
    /// Progress of the run, for other threads.
    pub progress: Arc<RunProgress>,
    /// Start of the run.
    pub started: UtcNs,
    marks: SyncSender<Marker>,
    outcome: Receiver<Result<RunSummary, RunError>>,
}

/// A bus that is being brought into operation.
pub struct Opening {
    ready: Receiver<Result<Ready, RunError>>,
    session: Option<Session>,
}

impl Session {
    /// Starts to bring the bus into operation. The stop request `opening` can end the attempt early.
    pub(super) fn open(
        prepared: PreparedBus,
        setup: Setup,
        pace: Pace,
        opening: &Stop,
    ) -> Result<Opening, RunError> {
        let (ready_tx, ready) = sync_channel(1);
        let (jobs, jobs_rx) = sync_channel(JOBS_MAX);
        let (over, cycle_over) = sync_channel(1);
        let (live, ending) = (Arc::<LatestSamples>::default(), Stop::default());
        let session = Self {
            jobs,
            cycle_over,
            ready: Ready::default(),
            live: Arc::clone(&live),
            pace,
            bus: prepared.plan.name.clone(),
            replay_of: prepared.replay_of.clone(),
            period: prepared.plan.cycle_period,
            encoders: prepared.encoders.clone(),
            replay_cycles: prepared.cycles,
            setup,
            ending: ending.clone(),
            faults: prepared.faults.clone(),
        };
        let realtime = session.setup.daemon.realtime.clone();
        let channels =
            CycleChannels { ready: ready_tx, jobs: jobs_rx, live, opening: opening.clone(), ending, over };
        let cycle = move || CycleLoop::start(prepared, realtime, pace, channels);
        start(&*session.setup.scheduler, "cycle", cycle)?;
        Ok(Opening { ready, session: Some(session) })
    }

    /// Begins a run without waiting for the disk. The recorder first recovers crashed runs and then creates the file of the
    /// run. The cycles wait in the ring until the file exists, which [`RunProgress::is_open`] reports. Only one run may be
    /// active at a time, so the previous run must be over. `tap` receives the recorded messages.
    pub fn begin(&self, details: &RunDetails, tap: Option<Tap>) -> Result<ActiveRun, RunError> {
        // Refuse the run if the disk has a problem or a text is invalid.
        if let Some(problem) = self.setup.storage.problem() {
            return Err(RunError::Disk(problem));
        }
        details.about.check().map_err(RunError::Request)?;
        let metadata = self.metadata(details);
        let (started, provenance) = (metadata.started, metadata.provenance());
        if !provenance.is_measured() {
            tracing::warn!(run = metadata.name, "{provenance}");
        }
        // Create the ring between cycle thread and recorder, and the channels for markers and progress.
        let ring_cycles = self.setup.daemon.ring_cycles(self.period);
        let (sink, ring) = self.ring(ring_cycles);
        let (marks, marks_rx) = sync_channel(MARKS_MAX);
        let limits = Limits {
            cycle_period: self.period,
            sync_period: self.setup.daemon.sync_period(),
            ring_cycles,
            cycle_waits: self.pace == Pace::Fast,
        };
        let progress = Arc::new(RunProgress::new(Arc::clone(ring.handed()), limits, self.clock().clone()));
        let stop = Stop::default();
        self.setup.storage.watch(&progress, &stop);
        let link = RunLink {
            marks: marks_rx,
            progress: Arc::clone(&progress),
            storage: self.setup.storage.clone(),
            scheduler: Arc::clone(&self.setup.scheduler),
        };
        let job = self.run_job(sink, &stop, details.duration, metadata.utc_minus_monotonic_ns);
        let (result, outcome) = sync_channel(1);
        // Start the recorder before the job is sent to the cycle thread, so that the ring has a reader.
        let recording = RunRecording {
            pending: Some(PendingRun { ring, link, metadata, tap }),
            recorder: None,
            stop: stop.clone(),
            progress: Arc::clone(&progress),
            disk: self.setup.storage.disk(),
            result,
        };
        start(&*self.setup.scheduler, "recorder", || recording)?;
        claim::set_activity(format!("recording run `{}`", details.name));
        // If the cycle thread does not accept the job, the recorder finds the ring abandoned and finishes an empty file.
        let _ = self.jobs.try_send(Job::Run(job));
        Ok(ActiveRun { stop, progress, started, marks, outcome })
    }

    /// Provides cycles, events and timing without recording them to a file. Ends after this duration, or when `stop` is set.
    pub fn begin_watch(&self, duration: Option<Duration>, stop: &Stop) -> CycleSource {
        let (sink, source) = self.ring(self.setup.daemon.ring_cycles(self.period));
        let job = self.run_job(sink, stop, duration, self.clock().utc_minus_monotonic_ns());
        // If the cycle thread does not accept the job, the source ends at once.
        let _ = self.jobs.try_send(Job::Run(job));
        source
    }

    /// Creates a ring with space for this number of cycles, between the cycle thread and the recorder.
    fn ring(&self, cycles: usize) -> (CycleSink, CycleSource) {
        record::ring(cycles, if self.pace == Pace::Fast { FullRing::Waits } else { FullRing::Drops })
    }

    /// Creates the job for the cycle thread, for a run or a watch.
    fn run_job(
        &self,
        sink: CycleSink,
        stop: &Stop,
        duration: Option<Duration>,
        utc_minus_monotonic_ns: i64,
    ) -> RunJob {
        let full_fault = Duration::from_secs(self.setup.daemon.full_fault_s.into());
        RunJob {
            sink,
            stop: stop.clone(),
            cycle_limit: self.cycle_limit(duration),
            full_fault_cycles: self.whole_cycles_in(full_fault).max(1),
            utc_minus_monotonic_ns,
        }
    }

    /// Begins a homing, during which a person turns one joint after the other.
    pub fn begin_homing(&self) -> ActiveHoming {
        claim::set_activity("homing the encoders");
        let (job, active) = homing::begin();
        // If the cycle thread does not accept the job, the homing ends at once.
        let _ = self.jobs.try_send(Job::Home(job));
        active
    }

    /// The encoders with the reference marks in `details.homing`. Marks that no longer agree with the latch of their
    /// terminal are omitted and logged. While the bus is down, the latches are unknown, so all marks are omitted.
    fn encoders_with_marks(&self, details: &RunDetails) -> Vec<EncoderInfo> {
        let mut encoders = self.encoders.clone();
        let latches = self.live.latches();
        let is_down = self.live.flags() & flags::BUS_DOWN != 0;
        let known = if is_down { &latches[..0] } else { &latches[..] };
        let stale = details.homing.as_ref().map(|homing| homing.apply(&mut encoders, known));
        if let Some(stale) = stale.filter(|stale| !stale.is_empty()) {
            let problem = Problem::from(Fact::MarksStale { joints: stale });
            tracing::warn!(code = problem.code(), "{problem}");
        }
        encoders
    }

    /// Whether the cycle thread is running.
    pub fn is_alive(&self) -> bool {
        received(&self.cycle_over).is_none()
    }

    fn clock(&self) -> &Clock {
        self.setup.scheduler.clock()
    }

    /// The devices on the bus.
    pub fn devices(&self) -> &[DeviceInfo] {
        &self.ready.devices
    }

    /// Clocks of the devices at the time when the bus came into operation.
    pub fn clocks(&self) -> &[DeviceClock] {
        &self.ready.clocks
    }

    /// Why the bus delivers no complete samples; `None` if the cause is unknown or the bus works.
    pub fn outage(&self) -> Option<Fact> {
        let missing_devices = |from| absent(&self.bus, &self.ready.devices, from);
        self.live.missing_from().map(missing_devices).or_else(|| self.live.outage())
    }

    /// Whether the encoder counts are generated by a program.
    pub fn is_simulated(&self) -> bool {
        Provenance::new(&self.bus, self.replay_of.clone()).simulated
    }

    /// Real-time permissions of the cycle thread; `None` on virtual time.
    pub fn realtime(&self) -> Option<&RealtimeReport> {
        self.ready.realtime.as_ref()
    }

    /// Problem that lists the real-time permissions that the cycle thread lacks; `None` if it has all of them.
    pub fn realtime_problem(&self) -> Option<Problem> {
        let report = self.realtime().filter(|report| !report.is_complete())?;
        Some(Fact::RealtimeDenied { report: report.to_string() }.into())
    }

    /// Logs the devices of the bus and the real-time permissions of the cycle thread.
    pub fn log(&self) {
        let name = |device: &DeviceInfo| format!("{} r{}", device.name, device.type_revision());
        let devices: Vec<_> = self.ready.devices.iter().map(name).collect();
        tracing::info!(devices = devices.join(", "), "bus in operation");
        match &self.ready.realtime {
            Some(report) if report.is_complete() => tracing::info!("cycle runs {report}"),
            Some(report) => tracing::warn!("cycle runs {report}"),
            None => {}
        }
    }

    /// Ends the cycle thread. Completes when the thread has ended.
    pub async fn close(self) -> Result<(), RunError> {
        let scheduler = Arc::clone(&self.setup.scheduler);
        let cycle_over = self.begin_close();
        let over = until(&*scheduler, CLOSE_PERIOD, || received(&cycle_over)).await;
        over.map_err(|Died| RunError::Thread("the cycle panicked; its cause is in the log".into()))
    }

    /// Requests the end of the cycle thread. The receiver stays connected until the thread has ended.
    pub fn begin_close(self) -> Receiver<()> {
        self.ending.stop("the session is closed");
        // Dropping the rest of the session closes the queue of jobs, which ends the cycle thread.
        self.cycle_over
    }

    /// Number of whole cycles in this time.
    fn whole_cycles_in(&self, time: Duration) -> u64 {
        u64::try_from(time.as_nanos() / self.period.as_nanos().max(1)).unwrap_or(u64::MAX)
    }

    /// Number of cycles after which a run ends, and the cause. The limit is the duration or the end of
    /// the replay, whichever comes first.
    fn cycle_limit(&self, duration: Option<Duration>) -> Option<(u64, &'static str)> {
        let wanted = duration.map(|duration| (self.whole_cycles_in(duration), "duration reached"));
        let replayed = self.replay_cycles.map(|cycles| (cycles, "end of the replayed recording"));
        [wanted, replayed].into_iter().flatten().min_by_key(|(cycles, _)| *cycles)
    }

    /// Metadata of a run that begins now.
    fn metadata(&self, details: &RunDetails) -> RunMetadata {
        // Read the difference between UTC and the monotonic clock again for each run, because the bus
        // may have been in operation for days.
        let utc_minus_monotonic_ns = match self.pace {
            Pace::Clock => self.clock().utc_minus_monotonic_ns(),
            Pace::Fast => self.ready.utc_minus_monotonic_ns,
        };
        let about = details.about.clone();
        RunMetadata {
            name: details.name.clone(),
            operator: about.operator,
            robot: about.robot,
            bar: about.bar,
            payload: about.payload,
            note: about.note,
            started: UtcNs(self.clock().now().0 + utc_minus_monotonic_ns),
            software: shared::version::software("ballbard"),
            bus: self.bus.clone(),
            replay_of: self.replay_of.clone(),
            cycle_period_ns: self.period.as_nanos() as u64,
            distributed_clocks: self.setup.daemon.distributed_clocks,
            utc_minus_monotonic_ns,
            encoders: self.encoders_with_marks(details),
            devices: self.ready.devices.clone(),
            daemon_config: toml_text(&self.setup.daemon),
            ball_bar_config: toml_text(&self.setup.bar),
        }
    }
}

impl ActiveRun {
    /// Queues a marker with the time `at` for the file. Returns false if the queue is full.
    pub fn mark(&self, at: MonoNs, text: String) -> bool {
        self.marks.try_send(Marker { at, text }).is_ok()
    }

    /// Result of the run: the finished file, or an error; `None` until the run is over. It is returned only once.
    pub fn outcome(&self) -> Option<Result<RunSummary, RunError>> {
        let outcome = received(&self.outcome)?.unwrap_or_else(|Died| Err(recorder_panicked()));
        claim::set_activity("between runs");
        Some(outcome)
    }

    /// Blocks until the file is finished.
    pub fn join(self) -> Result<RunSummary, RunError> {
        self.outcome.recv().unwrap_or_else(|_| Err(recorder_panicked()))
    }
}

fn recorder_panicked() -> RunError {
    RunError::Thread("recorder panicked; its cause is in the log".into())
}

impl Opening {
    /// The session with the bus in operation, or an error; `None` while the bus is being brought into
    /// operation. It is returned only once.
    pub fn poll(&mut self) -> Option<Result<Session, RunError>> {
        let ended_early = "the cycle ended while the bus came up; its cause is in the log";
        let ready = received(&self.ready)?;
        let ready = ready.unwrap_or_else(|Died| Err(RunError::Thread(ended_early.into())));
        let session = self.session.take()?;
        Some(ready.map(|ready| Session { ready, ..session }))
    }
}

/// Everything that a run needs before its file has been created.
struct PendingRun {
    ring: CycleSource,
    link: RunLink,
    metadata: RunMetadata,
    tap: Option<Tap>,
}

/// The stepper that creates the file of a run, records into it, and finishes it.
struct RunRecording {
    pending: Option<PendingRun>,
    recorder: Option<Recorder>,
    stop: Stop,
    progress: Arc<RunProgress>,
    disk: Arc<dyn Disk>,
    result: SyncSender<Result<RunSummary, RunError>>,
}

impl RunRecording {
    /// Creates the file in the first step, then records the cycles from the ring. Returns the summary
    /// once the file is finished.
    fn step(&mut self) -> Result<Option<RunSummary>, RunError> {
        if let Some(PendingRun { ring, link, metadata, tap }) = self.pending.take() {
            let mut writer = create(&link, &metadata)?;
            if let Some(tap) = tap {
                writer.set_tap(tap);
            }
            self.recorder = Some(Recorder::new(ring, writer, &metadata, link));
        }
        let continues = self.recorder.as_mut().map_or(Ok(false), Recorder::poll);
        let finished = match continues {
            Ok(true) => return Ok(None),
            Ok(false) => self.recorder.take().map(|recorder| recorder.finish(self.stop.cause())).transpose(),
            Err(error) => Err(error),
        };
        // Drop the recorder to release the lock of the file. If recording failed, the file is recovered below.
        self.recorder = None;
        finished.map_err(|error| salvage(error, &self.progress, &*self.disk, self.stop.cause()))
    }
}

impl Stepper for RunRecording {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        let outcome = self.step().transpose();
        let Some(outcome) = outcome else { return Some(Recorder::PERIOD) };
        // If the service is ending, it may have dropped the receiver. The result is then not needed.
        let _ = self.result.send(outcome);
        None
    }
}

/// Creates the file of the run. Recovers crashed runs first, because one of them may have the name of the run.
fn create(link: &RunLink, run: &RunMetadata) -> Result<RecordingWriter<RunFile>, RunError> {
    let RunLink { progress, storage, .. } = link;
    progress.opening("recovering earlier runs");
    let recovered = finish_leftovers(storage);
    progress.opening("creating it");
    // Check the disk again, because its known state may be that of the directory of the previous run.
    if let Some(full) = storage.full(storage.directory()) {
        return Err(RunError::Disk(full));
    }
    // Recordings are selected by name, so a run in the spare directory must not have this name either.
    let spare = storage.spare().join(format!("{}.{FINISHED_ENDING}", run.name));
    let created = if storage.disk().has(&spare).unwrap_or(false) {
        Err(WriteError::Exists(spare))
    } else {
        RecordingWriter::create_on(storage.disk(), storage.directory(), run)
    };
    let writer = created.map_err(|error| match error {
        WriteError::Exists(file) if recovered.contains(&file) => RunError::NameRecovered(file),
        error => error.into(),
    })?;
    progress.opened(writer.sink().place().clone());
    Ok(writer)
}

/// Recovers the cycles that were written before the disk failed. Returns the error that describes the
/// failure and the saved cycles.
fn salvage(source: WriteError, progress: &RunProgress, disk: &dyn Disk, cause: String) -> RunError {
    let Some(place) = progress.place() else { return source.into() };
    // Recover the file as far as possible.
    let (file, content) = match recover_file_on(disk, place.path()) {
        Ok(Recovery::Recovered { file, content, .. } | Recovery::Renamed { file, content }) => {
            (file, content)
        }
        Ok(Recovery::Whole { content }) => (place.path().to_owned(), content),
        Err(_) if place.check().is_err() => {
            return RunError::Broken { source, saved: "no part of the run is saved".into(), content: None };
        }
        Err(error) => {
            let saved = format!(
                "the earlier cycles are in {} and will be recovered when the next run starts ({error})",
                place.path().display()
            );
            return RunError::Broken { source, saved, content: None };
        }
    };
    // Report the saved cycles, and count the unsaved cycles as lost.
    let Salvaged { run, cycles, cycles_valid, cycles_lost, timing, .. } = *content;
    let unsaved = progress.get().taken.saturating_sub(cycles);
    let saved = format!(
        "{} cycles are saved in {}, the last {unsaved} are not",
        cycles - cycles_lost,
        file.display()
    );
    let (cycles_lost, provenance) = (cycles_lost + unsaved, run.provenance());
    let summary = RunSummary { path: file, cycles, cycles_valid, cycles_lost, cause, provenance, timing };
    RunError::Broken { source, saved, content: Some(Box::new(summary)) }
}

/// Starts a stepper that the function `begin` creates.
fn start<S: Stepper + 'static>(
    scheduler: &dyn Scheduler,
    name: &str,
    begin: impl FnOnce() -> S + Send + 'static,
) -> Result<(), RunError> {
    let started = scheduler.start(name, Box::new(|| Box::new(begin())));
    started.map_err(|error| RunError::Thread(error.to_string()))
}

fn toml_text(config: &impl serde::Serialize) -> String {
    config::to_toml(config).unwrap_or_else(|error| format!("# cannot be shown: {error}"))
}
