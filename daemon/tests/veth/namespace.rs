//! A network namespace with a veth pair, and a segment that is served at its far end.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Only one test runs at a time, because each test has a bus with a real-time cycle.
static TURN: Mutex<()> = Mutex::new(());

pub struct Namespace {
    name: String,
    _turn: MutexGuard<'static, ()>,
}

impl Namespace {
    pub fn new(test: &str) -> Self {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let name = format!("ballbard-{test}-{}", std::process::id());
        let namespace = Self { name, _turn: turn };
        run(&["netns", "add", &namespace.name]);
        namespace.plug_in();
        namespace
    }

    /// Creates the veth pair and sets both ends up.
    pub fn plug_in(&self) {
        run(&["-n", &self.name, "link", "add", "near", "type", "veth", "peer", "name", "far"]);
        for end in ["near", "far"] {
            self.link(&["set", end, "up"]);
        }
    }

    /// Runs `ip link` in the namespace.
    pub fn link(&self, arguments: &[&str]) {
        run(&[&["-n", &self.name, "link"], arguments].concat());
    }

    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.name]).arg(program).env("RUST_LOG", "warn");
        command
    }

    pub fn ballbard(&self) -> Command {
        self.command(env!("CARGO_BIN_EXE_ballbard"))
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["netns", "delete", &self.name]).status();
    }
}

/// A process that is killed when the test ends.
pub struct Ended(pub Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Serves a segment at the far end of the veth pair. Returns when the segment answers frames.
pub fn serve_segment(namespace: &Namespace, arguments: &[&str]) -> Ended {
    let mut command = namespace.ballbard();
    command.args(["segment", "--interface", "far"]).args(arguments);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.starts_with("serving"), "{line}");
    Ended(child)
}

fn run(arguments: &[&str]) {
    let status = Command::new("ip").args(arguments).status().expect("iproute2");
    assert!(status.success(), "ip {arguments:?}; network namespaces need root");
}
