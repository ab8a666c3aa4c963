//! A replay of simulated data records exactly the counts of the simulated encoders, without any difference.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::PathBuf;
use std::time::{Duration, Instant};

use ballbard::run::{BusChoice, RunError};
use shared::config::BallBarConfig;
use shared::recording::schema::{CycleRecord, ReplayOrigin, RunMetadata, SIMULATED_BUS};
use shared::recording::{Recording, RecordingWriter};
use shared::time::DcNs;
use system_tests::{ball_bar, daemon, record, record_run, request};

fn counts_of(cycle: &CycleRecord) -> Vec<u32> {
    cycle.encoders().iter().map(|encoder| encoder.count).collect()
}

fn counts(recording: &Recording) -> Vec<Vec<u32>> {
    recording.cycles.iter().map(counts_of).collect()
}

fn without_encoder_3() -> BallBarConfig {
    let mut bar = ball_bar();
    bar.encoders.retain(|encoder| encoder.joint != 3);
    bar
}

#[test]
fn a_replayed_recording_is_the_same_bit_for_bit_and_needs_a_fraction_of_its_duration() {
    for bar in [ball_bar(), without_encoder_3()] {
        let directory = tempfile::tempdir().unwrap();
        let ten_minutes = Duration::from_secs(600);
        let first = request("first", BusChoice::Simulated, Some(ten_minutes), true);
        let (path, original) = record(directory.path(), &first, &bar);
        assert_eq!(original.cycles.len(), 60_000);
        assert!(original.cycles.iter().all(|cycle| cycle.is_valid()));

        let begun = Instant::now();
        let second = request("second", BusChoice::Replay(path), None, true);
        let (_, replayed) = record(directory.path(), &second, &bar);
        assert_eq!(counts(&replayed), counts(&original));
        assert!(replayed.cycles.iter().all(|cycle| cycle.is_valid()));
        assert!(begun.elapsed() < ten_minutes / 10, "{:?}", begun.elapsed());
        // In virtual time, the replay starts at the time at which the original recording started. The samples of both have
        // the same times on the bus clock. Their UTC differs by a drift, because only the clock of the first bus had a rate
        // error of some ppm.
        let first_off_ns = replayed.cycles[0].sample_time.ns_since(original.cycles[0].sample_time);
        assert!(first_off_ns.abs() < 50_000, "{first_off_ns} ns");
        for (one, other) in original.cycles.iter().zip(&replayed.cycles) {
            let since_first_ns = |recording: &Recording, dc: DcNs| dc.ns_since(recording.cycles[0].dc_time);
            assert_eq!(since_first_ns(&original, one.dc_time), since_first_ns(&replayed, other.dc_time));
        }
    }
}

#[test]
fn a_replay_in_real_time_is_the_same_bit_for_bit() {
    let directory = tempfile::tempdir().unwrap();
    let bar = ball_bar();
    let first = request("first", BusChoice::Simulated, Some(Duration::from_secs(3)), true);
    let (path, original) = record(directory.path(), &first, &bar);
    let second = request("second", BusChoice::Replay(path), None, false);
    let (_, replayed) = record(directory.path(), &second, &bar);
    // If the thread wakes late just before the start, the first cycles of the recording are not a part of the run.
    let skipped = original.cycles.len() - replayed.cycles.len();
    assert!(skipped < 100, "{skipped}");
    for (one, other) in original.cycles[skipped..].iter().zip(&replayed.cycles) {
        assert!(!other.is_valid() || counts_of(one) == counts_of(other), "cycle {}", one.cycle);
    }
}

#[test]
fn a_sample_that_is_not_valid_is_not_valid_in_a_replay_either() {
    let directory = tempfile::tempdir().unwrap();
    let bar = ball_bar();
    let mut first = request("first", BusChoice::Simulated, Some(Duration::from_secs(20)), true);
    first.faults = vec!["lost:0.02@1s-19s".parse().unwrap()];
    let (path, original) = record(directory.path(), &first, &bar);
    assert!(original.cycles.iter().any(|cycle| !cycle.is_valid()));
    let (_, replayed) =
        record(directory.path(), &request("second", BusChoice::Replay(path), None, true), &bar);
    let samples = |recording: &Recording| -> Vec<Vec<Option<u32>>> {
        let valid_counts = |cycle: &CycleRecord| -> Vec<Option<u32>> {
            cycle.encoders().iter().map(|encoder| encoder.valid.then_some(encoder.count)).collect()
        };
        recording.cycles.iter().map(valid_counts).collect()
    };
    assert_eq!(samples(&replayed), samples(&original));
    // A count of 0 in the gaps would look like counters that restarted.
    assert!(replayed.cycles.iter().all(|cycle| cycle.origin == 0));
}

#[test]
fn a_replay_carries_the_origin_of_what_it_plays() {
    let directory = tempfile::tempdir().unwrap();
    let bar = ball_bar();
    let replay = |name: &str, path: PathBuf| {
        record(directory.path(), &request(name, BusChoice::Replay(path), None, true), &bar)
    };
    let request = request("made-up", BusChoice::Simulated, Some(Duration::from_secs(3)), true);
    let (path, made_up) = record(directory.path(), &request, &bar);
    assert!(made_up.run.is_simulated() && made_up.run.replay_of.is_none());
    assert!(replay("again", path).1.run.is_simulated());

    // Write the same counts as if they had been measured on a real bus.
    let run = RunMetadata { name: "measured".into(), bus: "eth1".into(), ..made_up.run };
    let mut writer = RecordingWriter::create(directory.path(), &run).unwrap();
    made_up.cycles.iter().for_each(|cycle| writer.write_cycle(cycle).unwrap());
    let path = writer.finish("stopped", made_up.end.ended).unwrap();
    let (path, once) = replay("once", path);
    let origin = ReplayOrigin { name: "measured".into(), started: run.started, bus: "eth1".into() };
    for replayed in [once, replay("twice", path).1] {
        assert_eq!((replayed.run.is_simulated(), replayed.run.replay_of), (false, Some(origin.clone())));
        assert_eq!(replayed.run.bus, SIMULATED_BUS);
    }
}

#[test]
fn a_damaged_recording_is_not_replayed_and_leaves_no_file() {
    let directory = tempfile::tempdir().unwrap();
    let bar = ball_bar();
    let first = request("first", BusChoice::Simulated, Some(Duration::from_secs(3)), true);
    let (path, _) = record(directory.path(), &first, &bar);
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    let damaged = directory.path().join("damaged.mcap");
    std::fs::write(&damaged, bytes).unwrap();
    let out = directory.path().join("out");
    let second = request("second", BusChoice::Replay(damaged), None, true);
    let error = record_run(&second, &daemon(&out), &bar).unwrap_err();
    assert!(matches!(error, RunError::Replay(_)), "{error}");
    assert!(!out.exists());
}
