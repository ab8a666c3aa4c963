//! The real-time thread of a [`Session`](super::Session). It brings the bus into operation, keeps it in operation, and
//! executes one job after the other. A job is a run or a homing. The record of each cycle is published in [`LatestSamples`].
//! During a run, the record is also written to the ring of the run. On real time, cycles continue while there is no job, so
//! that the latest samples stay current.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};
use std::time::Duration;

use shared::config::RealtimeConfig;
use shared::recording::schema::DeviceInfo;
use shared::time::{MonoNs, UtcNs};

use super::error::RunError;
use super::homing::{HomingJob, HomingTask};
use super::live::LatestSamples;
use super::source::PreparedBus;
use crate::bus::{Bus, BusPlan, DeviceClock};
use crate::clock::Clock;
use crate::cycle::{Acquisition, RealtimeReport};
use crate::problem::flag_names;
use crate::record::{CycleSink, Stop};
use crate::scheduler::Stepper;
use crate::segment::simulated::{Hand, ReplayHandle};

/// What the cycle thread reports once the bus is in operation.
#[derive(Default)]
pub(super) struct Ready {
    pub devices: Vec<DeviceInfo>,
    pub clocks: Vec<DeviceClock>,
    pub utc_minus_monotonic_ns: i64,
    pub realtime: Option<RealtimeReport>,
}

/// A job for the cycle thread.
pub(super) enum Job {
    Run(RunJob),
    Home(HomingJob),
}

/// One run, as a job for the cycle thread.
pub(super) struct RunJob {
    pub sink: CycleSink,
    pub stop: Stop,
    /// Number of cycles after which the run ends, with the cause of that end.
    pub cycle_limit: Option<(u64, &'static str)>,
    /// The run ends after this number of consecutive cycles in which no encoder has a valid sample. The
    /// number is derived from `full_fault_s`.
    pub full_fault_cycles: u64,
    /// The difference `UTC - monotonic` that converts the sample times of the run to UTC \[ns\].
    pub utc_minus_monotonic_ns: i64,
}

/// Time base of the cycles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pace {
    /// Cycles have deadlines on the clock.
    Clock,
    /// Cycles have no deadlines. Each cycle advances the virtual clock. If the ring is full, the cycle
    /// thread waits for the disk.
    Fast,
}

/// Channels and stop requests of the cycle thread.
pub(super) struct CycleChannels {
    pub ready: SyncSender<Result<Ready, RunError>>,
    pub jobs: Receiver<Job>,
    pub live: Arc<LatestSamples>,
    /// Ends the attempt to bring up the bus for the first time.
    pub opening: Stop,
    /// Ends later attempts to restore the bus between two runs. A run or a homing has its own stop request.
    pub ending: Stop,
    /// Receives a message when the thread ends without a panic.
    pub over: SyncSender<()>,
}

/// Executes bus cycles until the queue of jobs is closed. Operations that may block are executed by other threads, which
/// read the ring, or before the first cycle.
pub(super) struct CycleLoop {
    on_bus: OnBus,
    jobs: Receiver<Job>,
    ending: Stop,
    over: SyncSender<()>,
    task: Option<CycleTask>,
    pace: Pace,
}

/// The job that is being executed.
enum CycleTask {
    Run(RunTask),
    Home(Box<HomingTask>),
}

/// The bus with its plan, the handles of its simulation, and the target to which its samples are published.
struct OnBus {
    acquisition: Acquisition,
    clock: Clock,
    live: Arc<LatestSamples>,
    plan: BusPlan,
    replay: Option<(ReplayHandle, UtcNs)>,
    hand: Option<Hand>,
}

impl CycleLoop {
    /// Brings the bus into operation and reports the result to `channels.ready`. Returns `None` if the
    /// bus cannot be brought into operation.
    pub fn start(
        prepared: PreparedBus,
        realtime: RealtimeConfig,
        pace: Pace,
        channels: CycleChannels,
    ) -> Option<Self> {
        let PreparedBus { wire, clock, plan, replay, hand, .. } = prepared;
        let CycleChannels { ready, jobs, live, opening, ending, over } = channels;
        let realtime = clock.is_real().then(|| RealtimeReport::apply(realtime));
        let mut bus = Bus::new(wire, clock.clone(), plan.reply_timeout);
        bus.interrupt_by(opening.flag());
        let operational = match bus.bring_up(&plan) {
            Ok(operational) => operational,
            Err(error) => {
                let identified = bus.identified().to_vec();
                // Release the interface, so that it is free for the next attempt.
                drop(bus);
                let _ = ready.send(Err(RunError::Bus { error, identified }));
                return None;
            }
        };
        let clocks = operational.clocks.clone();
        let mut acquisition = Acquisition::on(bus, operational, &plan, clock.clone());
        acquisition.interrupt_by(ending.flag());
        // Publish the first sample before reporting that the bus is ready.
        acquisition.next_cycle(&mut |record| live.publish(record));
        if let Some((_, first_sample)) = &replay {
            acquisition.set_first_sample_time(*first_sample);
        }
        let devices = acquisition.devices().to_vec();
        let utc_minus_monotonic_ns = acquisition.utc_minus_monotonic_ns();
        let _ = ready.send(Ok(Ready { devices, clocks, utc_minus_monotonic_ns, realtime }));
        let on_bus = OnBus { acquisition, clock, live, plan, replay, hand };
        Some(Self { on_bus, jobs, ending, over, task: None, pace })
    }

    /// Executes one cycle. Returns false once the queue of jobs is closed.
    fn step(&mut self) -> bool {
        let continues = match &mut self.task {
            None => return self.serve_next(),
            Some(CycleTask::Run(run)) => run.step(&mut self.on_bus),
            Some(CycleTask::Home(homing)) => self.on_bus.home(homing),
        };
        if !continues {
            self.task = None;
            self.on_bus.acquisition.interrupt_by(self.ending.flag());
        }
        true
    }

    /// Starts the next job. If there is none, executes a cycle without a job.
    fn serve_next(&mut self) -> bool {
        // With `Pace::Fast`, no cycles are executed between two jobs, so wait for the next job.
        let job = match self.pace {
            Pace::Clock => self.jobs.try_recv(),
            Pace::Fast => self.jobs.recv().map_err(TryRecvError::from),
        };
        match job {
            Ok(Job::Run(job)) => {
                self.on_bus.acquisition.interrupt_by(job.stop.flag());
                self.task = Some(CycleTask::Run(RunTask::begin(job, &mut self.on_bus)));
            }
            Ok(Job::Home(job)) => {
                let OnBus { acquisition, plan, hand, .. } = &mut self.on_bus;
                acquisition.interrupt_by(job.stop.flag());
                let homing = HomingTask::begin(job, acquisition, &plan.encoders, hand.as_ref());
                self.task = Some(CycleTask::Home(Box::new(homing)));
            }
            Err(TryRecvError::Empty) => self.on_bus.idle(),
            Err(TryRecvError::Disconnected) => return false,
        }
        true
    }
}

/// The stepper is `None` if the bus could not be brought into operation, and after the last cycle.
impl Stepper for Option<CycleLoop> {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        let cycle_loop = self.as_mut()?;
        if !cycle_loop.step() {
            let CycleLoop { on_bus, over, .. } = self.take()?;
            // Release the interface before the end is reported.
            drop(on_bus);
            let _ = over.try_send(());
            return None;
        }
        // On real time, the cycle itself waits for its deadline, because it wakes up more precisely than a scheduler. With
        // `Pace::Fast` there are no deadlines. In both cases the scheduler must not pause.
        let OnBus { acquisition, clock, .. } = &cycle_loop.on_bus;
        let sleeps_itself = clock.is_real() || cycle_loop.pace == Pace::Fast;
        let due_ns = if sleeps_itself { 0 } else { acquisition.due().ns_since(clock.now()) };
        Some(Duration::from_nanos(due_ns.max(0).unsigned_abs()))
    }

    fn wait(&mut self, _: Duration) {}
}

impl OnBus {
    /// Executes a cycle without a job.
    fn idle(&mut self) {
        let live = &self.live;
        self.acquisition.next_cycle(&mut |record| live.publish(record));
        self.publish();
    }

    /// Executes a cycle of a homing. Returns false once the homing is over.
    fn home(&mut self, homing: &mut HomingTask) -> bool {
        let continues = homing.step(&mut self.acquisition, &self.live);
        self.publish();
        continues
    }

    /// Publishes the states of the bus and its links.
    fn publish(&self) {
        self.live.publish_bus(&self.acquisition.bus_state(), &self.plan.name);
        self.live.publish_links(self.acquisition.links());
    }
}

/// A run that is being recorded.
struct RunTask {
    // Declared first, so that it is dropped before the job with the ring. After a panic the cause of the end is then set
    // before the recorder notices the end of the ring and finishes the file.
    _guard: PanicGuard,
    job: RunJob,
    /// Number of cycles of this run so far.
    cycles: u64,
    /// Number of consecutive cycles, up to the latest cycle, in which no encoder has a valid sample.
    invalid_cycles: u64,
    /// All flags that occur in these consecutive cycles.
    invalid_flags: u32,
}

impl RunTask {
    fn begin(job: RunJob, on_bus: &mut OnBus) -> Self {
        let OnBus { acquisition, replay, .. } = on_bus;
        acquisition.set_utc_minus_monotonic_ns(job.utc_minus_monotonic_ns);
        acquisition.begin_run(|first_sample| {
            if let Some((replay, _)) = replay {
                replay.start_at(first_sample.0);
            }
        });
        let _guard = PanicGuard(job.stop.clone());
        Self { _guard, job, cycles: 0, invalid_cycles: 0, invalid_flags: 0 }
    }

    /// Executes one cycle. Returns false once the run is over.
    fn step(&mut self, on_bus: &mut OnBus) -> bool {
        let Self { job, cycles, invalid_cycles, invalid_flags, .. } = self;
        let RunJob { sink, stop, cycle_limit, full_fault_cycles, .. } = job;
        let limit_cause = cycle_limit.and_then(|(limit, cause)| (*cycles >= limit).then_some(cause));
        if stop.is_stopped() || sink.is_abandoned() || limit_cause.is_some() {
            self.end(limit_cause);
            return false;
        }
        let live = &on_bus.live;
        on_bus.acquisition.next_cycle(&mut |record| {
            // After missed deadlines, one call returns several records. Records beyond the limit of the run are not recorded.
            if cycle_limit.is_none_or(|(limit, _)| record.cycle < limit) {
                sink.push(record);
                *cycles = record.cycle + 1;
            }
            live.publish(record);
            if record.encoders().iter().any(|encoder| encoder.valid) {
                (*invalid_cycles, *invalid_flags) = (0, 0);
            } else {
                *invalid_cycles += 1;
                *invalid_flags |= record.flags;
            }
        });
        on_bus.publish();
        if let Some(timing) = on_bus.acquisition.last_timing() {
            sink.push_timing(timing);
        }
        if *invalid_cycles >= *full_fault_cycles {
            stop.stop(&full_fault(*invalid_cycles, on_bus.plan.cycle_period, *invalid_flags));
        }
        while let Some(event) = on_bus.acquisition.take_event() {
            sink.push_event(event);
        }
        true
    }

    /// Sets the cause of the end of the run, unless a cause was set before. The cause is the limit that
    /// was reached, or the end of the recorder.
    fn end(&self, limit_cause: Option<&str>) {
        let RunJob { sink, stop, .. } = &self.job;
        stop.stop(limit_cause.filter(|_| !sink.is_abandoned()).unwrap_or("the recorder has ended"));
        // If the recorder ended first, the start was refused or the disk failed, and the service reports that.
        if !sink.is_abandoned() {
            tracing::info!("the last cycle of the run is recorded");
        }
    }
}

/// Sets the cause of the run's end if the thread panics.
struct PanicGuard(Stop);

impl Drop for PanicGuard {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.stop("the cycle thread has ended; the log shows why");
        }
    }
}

/// Cause of the end of a run after this number of cycles without a valid sample. `flags` are the flags of these cycles.
fn full_fault(cycles: u64, cycle_period: Duration, flags: u32) -> String {
    let (time_s, names) = (cycles as f64 * cycle_period.as_secs_f64(), flag_names(flags).join(", "));
    format!("no encoder gave a valid sample for {time_s:.0} s (limit `full_fault_s`; flags: {names})")
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use shared::config::{self, DaemonConfig};

    use super::*;
    use crate::record::{self, FullRing};
    use crate::run::source;
    use crate::segment::InProcessWire;
    use crate::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};

    #[test]
    fn a_run_whose_recorder_has_died_ends_for_that_reason() {
        let bar = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/ball_bar.toml");
        let clock = Clock::virtual_from(UtcNs(0));
        let motion = SmoothMotion::new(5, 3600, 1);
        let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(motion));
        let wire = Box::new(InProcessWire::new(segment, clock.clone()));
        let plan = source::plan("simulated", &DaemonConfig::default(), &config::load(&bar).unwrap());
        let bus = Bus::new(wire, clock.clone(), plan.reply_timeout);
        let acquisition = Acquisition::start(bus, &plan, clock.clone()).unwrap();
        let (live, replay, hand) = (Arc::default(), None, None);
        let mut on_bus = OnBus { acquisition, clock, live, plan, replay, hand };
        let (sink, recorder) = record::ring(64, FullRing::Waits);
        drop(recorder);
        let stop = Stop::default();
        let job = RunJob {
            sink,
            stop: stop.clone(),
            cycle_limit: Some((1, "duration reached")),
            full_fault_cycles: 1000,
            utc_minus_monotonic_ns: 0,
        };
        assert!(!RunTask::begin(job, &mut on_bus).step(&mut on_bus));
        assert_eq!(stop.cause(), "the recorder has ended");
    }
}
