//! A service or a command whose standard error or standard output is full, is closed, or is not read.

use std::fs::{File, OpenOptions};
use std::io::{PipeReader, Write, pipe};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Output, Stdio};
use std::time::Duration;

use ballbard::control::status::CheckLine;
use nix::fcntl::{FcntlArg, fcntl};
use nix::sys::signal::Signal;
use serde_json::json;

use super::rig::{Running, shipped, text};
use crate::support::ballbard;
use crate::support::runs::in_parallel;

/// A standard error for the service. If it is a pipe, its reading end is kept as well, so that the pipe stays open.
type Log = (Stdio, Option<PipeReader>);

/// Name of a log, and a function that creates it.
type Case = (&'static str, fn() -> Log);

const BROKEN_LOGS: [Case; 5] = [
    ("closed", || (File::open("/dev/null").unwrap().into(), None)),
    ("full", || (full(), None)),
    ("its reader gone", || (gone(), None)),
    ("without a journal", without_journal),
    ("without a reader", blocked),
];

fn full() -> Stdio {
    OpenOptions::new().write(true).open("/dev/full").unwrap().into()
}

/// A pipe whose reading end is closed.
fn gone() -> Stdio {
    pipe().unwrap().1.into()
}

/// A full pipe. Its reading end is open, but nothing reads from it.
fn blocked() -> Log {
    let (reader, mut writer) = pipe().unwrap();
    let bytes = fcntl(&writer, FcntlArg::F_SETPIPE_SZ(4096)).unwrap();
    writer.write_all(&vec![b'.'; usize::try_from(bytes).unwrap()]).unwrap();
    (writer.into(), Some(reader))
}

/// A standard error that was connected to the journal of a service manager. The service manager has died.
fn without_journal() -> Log {
    (OwnedFd::from(UnixStream::pair().unwrap().1).into(), None)
}

#[test]
fn a_log_that_cannot_be_written_costs_lines_and_nothing_else() {
    in_parallel(&BROKEN_LOGS, BROKEN_LOGS.len(), |(name, log)| {
        let (stderr, _reader) = log();
        let mut service = Running::logging_to(stderr, &[]);
        service.wait_for("waiting");
        service.granted("start", &json!({"name": "logged"}));
        service.wait_for("writing");
        let last = service.granted("stop", &json!({})).last.unwrap();
        assert_eq!(service.recording("logged").cycles.len() as u64, last.cycles, "{name}");
        let lines: Vec<CheckLine> = service.get("check");
        let log = lines.iter().find(|line| line.subject == "log").unwrap();
        // If the pipe is not read, lines wait in the queue. Lines are lost only when the queue is full.
        assert_eq!(log.remedy.is_some(), *name != "without a reader", "{name}: {log:?}");
        service.signal(Signal::SIGTERM);
        assert!(service.ended(Duration::from_secs(20)).success(), "{name}");
    });
}

#[test]
fn a_run_is_recorded_whatever_becomes_of_the_log() {
    in_parallel(&BROKEN_LOGS, BROKEN_LOGS.len(), |(name, log)| {
        let (stderr, _reader) = log();
        let out = tempfile::tempdir().unwrap();
        let mut command = ballbard();
        command.args([
            "record",
            "--bus",
            "simulated",
            "--name",
            "logged",
            "--duration",
            "1s",
            "--fast",
            "--config",
        ]);
        command.arg(shipped()).arg("--out").arg(out.path()).stderr(stderr).stdout(Stdio::null());
        assert!(command.status().unwrap().success(), "{name}");
        assert!(out.path().join("logged.mcap").exists(), "{name}");
        // The last message of a failing command cannot be written. The command must still end in time.
        command.arg("--replay").arg("nothing.mcap");
        assert_eq!(command.status().unwrap().code(), Some(1), "{name}");
    });
}

#[test]
fn a_service_whose_standard_output_fails_serves() {
    let outputs = [("full", full as fn() -> Stdio), ("its reader gone", gone)];
    in_parallel(&outputs, outputs.len(), |(name, stdout)| {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let directory = tempfile::tempdir().unwrap();
        let mut command = ballbard();
        command.args(["run", "--bus", "simulated", "--port", &port.to_string(), "--config"]).arg(shipped());
        let command = command.arg("--out").arg(directory.path()).stdout(stdout()).stderr(Stdio::null());
        let mut service = Running { child: command.spawn().unwrap(), port: port.to_string(), directory };
        while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(service.child.try_wait().unwrap().is_none(), "{name}: the service has ended");
            std::thread::sleep(Duration::from_millis(20));
        }
        service.wait_for("waiting");
        service.signal(Signal::SIGTERM);
        assert!(service.ended(Duration::from_secs(20)).success(), "{name}");
    });
}

/// Runs a command that prints, while the service records. `stdout` is the standard output of the command.
fn typed(service: &Running, arguments: &[&str], stdout: Stdio) -> Output {
    let mut command = ballbard();
    if arguments[0] == "stop" {
        // If a run is stopped before its first cycle, it has no data, and `stop` fails. The test
        // therefore waits for a cycle.
        service.wait_until("a cycle", |status| status.run.as_ref().is_some_and(|run| run.cycles > 0));
    }
    command.env("RUST_LOG", "off").args(arguments).stdout(stdout).stderr(Stdio::piped());
    if !["runs", "record", "export", "recover", "tune", "generate"].contains(&arguments[0]) {
        command.args(["--port", &service.port]);
    }
    command.spawn().unwrap().wait_with_output().unwrap()
}

#[test]
fn commands_whose_reader_has_gone_end_quietly_and_a_full_disk_is_an_error() {
    let service = Running::start();
    service.wait_for("waiting");
    let directory = service.directory.path().to_str().unwrap().to_owned();
    let out = tempfile::tempdir().unwrap();
    let (config, out) = (shipped(), out.path().to_str().unwrap().to_owned());
    let config = config.to_str().unwrap();
    let recording = format!("{out}/piped.mcap");
    let record = ["record", "--bus", "simulated", "--duration", "1s", "--fast", "--config", config];
    let record = [&record[..], &["--out", &out, "--name"]].concat();
    let of = |name| [&record[..], &[name]].concat();
    let commands = |run| -> [Vec<&str>; 10] {
        [
            vec!["start", "--name", run, "--reason", "cycles may be late"],
            vec!["mark", "here"],
            vec!["status"],
            vec!["runs", &directory],
            vec!["stop"],
            of("piped"),
            vec!["export", "--csv", "--out", "-", &recording],
            vec!["export", "--csv", "--force", &recording],
            vec!["recover", &recording],
            vec!["generate", "completions", "bash"],
        ]
    };
    for arguments in &commands("one") {
        let output = typed(&service, arguments, gone());
        assert!(output.status.success() && output.stderr.is_empty(), "{arguments:?}: {}", text(&output));
    }
    // The exit code must be the same whether or not the details can be printed.
    for arguments in [&["check"][..], &["tune", "--config", config]] {
        let verdicts = [gone(), Stdio::null()].map(|stdout| typed(&service, arguments, stdout));
        assert_eq!(verdicts[0].status, verdicts[1].status, "{}", text(&verdicts[0]));
        assert_eq!(verdicts[0].stderr, verdicts[1].stderr);
    }
    for arguments in commands("two").iter().filter(|arguments| arguments[0] != "record") {
        let output = typed(&service, arguments, full());
        assert_eq!(output.status.code(), Some(1), "{arguments:?}");
        assert!(text(&output).contains("cannot write to standard output: No space"), "{}", text(&output));
    }
    let output = typed(&service, &of("full"), full());
    assert_eq!(output.status.code(), Some(1));
    assert!(std::path::Path::new(&out).join("full.mcap").exists());
}
