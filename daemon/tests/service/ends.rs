//! How runs end, and which files remain.

use std::process::Command;
use std::time::Duration;

use ballbard::control::recordings::runs::RunLine;
use ballbard::control::status::Status;
use nix::sys::signal::Signal;
use serde_json::json;

use super::rig::{Running, changed, shipped, text};
use crate::support::ballbard;
use crate::support::runs::in_parallel;

#[test]
fn a_signal_ends_service_and_run_with_a_finished_file_that_the_list_calls_too_short() {
    // SIGHUP is sent when the terminal of a program is closed.
    let signals = [Signal::SIGTERM, Signal::SIGHUP];
    in_parallel(&signals, signals.len(), |signal| {
        let mut service = Running::start();
        service.wait_for("waiting");
        service.granted("start", &json!({"name": "signal"}));
        service.wait_for("writing");
        service.signal(*signal);
        assert!(service.ended(Duration::from_secs(20)).success());
        let cause = service.recording("signal").end.cause;
        assert!(cause.starts_with(&format!("stopped by {}", signal.as_str())), "{cause}");
        let listed = text(&ballbard().arg("runs").arg(service.directory.path()).output().unwrap());
        // If most cycles were late, the grade is BAD.
        assert!(
            listed.contains(&cause) && ["CHECK", "BAD"].iter().any(|grade| listed.contains(grade)),
            "{listed}"
        );
        assert!(listed.contains("record at least 11 s: `identify` needs 10 s of motion"), "{listed}");
    });
}

#[test]
fn a_run_that_a_kill_left_behind_is_there_finished_when_the_service_starts_again() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "killed"}));
    service.wait_for("writing");
    let written = service.get::<Status>("status").run.unwrap().cycles;
    service.signal(Signal::SIGKILL);
    service.child.wait().unwrap();
    let directory = std::mem::replace(&mut service.directory, tempfile::tempdir().unwrap());
    let again = Running::in_directory(directory, &shipped(), &[]);
    again.wait_for("waiting");
    let lines: Vec<RunLine> = again.get("runs");
    assert!(matches!(&lines[..], [line] if line.recovered && line.cycles >= written), "{lines:?}");
    assert!(again.recording("killed").end.cause.contains("recovered"));
}

/// A file system of 8 MB that is mounted on a directory. It is unmounted when the test ends.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn mount() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=8m", "tmpfs"])
            .arg(directory.path())
            .status();
        assert!(mounted.is_ok_and(|status| status.success()), "root mounts a small disk");
        Self(directory)
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
    }
}

#[test]
#[ignore = "needs root to mount a small disk"]
fn a_disk_that_others_fill_ends_the_run_with_a_finished_file() {
    let disk = SmallDisk::mount();
    let config = changed("disk_floor_mb = 500", "disk_floor_mb = 2");
    let service = Running::in_directory(tempfile::tempdir_in(disk.0.path()).unwrap(), config.path(), &[]);
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "filled"}));
    let cycles = service.wait_for("writing").run.unwrap().cycles;
    std::fs::write(disk.0.path().join("others"), vec![1; 6_800_000]).unwrap();
    let last = service.wait_for("waiting").last.unwrap();
    assert!(last.cause.contains("disk floor") && last.cycles >= cycles, "{last:?}");
    let recording = service.recording("filled");
    assert_eq!(recording.end.cause, last.cause);
    assert_eq!(service.post("start", &json!({"name": "next"})).0, 409);
}

#[test]
fn status_and_check_say_what_the_last_attempt_to_bring_the_bus_up_met() {
    let service = Running::with_arguments(&["--fault", "gone:4"]);
    let status = service.wait_until("the first attempt", |status| {
        status.reason.as_ref().is_some_and(|reason| reason.contains("terminal 4 and all"))
    });
    let reason = status.reason.unwrap();
    for part in ["expected [EK1100", "found [EK1100", "check the power of terminal 4 (bus position 4)"] {
        assert!(reason.contains(part), "`{part}` is missing in: {reason}");
    }
    let checked = text(&service.command(&["check"]));
    assert!(checked.contains("PROBLEM  bus: terminal 4 and all"), "{checked}");
    let said = text(&service.command(&["status"]));
    assert!(said.contains(&format!("NOT READY: {reason}")), "{said}");
}
