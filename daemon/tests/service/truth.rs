//! The reports of the service are true while the bus, the encoders or another process fail.

use std::fs::File;
use std::process::{Command, Stdio};
use std::time::Duration;

use ballbard::control::recordings::runs::RunLine;
use ballbard::control::status::{Level, ServiceState, Status};
use nix::sys::signal::Signal;
use serde_json::json;

use super::rig::{Running, heeding_hangups, shipped, text};
use crate::support::{PROGRAM, ballbard};

#[test]
fn terminals_that_were_gone_are_in_the_log() {
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("log");
    let stderr: Stdio = File::create(&log).unwrap().into();
    let logged = || std::fs::read_to_string(&log).unwrap();
    let faults = ["--fault", "gone:3@4s-6s"];
    let service = Running::logging_to(stderr, &faults);
    service.wait_for("waiting");
    service.wait_for("fault");
    // While the process is stopped, it misses cycles. Missed cycles must not be treated as a sign
    // that the terminals have returned.
    for _ in 0..3 {
        service.signal(Signal::SIGSTOP);
        std::thread::sleep(Duration::from_millis(100));
        service.signal(Signal::SIGCONT);
        std::thread::sleep(Duration::from_millis(200));
    }
    service.wait_for("waiting");
    // A thread of its own writes the log.
    service.wait_until("the end of the fault in the log", |_| logged().contains("samples again after"));
    // After the end of the fault, the log still contains the fault.
    let log = logged();
    let [before, _] = log.split("INFO bus: samples again after").collect::<Vec<_>>()[..] else {
        panic!("{log}")
    };
    let (_, during) = before.split_once("WARN bus: no samples from").unwrap();
    assert!(!during.contains("encoder of joint"), "{log}");
}

#[test]
fn an_encoder_without_signal_is_in_the_headline() {
    let service = Running::with_arguments(&["--fault", "no-signal:2"]);
    let named = |status: &Status| {
        status.reason.as_ref().is_some_and(|reason| reason.contains("no valid sample from joint 2 "))
    };
    let waiting = service.wait_until("the headline", named);
    assert_eq!(waiting.state, ServiceState::Waiting);
    let typed = text(&service.command(&["status"]));
    // On a busy machine, cycles may be late, and the headline then names other joints, too.
    let headline = typed.lines().next().unwrap();
    assert!(headline.starts_with("CHECK: no valid sample from joint"), "{typed}");
    assert!(headline.contains("no valid sample from joint 2 ("), "{typed}");
}

#[test]
fn a_run_without_a_valid_cycle_is_no_success() {
    let faults: Vec<String> = (1..=5).map(|position| format!("no-signal:{position}")).collect();
    let faults: Vec<&str> = faults.iter().flat_map(|fault| ["--fault", fault]).collect();
    let out = tempfile::tempdir().unwrap();
    let mut command = ballbard();
    command.args([
        "record",
        "--bus",
        "simulated",
        "--name",
        "blind",
        "--duration",
        "2s",
        "--fast",
        "--config",
    ]);
    let output = command.arg(shipped()).arg("--out").arg(out.path()).args(&faults).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(
        text(&output).contains("none of the 200 cycles is valid: all joints signal too low"),
        "{}",
        text(&output)
    );
    assert!(out.path().join("blind.mcap").exists());
    let service = Running::with_arguments(&faults);
    service.wait_for("waiting");
    let refused = service.command(&["start", "--name", "blind"]);
    assert!(!refused.status.success() && text(&refused).contains("--reason"), "{}", text(&refused));
    assert!(service.command(&["start", "--name", "blind", "--reason", "a test"]).status.success());
    service.wait_for("writing");
    let output = service.command(&["stop"]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("blind.mcap") && text(&output).contains("is valid"), "{}", text(&output));
    assert!(text(&output).contains("BAD: none of the"), "{}", text(&output));
    let lines: Vec<RunLine> = service.get("runs");
    assert_eq!(lines[0].verdict.as_ref().unwrap().level, Level::Bad);
}

/// Records a run of two seconds and closes its terminal after half a second. Returns the cause of its end.
fn cause_after_hangup(mut command: Command) -> String {
    let out = tempfile::tempdir().unwrap();
    command.args(["record", "--bus", "simulated", "--name", "hangup", "--duration", "2s"]);
    command.arg("--config").arg(shipped()).arg("--out").arg(out.path());
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    while !out.path().join("hangup.mcap.active").exists() {
        assert!(child.try_wait().unwrap().is_none());
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(500));
    let pid = nix::unistd::Pid::from_raw(i32::try_from(child.id()).unwrap());
    nix::sys::signal::kill(pid, Signal::SIGHUP).unwrap();
    // The command fails if most cycles were late, but no signal kills it.
    assert!(matches!(child.wait().unwrap().code(), Some(0 | 1)));
    shared::recording::Recording::open(&out.path().join("hangup.mcap")).unwrap().end.cause
}

#[test]
fn a_terminal_that_is_closed_ends_a_recording_command_with_a_finished_file_unless_nohup_says_otherwise() {
    let mut outliving = Command::new("nohup");
    outliving.arg(PROGRAM);
    std::thread::scope(|scope| {
        let outlived = scope.spawn(|| cause_after_hangup(outliving));
        assert!(cause_after_hangup(heeding_hangups(PROGRAM)).contains("SIGHUP"));
        assert_eq!(outlived.join().unwrap(), "duration reached");
    });
}

#[test]
fn a_second_process_in_a_directory_is_refused_with_who_has_it() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "first"}));
    let mut command = ballbard();
    command.args(["record", "--bus", "simulated", "--name", "second", "--duration", "1s", "--fast"]);
    command.arg("--config").arg(shipped());
    command.arg("--out").arg(service.directory.path());
    let refused = command.output().unwrap();
    assert_eq!(refused.status.code(), Some(1), "{}", text(&refused));
    let pid = format!("process {} (`ballbard run`, recording run `first`)", service.child.id());
    assert!(text(&refused).contains(&pid), "{}", text(&refused));
    let mut other = ballbard();
    other
        .args(["run", "--bus", "simulated", "--port", "0", "--config"])
        .arg(shipped())
        .arg("--out")
        .arg(service.directory.path());
    let refused = other.output().unwrap();
    assert_eq!(refused.status.code(), Some(1), "{}", text(&refused));
    assert!(text(&refused).contains(&pid), "{}", text(&refused));
    // The kernel releases the claim of a process when the process ends for any cause.
    service.signal(Signal::SIGKILL);
    service.child.wait().unwrap();
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert!(service.recording("first").end.recovered);
}
