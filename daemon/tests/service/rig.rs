//! A process of the built program that runs as a service, and helpers that send requests to it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use ballbard::control::status::{Reply, Status};
use serde_json::{Value, json};
use shared::recording::Recording;

use crate::support::{PROGRAM, ballbard};

pub fn shipped() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
}

/// A command for a program that reacts to SIGHUP. Under `nohup`, child processes would otherwise ignore this signal.
pub fn heeding_hangups(program: &str) -> Command {
    let ignored = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = ignored.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    if ignored & 1 == 0 {
        return Command::new(program);
    }
    let mut command = Command::new("env");
    command.args(["--default-signal=HUP", program]);
    command
}

/// A service on the simulated bus that listens on a port of its own.
pub struct Running {
    pub child: Child,
    pub port: String,
    pub directory: tempfile::TempDir,
}

impl Running {
    pub fn start() -> Self {
        Self::with_arguments(&[])
    }

    /// Starts a service with additional command-line arguments.
    pub fn with_arguments(arguments: &[&str]) -> Self {
        Self::logging_to(Stdio::null(), arguments)
    }

    /// Starts a service whose log is written to `stderr`. Writing to `stderr` may fail.
    pub fn logging_to(stderr: Stdio, arguments: &[&str]) -> Self {
        let mut command = heeding_hangups(PROGRAM);
        command.stderr(stderr);
        Self::by(command, tempfile::tempdir().unwrap(), quick().path(), arguments)
    }

    /// Starts a service that keeps recordings and state in this directory.
    pub fn in_directory(directory: tempfile::TempDir, config: &Path, arguments: &[&str]) -> Self {
        let mut command = heeding_hangups(PROGRAM);
        command.stderr(Stdio::null());
        Self::by(command, directory, config, arguments)
    }

    /// Starts a service with the command `command`, which replaces itself with the program.
    pub fn by(mut command: Command, directory: tempfile::TempDir, config: &Path, arguments: &[&str]) -> Self {
        // The service must neither read nor change files of the user who runs the tests.
        command.env("STATE_DIRECTORY", directory.path());
        command
            .env_remove("RUST_LOG")
            .args(["run", "--bus", "simulated", "--port", "0", "--config"])
            .arg(config);
        command.arg("--out").arg(directory.path()).args(arguments).stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let port = line.trim().rsplit_once(':').unwrap().1.to_owned();
        Self { child, port, directory }
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://127.0.0.1:{}/api/{path}", self.port)
    }

    pub fn get<T: serde::de::DeserializeOwned>(&self, path: &str) -> T {
        agent().get(&self.url(path)).call().unwrap().body_mut().read_json().unwrap()
    }

    pub fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        let mut response = agent().post(&self.url(path)).send_json(body).unwrap();
        (response.status().as_u16(), response.body_mut().read_json().unwrap())
    }

    /// Repeats a request until the service grants it, and returns the reply. The start of a run may be refused, because
    /// emulated terminals on a busy machine may answer too late for a moment.
    pub fn granted(&self, path: &str, body: &Value) -> Reply {
        let begun = Instant::now();
        loop {
            let (status, reply) = self.post(path, body);
            let problems = reply["problems"].as_array().map_or(&[][..], Vec::as_slice);
            let is_late = !problems.is_empty() && problems.iter().all(|one| one["code"] == "encoder_invalid");
            if status == 200 || !is_late || begun.elapsed() > Duration::from_secs(40) {
                assert_eq!(status, 200, "{reply}");
                return serde_json::from_value(reply).unwrap();
            }
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    pub fn wait_for(&self, state: &str) -> Status {
        self.wait_until(state, |status| json!(status.state) == state)
    }

    /// Waits until the status meets the condition, and returns the status. Panics with the text `what` after the time-out.
    pub fn wait_until(&self, what: &str, is_it: impl Fn(&Status) -> bool) -> Status {
        let begun = Instant::now();
        loop {
            let status: Status = self.get("status");
            if is_it(&status) {
                return status;
            }
            assert!(begun.elapsed() < Duration::from_secs(40), "{what} never came: {status:?}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits until the headline of the status is READY. If a busy machine has delayed cycles, this takes a second.
    pub fn wait_until_ready(&self) {
        self.wait_until("readiness", |status| status.headline().word == "READY");
    }

    /// Waits until this number of cycles of the run are on disk.
    pub fn wait_for_cycles(&self, cycles: u64) {
        let has_them = |status: &Status| status.run.as_ref().is_some_and(|run| run.cycles >= cycles);
        self.wait_until("enough cycles", has_them);
    }

    /// Runs a command of the program that uses this service.
    pub fn command(&self, arguments: &[&str]) -> Output {
        let mut command = ballbard();
        command.env("RUST_LOG", "off").args(arguments).args(["--port", &self.port]).output().unwrap()
    }

    pub fn signal(&self, signal: nix::sys::signal::Signal) {
        let pid = nix::unistd::Pid::from_raw(i32::try_from(self.child.id()).unwrap());
        nix::sys::signal::kill(pid, signal).unwrap();
    }

    /// Waits until the process of the service ends. No signal is sent.
    pub fn ended(&mut self, within: Duration) -> ExitStatus {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(begun.elapsed() < within, "the service is still there after {within:?}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub fn recording(&self, name: &str) -> Recording {
        Recording::open(&self.directory.path().join(format!("{name}.mcap"))).unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub fn agent() -> ureq::Agent {
    ureq::Agent::config_builder().http_status_as_error(false).proxy(None).build().into()
}

pub fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// A copy of the shipped configuration. The test may change the copy.
pub fn copied() -> tempfile::TempDir {
    let config = tempfile::tempdir().unwrap();
    for name in ["ball_bar.toml", "daemon.toml"] {
        std::fs::copy(shipped().join(name), config.path().join(name)).unwrap();
    }
    config
}

/// The shipped configuration with more frequent synchronisations. The data of a run are then reported as safe earlier.
pub fn quick() -> tempfile::TempDir {
    changed("sync_period_ms = 1000", "sync_period_ms = 300")
}

/// The shipped configuration in which `from` is replaced by `to` in `daemon.toml`.
pub fn changed(from: &str, to: &str) -> tempfile::TempDir {
    let config = copied();
    let file = config.path().join("daemon.toml");
    let daemon = std::fs::read_to_string(&file).unwrap();
    assert!(daemon.contains(from), "daemon.toml has no `{from}`");
    std::fs::write(file, daemon.replace(from, to)).unwrap();
    config
}
