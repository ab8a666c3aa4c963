//! Two independent implementations read the recording. They must decode every message as the daemon wrote it.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use ballbard::run::{BusChoice, RunRequest};
use serde_json::Value;
use shared::recording::schema::{Event, EventKind, flags};
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

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn python_mcap_plots_what_the_ports_have_counted() {
    let python = python_with(&["mcap", "mcap_ros2"]);
    let directory = tempfile::tempdir().unwrap();
    let noisy = RunRequest {
        faults: vec!["noise:3,0.05@5s-11s".parse().unwrap()],
        ..request("noisy", BusChoice::Simulated, Some(Duration::from_secs(20)), true)
    };
    let (path, ours) = record(directory.path(), &noisy, &ball_bar());
    assert!(ours.cycles.iter().all(|cycle| cycle.is_valid()), "it costs no cycle");
    let theirs = read_with(&python, "mcap", &path);
    let counted: Vec<(u64, u64)> = theirs["diagnostics"]
        .as_array()
        .unwrap()
        .iter()
        .map(|second| {
            let status = second["status"].as_array().unwrap();
            let ports = status.iter().find(|one| one["name"] == "ballbard: ports of EL5021 at position 3");
            let errors = ports.map_or("0", |ports| ports["values"]["port0_receive_errors"].as_str().unwrap());
            (errors.parse().unwrap(), ports.map_or(0, |ports| ports["level"].as_u64().unwrap()))
        })
        .collect();
    // The error counters are zero before the fault, increase each second during the fault, and are constant afterwards.
    assert_eq!((counted.len(), counted[0]), (20, (0, 0)), "{counted:?}");
    assert!(counted.is_sorted_by_key(|(errors, _)| *errors), "{counted:?}");
    assert!(counted.windows(2).filter(|pair| pair[0].0 < pair[1].0).count() >= 4, "{counted:?}");
    assert!(counted[12..].iter().all(|last| *last == (counted[19].0, 0)), "{counted:?}");
    let warned = counted.iter().filter(|(_, level)| *level == 1).count();
    assert!((4..=8).contains(&warned), "{counted:?}");
    let told = |event: &Event| event.text.contains("between terminal 2 and terminal 3");
    assert!(ours.events.iter().any(told), "{:?}", ours.events);
}

fn read_with(python: &Path, reader: &str, recording: &Path) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("read_recording.py");
    let output = Command::new(python).arg(script).arg(reader).arg(recording).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Compares a finished recording with the result of the reader. Then compares recovered files after three kinds of damage: a
/// truncation, a flipped bit, and trailing zeros as after a power failure.
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
        // If a cycle differs from the original, it is flagged as lost and contains no data.
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
    compare_events(ours, &theirs);
    compare_diagnostics(ours, theirs["diagnostics"].as_array().unwrap());
    if reader == "mcap" {
        let files = &theirs["attachments"];
        assert_eq!(files["daemon.toml"].as_str(), Some(ours.run.daemon_config.as_str()));
        assert_eq!(files["ball_bar.toml"].as_str(), Some(ours.run.ball_bar_config.as_str()));
        let names: Vec<_> = theirs["runs"].as_array().unwrap().iter().map(|run| &run["name"]).collect();
        assert_eq!(names, [&ours.run.name; 2]);
    }
}

/// Checks that the log of the recording contains a message for each event.
fn compare_events(ours: &Recording, theirs: &Value) {
    let [events, log] = ["events", "log"].map(|key| theirs[key].as_array().unwrap());
    assert_eq!((events.len(), log.len()), (ours.events.len(), ours.events.len()));
    for ((one, event), line) in ours.events.iter().zip(events).zip(log) {
        assert_eq!((event["text"].as_str(), line["msg"].as_str()), (Some(&*one.text), Some(&*one.text)));
        assert_eq!(line["stamp_ns"], event["stamp_ns"]);
        let level = if one.kind == EventKind::Marker { 20 } else { 30 };
        assert_eq!(line["level"].as_u64(), Some(level));
    }
}

/// Checks that there is one diagnostics message per second. It must contain the number of valid cycles, for all encoders
/// together and for each encoder.
fn compare_diagnostics(ours: &Recording, theirs: &[Value]) {
    let seconds = ours.cycles.chunks_exact(100);
    assert_eq!(theirs.len(), seconds.len());
    for (cycles, said) in seconds.zip(theirs) {
        assert_eq!(said["stamp_ns"].as_i64(), Some(cycles[99].sample_time.0));
        let of_encoder = |index: usize| cycles.iter().filter(|cycle| cycle.encoders[index].valid).count();
        let all = cycles.iter().filter(|cycle| cycle.is_valid()).count();
        let valid: Vec<usize> = std::iter::once(all).chain((0..5).map(of_encoder)).collect();
        let status = said["status"].as_array().unwrap();
        assert_eq!(status.len(), 6);
        for (valid, status) in valid.into_iter().zip(status) {
            assert_eq!(status["message"].as_str(), Some(&*format!("{valid} of 100 cycles valid")));
            let level = if valid == 100 {
                0
            } else if valid == 0 {
                2
            } else {
                1
            };
            assert_eq!(status["level"].as_u64(), Some(level), "{status}");
        }
        let lost = cycles.iter().filter(|cycle| cycle.flags & flags::LOST != 0).count();
        let told = status[0]["values"]["lost"].as_str().map_or(0, |lost| lost.parse().unwrap());
        assert_eq!(told, lost);
    }
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
        assert_eq!(other["origin"].as_u64(), Some(one.origin.into()));
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

/// Compares the joint states with the counts. One count is 2 pi / 14 745 600 rad. A velocity is the change of position
/// between two successive valid cycles, divided by the bus time between them.
fn compare_joint_states(ours: &Recording, theirs: &[Value]) {
    assert_eq!(ours.cycles.len(), theirs.len());
    let number = |key: &str, index: usize, joint: usize| theirs[index][key][joint].as_f64();
    for joint in 0..5 {
        assert_eq!(theirs[0]["name"][joint], format!("bar_joint_{}", joint + 1));
        assert_eq!(theirs[0]["frame_id"], "ball_bar_base");
        assert_eq!(number("velocity", 0, joint), None);
        for index in 1..theirs.len() {
            let pair = &ours.cycles[index - 1..=index];
            let [before, now] = [0, 1].map(|at| pair[at].encoders[joint]);
            assert_eq!(number("position", index, joint).is_some(), now.valid);
            if !(before.valid && now.valid && pair[0].origin == pair[1].origin) {
                assert_eq!(number("velocity", index, joint), None);
                continue;
            }
            let turned = f64::from(now.count.wrapping_sub(before.count) as i32);
            let expected_rad = turned * std::f64::consts::TAU / 14_745_600.0;
            let [from, to] = [index - 1, index].map(|at| number("position", at, joint).unwrap());
            assert!((to - from - expected_rad).abs() < 1e-9);
            let expected_rad_s = expected_rad / pair[1].dc_time.seconds_since(pair[0].dc_time);
            assert!((number("velocity", index, joint).unwrap() - expected_rad_s).abs() < 1e-9);
        }
    }
}
