//! The recording opens with two implementations that are not ours, every message decoded.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use ballbard::run::BusChoice;
use serde_json::Value;
use shared::recording::schema::flags;
use shared::recording::{ACTIVE_ENDING, Recording, Recovery, recover_file};
use system_tests::{ball_bar, python_with, record, request};

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn python_mcap_decodes_every_message() {
    compare_with(&python_with(&["mcap", "mcap_ros2"]), "mcap");
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn rosbags_decodes_every_message() {
    compare_with(&python_with(&["rosbags"]), "rosbags");
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn python_mcap_reads_how_the_loop_kept_its_time() {
    let python = python_with(&["mcap", "mcap_ros2"]);
    let directory = tempfile::tempdir().unwrap();
    let seconds = Some(Duration::from_secs(2));
    let (path, ours) =
        record(directory.path(), &request("timing", BusChoice::Simulated, seconds, false), &ball_bar());
    let timing = ours.timing.unwrap();
    assert_eq!(read_with(&python, "mcap", &path)["timing"], serde_json::to_value(&timing).unwrap());
    for durations in [&timing.lateness, &timing.duration] {
        assert_eq!(durations.histogram.iter().map(|bin| bin.cycles).sum::<u64>(), timing.cycles);
    }
    assert!(timing.cycles > 150 && timing.duration.p50_ns >= timing.round_trip.p50_ns, "{timing}");
}

fn read_with(python: &Path, reader: &str, recording: &Path) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("read_recording.py");
    let output = Command::new(python).arg(script).arg(reader).arg(recording).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A finished recording, and what is recovered of it where it is cut short, torn, or followed by the zeros of a power
/// cut.
fn compare_with(python: &Path, reader: &str) {
    let directory = tempfile::tempdir().unwrap();
    let seconds = Some(Duration::from_secs(20));
    let (path, ours) =
        record(directory.path(), &request("readers", BusChoice::Simulated, seconds, true), &ball_bar());
    compare(python, reader, &path, &ours);
    let bytes = std::fs::read(&path).unwrap();
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 0x10;
    let killed = bytes[..bytes.len() * 2 / 3].to_vec();
    let zeros = [&bytes[..bytes.len() / 3], &[0; 4096]].concat();
    for (name, left) in [("killed", killed), ("flipped", flipped), ("zeros", zeros)] {
        let (path, recovered) = recover(&directory.path().join(format!("{name}.{ACTIVE_ENDING}")), &left);
        assert!(recovered.end.recovered && !recovered.cycles.is_empty(), "{name}");
        // What is not as it was is lost, and holds nothing.
        let lost = recovered.cycles.iter().zip(&ours.cycles).filter(|(one, other)| one != other);
        assert!(lost.clone().all(|(cycle, _)| cycle.flags == flags::LOST), "{name}");
        assert_eq!(lost.count() as u64, recovered.end.cycles_lost);
        let whole = recovered.cycles.len() as u64 - recovered.end.cycles_lost;
        assert!(whole < ours.cycles.len() as u64 && (name != "flipped" || whole >= 1950), "{name}: {whole}");
        compare(python, reader, &path, &recovered);
    }
}

fn recover(active: &Path, left: &[u8]) -> (PathBuf, Recording) {
    std::fs::write(active, left).unwrap();
    let Recovery::Recovered { file, .. } = recover_file(active).unwrap() else { panic!("nothing recovered") };
    let recording = Recording::open(&file).unwrap();
    (file, recording)
}

fn compare(python: &Path, reader: &str, path: &Path, ours: &Recording) {
    let theirs = read_with(python, reader, path);
    compare_cycles(ours, theirs["cycles"].as_array().unwrap());
    compare_joint_states(ours, theirs["joint_states"].as_array().unwrap());
    assert_eq!(theirs["events"].as_array().unwrap().len(), ours.events.len());
}

fn compare_cycles(ours: &Recording, theirs: &[Value]) {
    assert_eq!(ours.cycles.len(), theirs.len());
    for (one, other) in ours.cycles.iter().zip(theirs) {
        let numbers = |key: &str| -> Vec<u64> {
            other[key].as_array().unwrap().iter().map(|value| value.as_u64().unwrap()).collect()
        };
        let encoders = one.encoders();
        assert_eq!(other["cycle"].as_u64(), Some(one.cycle));
        assert_eq!(other["log_time_ns"].as_i64(), Some(one.sample_time.0));
        assert_eq!(other["stamp_ns"].as_i64(), Some(one.sample_time.0));
        assert_eq!(other["dc_time_ns"].as_i64(), Some(one.dc_time.0));
        assert_eq!(other["working_counter"].as_u64(), Some(one.working_counter.into()));
        assert_eq!(other["flags"].as_u64(), Some(one.flags.into()));
        assert_eq!(
            numbers("joints"),
            encoders.iter().map(|encoder| encoder.joint.into()).collect::<Vec<u64>>()
        );
        assert_eq!(
            numbers("counts"),
            encoders.iter().map(|encoder| encoder.count.into()).collect::<Vec<u64>>()
        );
        let valid: Vec<bool> =
            other["valid"].as_array().unwrap().iter().map(|value| value.as_bool().unwrap()).collect();
        assert_eq!(valid, encoders.iter().map(|encoder| encoder.valid).collect::<Vec<_>>());
    }
}

/// Positions of the plotted joint states turn by 2 pi / 14 745 600 a count.
fn compare_joint_states(ours: &Recording, theirs: &[Value]) {
    assert_eq!(ours.cycles.len(), theirs.len());
    let position = |index: usize, joint: usize| theirs[index]["position"][joint].as_f64().unwrap();
    for joint in 0..5 {
        assert_eq!(theirs[0]["name"][joint], format!("bar_joint_{}", joint + 1));
        let count = |index: usize| ours.cycles[index].encoders[joint].count;
        for index in 1..theirs.len() {
            let turned = f64::from(count(index).wrapping_sub(count(index - 1)) as i32);
            let expected_rad = turned * std::f64::consts::TAU / 14_745_600.0;
            assert!((position(index, joint) - position(index - 1, joint) - expected_rad).abs() < 1e-9);
        }
    }
}
