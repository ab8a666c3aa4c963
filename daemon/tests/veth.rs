//! The daemon over a raw socket: a veth pair in a network namespace of its own, a simulated segment at its far end.
//! Needs root and iproute2; the namespace is made and removed here.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use shared::recording::Recording;

struct Namespace(String);

impl Namespace {
    fn new() -> Self {
        let namespace = Self(format!("ballbard-test-{}", std::process::id()));
        let name = namespace.0.as_str();
        run(&["netns", "add", name]);
        run(&["-n", name, "link", "add", "near", "type", "veth", "peer", "name", "far"]);
        for end in ["near", "far"] {
            run(&["-n", name, "link", "set", end, "up"]);
        }
        namespace
    }

    fn ballbard(&self) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.0, env!("CARGO_BIN_EXE_ballbard")]).env("RUST_LOG", "warn");
        command
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["netns", "delete", &self.0]).status();
    }
}

/// A served segment, ended with the test.
struct Segment(Child);

impl Segment {
    /// Returns when the segment answers.
    fn serve(namespace: &Namespace) -> Self {
        let mut command = namespace.ballbard();
        let mut child =
            command.args(["segment", "--interface", "far"]).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert!(line.starts_with("serving"), "{line}");
        Self(child)
    }
}

impl Drop for Segment {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run(arguments: &[&str]) {
    let status = Command::new("ip").args(arguments).status().expect("iproute2");
    assert!(status.success(), "ip {arguments:?}");
}

#[test]
fn a_run_over_a_raw_socket_is_complete() {
    if !nix::unistd::geteuid().is_root() || Command::new("ip").arg("-V").output().is_err() {
        assert!(std::env::var_os("CI").is_none(), "this test needs root and iproute2");
        println!("skipped: network namespaces need root and iproute2");
        return;
    }
    let namespace = Namespace::new();
    let _segment = Segment::serve(&namespace);
    let out = tempfile::tempdir().unwrap();
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
    let mut record = namespace.ballbard();
    record.args(["record", "--bus", "near", "--name", "veth", "--duration", "5s", "--config"]);
    let output = record.arg(config).arg("--out").arg(out.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let recording = Recording::open(&out.path().join("veth.mcap")).unwrap();
    assert_eq!(recording.cycles.len(), 500);
    assert!(recording.run.distributed_clocks && recording.run.bus == "near");
    let valid = recording.cycles.iter().filter(|cycle| cycle.is_valid()).count();
    // A stalling host costs some cycles, each of them flagged.
    assert!(valid >= 450, "{valid} of 500 cycles valid");
    for pair in recording.cycles.windows(2).filter(|pair| pair.iter().all(|cycle| cycle.is_valid())) {
        // Joints move at 0.4 rad/s at most: some 9400 counts a cycle.
        for (before, after) in pair[0].encoders().iter().zip(pair[1].encoders()) {
            assert!((after.count.wrapping_sub(before.count) as i32).abs() < 10_000);
        }
    }
}
