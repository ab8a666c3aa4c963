//! Tests that the file contains everything that entered the ring.

use std::io::Cursor;
use std::path::Path;
use std::sync::mpsc::sync_channel;
use std::time::Instant;

use shared::config::DaemonConfig;
use shared::encoder::EncoderScale;
use shared::recording::schema::{EncoderInfo, EncoderSample, flags};
use shared::recording::{Disk, Recording, SystemDisk, salvage};
use shared::time::DcNs;

use super::*;
use crate::record::{Limits, Stop};
use crate::scheduler::Threads;

fn metadata(clock: &Clock) -> RunMetadata {
    RunMetadata {
        name: "ring".into(),
        operator: String::new(),
        robot: String::new(),
        bar: String::new(),
        payload: String::new(),
        note: String::new(),
        started: UtcNs(0),
        software: String::new(),
        bus: String::new(),
        replay_of: None,
        cycle_period_ns: 10_000_000,
        distributed_clocks: true,
        utc_minus_monotonic_ns: clock.utc_minus_monotonic_ns(),
        encoders: vec![EncoderInfo { joint: 1, scale: EncoderScale::default() }],
        devices: Vec::new(),
        daemon_config: String::new(),
        ball_bar_config: String::new(),
    }
}

/// Origin of the counters in all cycles.
const ORIGIN: u32 = 2;

fn cycle(cycle: u64) -> CycleRecord {
    let mut record = CycleRecord {
        cycle,
        sample_time: UtcNs(1_000_000_000 + cycle as i64 * 10_000_000),
        dc_time: DcNs(1 + cycle as i64 * 10_000_000),
        send_time: MonoNs(2 + cycle as i64 * 10_000_000),
        receive_time: MonoNs(3 + cycle as i64 * 10_000_000),
        origin: ORIGIN,
        encoder_count: 1,
        ..CycleRecord::default()
    };
    record.encoders[0] =
        EncoderSample { joint: 1, count: cycle as u32, valid: true, ..EncoderSample::default() };
    record
}

/// A recorder, with the objects that are needed to end its run.
fn rig(
    disk: Arc<dyn Disk>,
    source: CycleSource,
    daemon: &DaemonConfig,
    clock: &Clock,
    run: &RunMetadata,
) -> (Recorder, Stop) {
    let scheduler = Threads::on(clock.clone());
    let storage = Storage::on(disk, daemon, &*scheduler).unwrap();
    let writer = RecordingWriter::create_on(storage.disk(), storage.directory(), run).unwrap();
    let limits = Limits {
        cycle_period: Duration::from_millis(10),
        sync_period: daemon.sync_period(),
        ring_cycles: source.ring.buffer().capacity(),
        cycle_waits: false,
    };
    let place = writer.sink().place().clone();
    let progress = Arc::new(RunProgress::new(Arc::clone(source.handed()), limits, clock.clone()));
    progress.opened(place);
    let stop = Stop::default();
    storage.watch(&progress, &stop);
    let link = RunLink { marks: sync_channel(1).1, progress, storage, scheduler };
    let recorder = Recorder::new(source, writer, run, link);
    (recorder, stop)
}

/// Writes the content of the ring and finishes the file.
fn run(mut recorder: Recorder, cause: impl FnOnce() -> String) -> Result<RunSummary, WriteError> {
    while recorder.poll()? {
        thread::sleep(Recorder::PERIOD);
    }
    recorder.finish(cause())
}

fn configured(directory: &Path) -> DaemonConfig {
    DaemonConfig {
        directory: directory.join("runs"),
        spare_directory: directory.join("spare"),
        disk_floor_mb: 0,
        ..DaemonConfig::default()
    }
}

fn plain(directory: &Path, source: CycleSource) -> Recorder {
    let clock = Clock::Real;
    rig(Arc::new(SystemDisk), source, &configured(directory), &clock, &metadata(&clock)).0
}

fn record_through_ring(capacity: usize, cycles: u64) -> (Recording, RunSummary) {
    let directory = tempfile::tempdir().unwrap();
    let (mut sink, source) = ring(capacity, FullRing::Drops);
    (0..cycles).for_each(|number| sink.push(&cycle(number)));
    drop(sink);
    let summary = run(plain(directory.path(), source), || "test over".into()).unwrap();
    (Recording::open(&summary.path).unwrap(), summary)
}

#[test]
fn every_cycle_that_fits_into_the_ring_reaches_the_file() {
    let (recording, summary) = record_through_ring(64, 50);
    assert_eq!(recording.cycles, (0..50).map(cycle).collect::<Vec<_>>());
    assert_eq!((summary.cycles, summary.cycles_valid, summary.cycles_lost), (50, 50, 0));
    assert_eq!(recording.end.cause, "test over");
}

#[test]
fn cycles_that_a_full_ring_refused_are_in_the_file_as_lost() {
    let (recording, summary) = record_through_ring(32, 50);
    assert_eq!((summary.cycles, summary.cycles_valid, summary.cycles_lost), (50, 32, 18));
    let lost: Vec<u64> = recording
        .cycles
        .iter()
        .filter(|record| record.flags == flags::LOST)
        .map(|record| record.cycle)
        .collect();
    assert_eq!(lost, (32..50).collect::<Vec<_>>());
    assert!(recording.cycles[32..].iter().all(|record| !record.is_valid()));
    // The lost cycles contain no data of other cycles.
    for record in &recording.cycles[32..] {
        assert_eq!((record.dc_time.0, record.send_time.0, record.receive_time.0), (0, 0, 0));
        assert_eq!(record.sample_time, cycle(record.cycle).sample_time);
        assert_eq!(record.origin, ORIGIN);
    }
    assert!(recording.events.iter().any(|event| event.kind == EventKind::Gap));
}

#[test]
fn the_first_cycle_is_never_lost() {
    let (recording, summary) = record_through_ring(1, 4);
    assert_eq!((summary.cycles, summary.cycles_valid, summary.cycles_lost), (4, 1, 3));
    assert_eq!(recording.cycles[0], cycle(0));
    assert_eq!(recording.cycles.iter().map(|record| record.cycle).collect::<Vec<_>>(), [0, 1, 2, 3]);
}

#[test]
fn a_step_of_the_hosts_utc_is_recorded() {
    // UTC steps before or after the file of the run is created.
    for (before_ns, after_ns) in [(-2_000_000_000, 0), (0, -2_000_000_000)] {
        let directory = tempfile::tempdir().unwrap();
        let clock = Clock::virtual_from(UtcNs(0));
        let (mut sink, source) = ring(1000, FullRing::Drops);
        (0..300).for_each(|number| sink.push(&cycle(number)));
        drop(sink);
        let begun = metadata(&clock);
        clock.step_utc(before_ns);
        let (recorder, _) = rig(Arc::new(SystemDisk), source, &configured(directory.path()), &clock, &begun);
        clock.step_utc(after_ns);
        let recording = Recording::open(&run(recorder, String::new).unwrap().path).unwrap();
        // The events about the disk are not considered. They report that all cycles arrived at once.
        let of_clock = recording.events.iter().filter(|event| event.kind == EventKind::Clock);
        let events: Vec<_> = of_clock.map(|event| (event.code.as_str(), event.text.as_str())).collect();
        let text = "the host's clock was set by -2000.000 ms; sample times of this run do not follow it";
        assert_eq!(events, [("clock_stepped", text)], "{before_ns}, {after_ns}");
    }
}

#[test]
fn at_the_disk_floor_the_run_ends_and_its_file_states_why() {
    let directory = tempfile::tempdir().unwrap();
    let (mut sink, source) = ring(256, FullRing::Drops);
    // The required free space is larger than any disk.
    let daemon = DaemonConfig { disk_floor_mb: 4_000_000_000, ..configured(directory.path()) };
    let clock = Clock::Real;
    let (recorder, stop) = rig(Arc::new(SystemDisk), source, &daemon, &clock, &metadata(&clock));
    (0..150).for_each(|number| sink.push(&cycle(number)));
    let begun = Instant::now();
    while !stop.is_stopped() {
        assert!(begun.elapsed() < Duration::from_secs(10), "the floor was not noticed");
        thread::sleep(Recorder::PERIOD);
    }
    drop(sink);
    let summary = run(recorder, || stop.cause()).unwrap();
    assert_eq!(summary.cycles, 150);
    let cause = Recording::open(&summary.path).unwrap().end.cause;
    assert!(cause.contains("disk floor"), "{cause}");
}

#[test]
fn wherever_a_run_is_cut_its_file_has_the_timing_up_to_a_minute_before() {
    const CYCLES: u64 = 15_000;
    let directory = tempfile::tempdir().unwrap();
    let (mut sink, source) = ring(CYCLES as usize, FullRing::Drops);
    for number in 0..CYCLES {
        sink.push(&cycle(number));
        sink.push_timing(CycleTiming { late_ns: 5_000, round_trip_ns: Some(1), duration_ns: 1 });
    }
    drop(sink);
    let recorder = plain(directory.path(), source);
    let bytes = std::fs::read(run(recorder, String::new).unwrap().path).unwrap();
    // The file is cut just before each of the metadata records, and at the end.
    let name = b"ballbard.timing";
    let records = (0..bytes.len()).filter(|at| bytes[*at..].starts_with(name));
    let cuts: Vec<_> = records
        .map(|at| salvage(Cursor::new(&bytes[..at]), Cursor::new(Vec::new())).unwrap().0)
        .take_while(|cut| cut.end.is_none())
        .collect();
    let told_at: Vec<u64> = cuts.iter().map(|cut| cut.cycles).collect();
    assert!(told_at.len() > 5 && told_at[0] < 100, "{told_at:?}");
    assert!(told_at.windows(2).all(|pair| pair[1] - pair[0] < 6100), "{told_at:?}");
    assert!(CYCLES - told_at[told_at.len() - 2] < 6100, "{told_at:?}");
    assert!(cuts[0].timing.is_none());
    for cut in &cuts[1..] {
        assert_eq!(cut.timing.as_ref().unwrap().lateness.max_ns / 100, 50);
    }
}
