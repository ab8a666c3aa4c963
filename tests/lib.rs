//! Helpers of the system tests: they load the shipped configuration, record runs, and find a Python interpreter.
#![allow(clippy::expect_used, clippy::panic, reason = "tests")]

pub mod fuzzing;

use std::path::{Path, PathBuf};
use std::time::Duration;

use ballbard::clock::Clock;
use ballbard::run::{
    self, About, BusChoice, RunDetails, RunError, RunRequest, RunSummary, Setup, Stop, Storage,
};
use ballbard::scheduler::Threads;
use shared::config::{self, BallBarConfig, DaemonConfig};
use shared::recording::Recording;

/// Directory of the shipped configuration.
pub fn config_directory() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
}

/// Bar configuration of `config/ball_bar.toml`.
pub fn ball_bar() -> BallBarConfig {
    config::load(&config_directory().join("ball_bar.toml")).expect("shipped ball_bar.toml")
}

/// The shipped daemon configuration with one change: recordings are written to `directory`.
pub fn daemon(directory: &Path) -> DaemonConfig {
    let shipped = config::load(&config_directory().join("daemon.toml")).expect("shipped daemon.toml");
    DaemonConfig { directory: directory.to_owned(), ..shipped }
}

/// A request for a run on this bus. `fast` selects virtual time.
pub fn request(name: &str, bus: BusChoice, duration: Option<Duration>, fast: bool) -> RunRequest {
    let about = About { operator: "test".into(), robot: "none".into(), ..About::default() };
    RunRequest {
        run: RunDetails { name: name.into(), about, duration, homing: None },
        bus,
        fast,
        // In real time, an emulated terminal on a busy machine may reply too late. The bring-up is then attempted again.
        wait: !fast,
        ..RunRequest::default()
    }
}

/// Records one run as `ballbard record` does.
pub fn record_run(
    request: &RunRequest,
    daemon: &DaemonConfig,
    bar: &BallBarConfig,
) -> Result<RunSummary, RunError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("runtime");
    let scheduler = Threads::on(Clock::Real);
    let storage = Storage::new(daemon, &*scheduler).expect("storage");
    let setup = Setup { scheduler, storage, daemon: daemon.clone(), bar: bar.clone() };
    runtime.block_on(run::record(&setup, request, &Stop::default()))
}

/// Records into `directory` and reads the finished file back.
pub fn record(directory: &Path, request: &RunRequest, bar: &BallBarConfig) -> (PathBuf, Recording) {
    let summary = record_run(request, &daemon(directory), bar).expect("run");
    let recording = Recording::open(&summary.path).expect("finished recording");
    (summary.path, recording)
}

/// Python interpreter that has the given modules. It is the interpreter in `BALLBAR_PYTHON`; without this variable, it is
/// `python3`. Panics if a module is missing.
pub fn python_with(modules: &[&str]) -> PathBuf {
    let python = std::env::var_os("BALLBAR_PYTHON").map_or_else(|| "python3".into(), PathBuf::from);
    let import = format!("import {}", modules.join(", "));
    let found = std::process::Command::new(&python).args(["-c", &import]).output();
    assert!(
        found.is_ok_and(|output| output.status.success()),
        "{} cannot import {}: pip install -r tests/requirements.txt and set BALLBAR_PYTHON",
        python.display(),
        modules.join(", ")
    );
    python
}
