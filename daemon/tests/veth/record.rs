//! Runs that are recorded over a raw socket.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use shared::recording::Recording;
use shared::recording::schema::{CycleRecord, flags};

use super::namespace::{Namespace, serve_segment};
use crate::support::assert_bad_cycles_have_reasons;

fn record(namespace: &Namespace, out: &Path, duration: &str) -> Command {
    let mut record = namespace.ballbard();
    record.args(["record", "--bus", "near", "--name", "veth", "--duration", duration, "--config"]);
    record.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")).arg("--out").arg(out);
    record
}

/// Waits until the run of `record` has its file. On a busy machine the bring-up takes several seconds.
fn wait_until_begun(out: &Path) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !out.join("veth.mcap.active").exists() {
        assert!(Instant::now() < deadline, "no run within a minute");
        thread::sleep(Duration::from_millis(20));
    }
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn a_run_over_a_raw_socket_is_complete() {
    let namespace = Namespace::new("run");
    let _segment = serve_segment(&namespace, &[]);
    let out = tempfile::tempdir().unwrap();
    let output = record(&namespace, out.path(), "5s").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let recording = Recording::open(&out.path().join("veth.mcap")).unwrap();
    assert_eq!(recording.cycles.len(), 500);
    assert!(recording.run.distributed_clocks && recording.run.bus == "near");
    assert_bad_cycles_have_reasons(&recording.cycles);
    for pair in recording.cycles.windows(2).filter(|pair| pair.iter().all(|cycle| cycle.is_valid())) {
        // Joints move at 0.4 rad/s at most, which is about 9400 counts a cycle.
        for (before, after) in pair[0].encoders().iter().zip(pair[1].encoders()) {
            assert!((after.count.wrapping_sub(before.count) as i32).abs() < 10_000);
        }
    }
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn a_second_master_on_an_interface_is_refused_with_who_has_it_and_ruins_nothing() {
    let namespace = Namespace::new("second");
    let _segment = serve_segment(&namespace, &[]);
    let out = tempfile::tempdir().unwrap();
    let first = record(&namespace, out.path(), "5s").stderr(Stdio::null()).spawn().unwrap();
    wait_until_begun(out.path());
    let elsewhere = tempfile::tempdir().unwrap();
    let second = record(&namespace, elsewhere.path(), "1s").output().unwrap();
    assert!(!second.status.success());
    let told = String::from_utf8_lossy(&second.stderr);
    let holder =
        format!("`near` is in use by process {} (`ballbard record`, recording run `veth`)", first.id());
    assert!(told.contains(&holder), "{told}");
    assert!(first.wait_with_output().unwrap().status.success());
    let recording = Recording::open(&out.path().join("veth.mcap")).unwrap();
    assert_bad_cycles_have_reasons(&recording.cycles);
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn an_interface_that_is_unplugged_and_plugged_in_again_is_found_again() {
    let namespace = Namespace::new("unplugged");
    let _segment = serve_segment(&namespace, &[]);
    let out = tempfile::tempdir().unwrap();
    let running = record(&namespace, out.path(), "14s").spawn().unwrap();
    wait_until_begun(out.path());
    thread::sleep(Duration::from_secs(2));
    // Remove both interfaces. The new interfaces have the same names but other numbers.
    namespace.link(&["delete", "near"]);
    thread::sleep(Duration::from_secs(2));
    namespace.plug_in();
    let output = running.wait_with_output().unwrap();
    assert!(output.status.success());
    let recording = Recording::open(&out.path().join("veth.mcap")).unwrap();
    assert_eq!(recording.cycles.len(), 1400);
    assert!(recording.cycles.iter().enumerate().all(|(number, cycle)| cycle.cycle == number as u64));
    assert!(recording.cycles.windows(2).all(|pair| pair[0].sample_time < pair[1].sample_time));
    let down = recording.cycles.iter().filter(|cycle| cycle.flags & flags::BUS_DOWN != 0).count();
    assert!(down >= 50, "{down} cycles while the bus was down");
    let told = |text: &str| recording.events.iter().any(|event| event.text.contains(text));
    assert!(
        told("no EtherCAT device answers on near") && told("bus in operation again"),
        "{:?}",
        recording.events
    );
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn faults_are_switched_by_lines_while_the_segment_is_served() {
    let namespace = Namespace::new("switched");
    let mut segment = serve_segment(&namespace, &[]);
    let mut switches = segment.0.stdin.take().unwrap();
    let out = tempfile::tempdir().unwrap();
    let running = record(&namespace, out.path(), "8s").spawn().unwrap();
    wait_until_begun(out.path());
    thread::sleep(Duration::from_secs(2));
    switches.write_all(b"on gone:4\n").unwrap();
    thread::sleep(Duration::from_secs(2));
    switches.write_all(b"nonsense\noff gone:4\n").unwrap();
    assert!(running.wait_with_output().unwrap().status.success());
    let recording = Recording::open(&out.path().join("veth.mcap")).unwrap();
    assert_eq!(recording.cycles.len(), 800);
    let told = |text: &str| recording.events.iter().any(|event| event.text.contains(text));
    assert!(told("terminal 4 and all behind it do not answer"), "{:?}", recording.events);
    assert!(told("bus in operation again") && told("without power"), "{:?}", recording.events);
    assert_eq!(recording.cycles.last().unwrap().origin, 1);
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn a_recording_is_repeated_on_an_interface_when_play_is_typed() {
    let namespace = Namespace::new("repeated");
    let out = tempfile::tempdir().unwrap();
    let mut made = namespace.ballbard();
    made.args(["record", "--bus", "simulated", "--name", "made", "--duration", "3s", "--fast", "--out"]);
    assert!(made.arg(out.path()).output().unwrap().status.success());
    let file = out.path().join("made.mcap");
    let mut segment = serve_segment(&namespace, &["--replay", file.to_str().unwrap()]);
    let running = record(&namespace, out.path(), "6s").spawn().unwrap();
    wait_until_begun(out.path());
    segment.0.stdin.take().unwrap().write_all(b"play\n").unwrap();
    assert!(running.wait_with_output().unwrap().status.success());

    let counts = |file: &Path| -> Vec<(bool, Vec<u32>)> {
        let cycles = Recording::open(file).unwrap().cycles;
        let row = |cycle: &CycleRecord| cycle.encoders().iter().map(|encoder| encoder.count).collect();
        cycles.iter().map(|cycle| (cycle.is_valid(), row(cycle))).collect()
    };
    let (made, repeated) = (counts(&file), counts(&out.path().join("veth.mcap")));
    // The segment shows the first row until the replay starts, and the last row after the replay has ended.
    let moved = repeated.iter().position(|(valid, row)| *valid && *row != made[0].1).unwrap();
    let at = made.iter().position(|(_, row)| *row == repeated[moved].1).unwrap();
    let pairs = repeated[moved..].iter().zip(&made[at..]);
    assert!(at < 100 && pairs.len() + at == made.len());
    assert!(pairs.clone().all(|((valid, row), (_, expected))| !valid || row == expected));
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn a_run_that_waits_begins_when_the_bus_is_there() {
    let namespace = Namespace::new("waits");
    let out = tempfile::tempdir().unwrap();
    let mut waiting = record(&namespace, out.path(), "1s");
    let waiting = waiting.arg("--wait").stderr(Stdio::piped()).spawn().unwrap();
    thread::sleep(Duration::from_secs(3));
    let _segment = serve_segment(&namespace, &[]);
    let output = waiting.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("waiting for the bus") && said.contains("no EtherCAT device answers"), "{said}");
    assert_eq!(Recording::open(&out.path().join("veth.mcap")).unwrap().cycles.len(), 100);
}
