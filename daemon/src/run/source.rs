//! Prepares a bus from a request and the configuration, before any thread starts. The result contains the wire (a network
//! interface, or a simulated or replaying segment), the clock, and the plan of the bus.

use std::path::Path;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig, EncoderConfig};
use shared::recording::Recording;
use shared::recording::schema::{EncoderInfo, EncoderSample, ReplayOrigin, SIMULATED_BUS};
use shared::time::UtcNs;

use super::error::RunError;
use super::request::{BusChoice, RunRequest, Setup};
use crate::bus::BusPlan;
use crate::clock::Clock;
use crate::segment::faults::{FaultHandle, FaultWindow, FaultySegment};
use crate::segment::simulated::{
    EncoderSource, Hand, HandTurned, Replay, ReplayHandle, SegmentConfig, SimulatedSegment, SmoothMotion,
};
use crate::segment::{EthernetWire, FrameWire, InProcessWire};

/// Everything that a session needs to operate a bus.
pub(super) struct PreparedBus {
    pub wire: Box<dyn FrameWire>,
    pub clock: Clock,
    pub plan: BusPlan,
    /// Encoders of the run, in bus order.
    pub encoders: Vec<EncoderInfo>,
    /// Origin of the replayed recording; `None` without a replay.
    pub replay_of: Option<ReplayOrigin>,
    /// Handle that starts the replay, and the time of the first sample of the recording.
    pub replay: Option<(ReplayHandle, UtcNs)>,
    /// Handle that turns the simulated joints during a homing.
    pub hand: Option<Hand>,
    /// Handle that controls faults of the simulated bus.
    pub faults: Option<FaultHandle>,
    /// Number of cycles after which every run ends. It is the number of cycles of the replayed recording.
    pub cycles: Option<u64>,
}

/// Derives wire, clock and plan from the request.
pub(super) fn prepare(request: &RunRequest, setup: &Setup) -> Result<PreparedBus, RunError> {
    let prepared = match &request.bus {
        BusChoice::Interface(name) => {
            let wire = Box::new(EthernetWire::open(name)?);
            PreparedBus::from_config(wire, name, setup)
        }
        BusChoice::Simulated => {
            // The motion uses the number of lines of the first encoder, because all discs of the bar
            // have the same number of lines.
            let encoders = &setup.bar.encoders;
            let lines = encoders.first().map_or(0, |encoder| encoder.lines);
            let config = SegmentConfig { terminals: encoders.len(), ..SegmentConfig::default() };
            let (source, hand) = HandTurned::new(SmoothMotion::new(encoders.len(), lines, config.seed));
            let (wire, faults) = in_process(&config, Box::new(source), setup, &request.faults)?;
            let prepared = PreparedBus::from_config(wire, SIMULATED_BUS, setup);
            PreparedBus { hand: Some(hand), faults: Some(faults), ..prepared }
        }
        BusChoice::Replay(path) => prepare_replay(path, &request.faults, setup)?,
    };
    Ok(prepared)
}

/// Refuses a request whose options contradict each other.
pub(super) fn check(request: &RunRequest) -> Result<(), RunError> {
    match &request.bus {
        BusChoice::Interface(_) if request.fast => {
            Err(RunError::Request("--fast is virtual time, which a real bus cannot follow; omit it"))
        }
        BusChoice::Interface(_) if !request.faults.is_empty() => Err(RunError::Request(
            "--fault needs the simulated bus; omit it, or use `ballbard segment --fault`",
        )),
        BusChoice::Simulated if request.fast && request.run.duration.is_none() => {
            Err(RunError::Request("--fast without --duration would not end; add --duration"))
        }
        _ => Ok(()),
    }
}

impl PreparedBus {
    /// Prepares a bus of this name with the configured encoders.
    pub fn from_config(wire: Box<dyn FrameWire>, bus: &str, setup: &Setup) -> Self {
        let info = |encoder: &EncoderConfig| EncoderInfo { joint: encoder.joint, scale: encoder.scale() };
        Self {
            wire,
            clock: setup.scheduler.clock().clone(),
            plan: plan(bus, &setup.daemon, &setup.bar),
            encoders: setup.bar.encoders.iter().map(info).collect(),
            replay_of: None,
            replay: None,
            hand: None,
            faults: None,
            cycles: None,
        }
    }
}

/// Creates the plan of a bus of this name with the configured encoders.
pub(super) fn plan(bus: &str, daemon: &DaemonConfig, bar: &BallBarConfig) -> BusPlan {
    BusPlan {
        name: bus.to_owned(),
        encoders: bar.encoders.clone(),
        cycle_period: daemon.cycle_period(),
        distributed_clocks: daemon.distributed_clocks,
        sync0_shift: daemon.cycle_period() / 2,
        reply_timeout: daemon.reply_timeout(),
    }
}

/// Creates the simulated segment as a wire within this process. `faults` are scheduled on the segment.
/// The returned handle controls its faults.
fn in_process(
    config: &SegmentConfig,
    source: Box<dyn EncoderSource>,
    setup: &Setup,
    faults: &[FaultWindow],
) -> Result<(Box<dyn FrameWire>, FaultHandle), RunError> {
    FaultWindow::ensure_effective(faults, config.terminals)?;
    let (mut segment, handle) = FaultySegment::new(SimulatedSegment::new(config, source), config.seed);
    segment.schedule(faults);
    Ok((Box::new(InProcessWire::with_faults(segment, setup.scheduler.clock().clone())), handle))
}

/// Reads a recording. Returns the recording, a source that repeats the valid encoder counts of the recording,
/// and the handle that starts this source.
pub fn open_replay(path: &Path) -> Result<(Recording, Replay, ReplayHandle), RunError> {
    let recording = Recording::open(path)?;
    // A sample that is not valid may have any count, such as 0 in a cycle without a reply.
    let valid_count = |encoder: &EncoderSample| encoder.valid.then_some(encoder.count);
    let counts = recording.cycles.iter().flat_map(|record| record.encoders().iter().map(valid_count));
    let (source, handle) =
        Replay::new(counts.collect(), recording.run.encoders.len(), recording.run.cycle_period_ns as i64)
            .map_err(|error| RunError::ReplayContent { path: path.to_owned(), problem: error.to_string() })?;
    Ok((recording, source, handle))
}

/// Configuration of the segment for a replay. The clock of the segment does not drift, because a drift
/// would change the speed of the replay.
pub fn replaying_segment(segment: SegmentConfig, recording: &Recording) -> SegmentConfig {
    SegmentConfig { terminals: recording.run.encoders.len(), drift_ppm: 0.0, ..segment }
}

/// Prepares a simulated bus whose encoders follow a recording. Cycle period and encoders are those of the recording.
fn prepare_replay(path: &Path, faults: &[FaultWindow], setup: &Setup) -> Result<PreparedBus, RunError> {
    let (recording, source, handle) = open_replay(path)?;
    let encoders = &recording.run.encoders;
    // A recording that can be replayed has at least one cycle.
    let first_sample = recording.cycles.first().map(|record| record.sample_time);
    let segment = replaying_segment(SegmentConfig::default(), &recording);
    let (wire, _) = in_process(&segment, Box::new(source), setup, faults)?;
    let mut prepared = PreparedBus::from_config(wire, SIMULATED_BUS, setup);
    prepared.plan.encoders = encoders
        .iter()
        .map(|info| EncoderConfig {
            joint: info.joint,
            lines: info.scale.lines,
            interpolation_bits: info.scale.interpolation_bits,
            direction: info.scale.direction,
            mark_deg: None,
        })
        .collect();
    prepared.plan.cycle_period = Duration::from_nanos(recording.run.cycle_period_ns);
    prepared.plan.sync0_shift = prepared.plan.cycle_period / 2;
    prepared.encoders.clone_from(encoders);
    prepared.replay_of = Some(recording.run.origin());
    prepared.replay = first_sample.map(|time| (handle, time));
    prepared.cycles = Some(recording.cycles.len() as u64);
    Ok(prepared)
}
