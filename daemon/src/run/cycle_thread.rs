//! The real-time thread: brings the bus up, keeps it going, and serves one run after the other.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};

use shared::recording::schema::DeviceInfo;
use shared::time::UtcNs;

use super::error::RunError;
use super::homing::HomingJob;
use super::live::Live;
use super::source::Prepared;
use crate::bus::Bus;
use crate::clock::Clock;
use crate::cycle::{Acquisition, RealtimeReport, RealtimeRequest};
use crate::problem::flag_names;
use crate::record::{CycleSink, Stop};
use crate::segment::simulated::ReplayHandle;

/// What the cycle's thread reports once the bus is in operation.
pub(super) struct Ready {
    pub devices: Vec<DeviceInfo>,
    pub utc_minus_monotonic_ns: i64,
    pub realtime: Option<RealtimeReport>,
}

/// What ends an attempt to bring up the bus between two runs; during a run or a homing that job's own stop does.
#[derive(Clone, Default)]
pub(super) struct Interrupts {
    /// Before the bus is in operation for the first time.
    pub opening: Stop,
    /// Once the bus has been in operation.
    pub ending: Stop,
}

/// What the cycle's thread is asked for.
pub(super) enum Job {
    Run(RunJob),
    Home(HomingJob),
}

impl Job {
    fn stop(&self) -> &Stop {
        match self {
            Self::Run(job) => &job.stop,
            Self::Home(job) => &job.stop,
        }
    }
}

/// One run, as the cycle's thread knows it.
pub(super) struct RunJob {
    pub sink: CycleSink,
    pub stop: Stop,
    /// Cycles after which the run ends.
    pub cycles: Option<u64>,
    /// Full fault: as many cycles in a row without a valid sample of any encoder end the run.
    pub full_fault_cycles: u64,
    /// For the run's sample times \[ns\].
    pub utc_minus_monotonic_ns: i64,
}

/// Bus and cycles, until nobody can send jobs any more. Everything that may block is behind the ring or before
/// the first cycle.
pub(super) fn run(
    prepared: Prepared,
    realtime: RealtimeRequest,
    ready: &SyncSender<Result<Ready, RunError>>,
    jobs: &Receiver<Job>,
    live: &Arc<Live>,
    Interrupts { opening, ending }: &Interrupts,
) {
    let Prepared { wire, clock, plan, replay, hand, .. } = prepared;
    let realtime = clock.is_real().then(|| realtime.apply());
    let mut bus = Bus::new(wire, clock.clone(), plan.reply_timeout);
    bus.interrupt_by(opening.flag());
    let mut acquisition = match Acquisition::start(bus, &plan, clock.clone()) {
        Ok(acquisition) => acquisition,
        Err(error) => {
            let _ = ready.send(Err(error.into()));
            return;
        }
    };
    acquisition.interrupt_by(ending.flag());
    // The first of what others see of the bus.
    acquisition.next_cycle(&mut |record| live.publish(record));
    if let Some((_, first_sample)) = &replay {
        acquisition.set_first_sample_time(*first_sample);
    }
    let devices = acquisition.devices().to_vec();
    let utc_minus_monotonic_ns = acquisition.utc_minus_monotonic_ns();
    let _ = ready.send(Ok(Ready { devices, utc_minus_monotonic_ns, realtime }));
    while let Some(job) = wait_for_job(&mut acquisition, &clock, jobs, live, &plan.name) {
        acquisition.interrupt_by(job.stop().flag());
        match job {
            Job::Run(job) => serve(&mut acquisition, job, replay.as_ref(), live, &plan.name),
            Job::Home(job) => job.serve(&mut acquisition, &plan.encoders, hand.as_ref(), live),
        }
        acquisition.interrupt_by(ending.flag());
    }
}

fn serve(
    acquisition: &mut Acquisition,
    job: RunJob,
    replay: Option<&(ReplayHandle, UtcNs)>,
    live: &Arc<Live>,
    bus: &str,
) {
    let RunJob { mut sink, stop, cycles, full_fault_cycles, utc_minus_monotonic_ns } = job;
    // Dropped before the ring is: the recorder must not finish the file without the cause.
    let _fate = Fate(&stop);
    acquisition.set_utc_minus_monotonic_ns(utc_minus_monotonic_ns);
    acquisition.begin_run(|first_sample| {
        if let Some((replay, _)) = replay {
            replay.start_at(first_sample.0);
        }
    });
    let mut done = 0;
    let (mut blind, mut reasons) = (0, 0);
    while !stop.is_stopped() && !sink.is_abandoned() && cycles.is_none_or(|wanted| done < wanted) {
        acquisition.next_cycle(&mut |record| {
            if cycles.is_none_or(|wanted| record.cycle < wanted) {
                sink.push(record);
                done = record.cycle + 1;
            }
            live.publish(record);
            if record.encoders().iter().any(|encoder| encoder.valid) {
                (blind, reasons) = (0, 0);
            } else {
                (blind, reasons) = (blind + 1, reasons | record.flags);
            }
        });
        live.publish_bus(&acquisition.bus_state(), bus);
        live.publish_links(acquisition.links());
        if let Some(timing) = acquisition.last_timing() {
            sink.push_timing(timing);
        }
        if blind >= full_fault_cycles {
            stop.stop(&full_fault(blind, reasons));
        }
        while let Some(event) = acquisition.take_event() {
            sink.push_event(event);
        }
    }
    stop.stop(match replay {
        _ if sink.is_abandoned() => "the recorder has ended",
        Some(_) => "end of the replayed recording",
        None => "duration reached",
    });
    // The recorder ends first if the start was refused or the disk failed, which the service reports.
    if !sink.is_abandoned() {
        tracing::info!("the last cycle of the run is taken");
    }
}

/// Says why a run ends that takes its thread with it.
struct Fate<'a>(&'a Stop);

impl Drop for Fate<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.stop("full fault: the thread of the cycle has ended; its cause is in the log");
        }
    }
}

fn full_fault(cycles: u64, reasons: u32) -> String {
    let names = flag_names(reasons).join(", ");
    format!("full fault: no encoder gave a valid sample for {cycles} cycles ({names})")
}

/// Keeps the bus going until there is a run to serve; none if there will be no more.
fn wait_for_job(
    acquisition: &mut Acquisition,
    clock: &Clock,
    jobs: &Receiver<Job>,
    live: &Arc<Live>,
    bus: &str,
) -> Option<Job> {
    if !clock.is_real() {
        // Nothing happens on virtual time while nobody asks for it.
        return jobs.recv().ok();
    }
    loop {
        match jobs.try_recv() {
            Ok(job) => return Some(job),
            Err(TryRecvError::Disconnected) => return None,
            Err(TryRecvError::Empty) => {
                acquisition.next_cycle(&mut |record| live.publish(record));
                live.publish_bus(&acquisition.bus_state(), bus);
                live.publish_links(acquisition.links());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use shared::config::{self, DaemonConfig};

    use super::*;
    use crate::record;
    use crate::run::source;
    use crate::segment::InProcessWire;
    use crate::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};

    #[test]
    fn a_run_whose_recorder_has_died_did_not_reach_its_duration() {
        let bar = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/ball_bar.toml");
        let clock = Clock::virtual_from(UtcNs(0));
        let motion = SmoothMotion::new(5, 3600, 1);
        let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(motion));
        let wire = Box::new(InProcessWire::new(segment, clock.clone()));
        let prepared = source::on_wire(wire, &DaemonConfig::default(), &config::load(&bar).unwrap());
        let bus = Bus::new(prepared.wire, clock.clone(), prepared.plan.reply_timeout);
        let mut acquisition = Acquisition::start(bus, &prepared.plan, clock.clone()).unwrap();
        let (sink, recorder) = record::ring(64, &clock);
        drop(recorder);
        let stop = Stop::default();
        let job = RunJob {
            sink,
            stop: stop.clone(),
            cycles: Some(1),
            full_fault_cycles: 1000,
            utc_minus_monotonic_ns: 0,
        };
        serve(&mut acquisition, job, None, &Arc::default(), "simulated");
        assert_eq!(stop.cause(), "the recorder has ended");
    }
}
