//! Ends of runs, and the files that they leave.

use std::process::Command;
use std::time::{Duration, Instant};

use ballbard::control::recordings::runs::RunLine;
use ballbard::control::status::{CheckLine, Status};
use serde_json::json;

use super::rig::{Running, changed, shipped, text};

#[test]
fn a_signal_ends_service_and_run_with_a_finished_file() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "signal"}));
    service.wait_for("writing");
    let asked = Instant::now();
    service.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(service.child.wait().unwrap().success());
    assert!(asked.elapsed() < Duration::from_secs(20));
    let recording = service.recording("signal");
    assert!(recording.end.cause.contains("SIGTERM"), "{}", recording.end.cause);
}

#[test]
fn a_run_ends_by_itself_after_its_duration() {
    let service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "short", "duration_s": 0.5}));
    let last = loop {
        if let Some(last) = service.get::<Status>("status").last {
            break last;
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    assert_eq!((last.cycles, last.cause.as_str()), (50, "duration reached"));
    assert_eq!(service.recording("short").cycles.len(), 50);
    service.wait_for("waiting");
}

#[test]
fn a_run_that_a_kill_left_behind_is_there_finished_when_the_service_starts_again() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "killed"}));
    service.wait_for("writing");
    let written = service.get::<Status>("status").run.unwrap().cycles;
    service.signal(nix::sys::signal::Signal::SIGKILL);
    service.child.wait().unwrap();
    let directory = std::mem::replace(&mut service.directory, tempfile::tempdir().unwrap());
    let again = Running::in_directory(directory, &shipped());
    again.wait_for("waiting");
    let lines: Vec<RunLine> = again.get("runs");
    assert!(matches!(&lines[..], [line] if line.recovered && line.cycles >= written), "{lines:?}");
    assert!(again.recording("killed").end.cause.contains("recovered"));
}

#[test]
fn at_the_disk_floor_no_run_begins() {
    let directory = tempfile::tempdir().unwrap();
    // Larger than any disk.
    let config = changed("disk_floor_mb = 500", "disk_floor_mb = 4000000000");
    let service = Running::in_directory(directory, config.path());
    service.wait_for("waiting");
    let (status, reply) = service.post("start", &json!({"name": "full"}));
    assert_eq!(status, 409);
    assert!(reply["error"].as_str().unwrap().contains("disk floor"), "{reply}");
    let lines: Vec<CheckLine> = service.get("check");
    assert!(lines.iter().any(|line| line.subject == "disk" && line.remedy.is_some()), "{lines:?}");
    assert_eq!(std::fs::read_dir(service.directory.path()).unwrap().count(), 0);
}

/// A file system of 8 MB, which is unmounted when the test ends.
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
    let service = Running::in_directory(tempfile::tempdir_in(disk.0.path()).unwrap(), config.path());
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
    // Incomplete from the start; then complete for some time, with a terminal that refuses its settings.
    let incomplete = Running::with(tempfile::tempdir().unwrap(), &shipped(), &["--fault", "gone:4"]);
    let faults = ["--fault", "gone:3@3s-4s", "--fault", "abort:1,0x06090011@3s-8s"];
    let refusing = Running::with(tempfile::tempdir().unwrap(), &shipped(), &faults);
    refusing.wait_for("waiting");
    let reason = incomplete.wait_until("the first attempt", |status| {
        status.reason.as_ref().is_some_and(|reason| reason.contains("terminal 4 and all"))
    });
    for told in ["expected [EK1100", "found [EK1100", "check terminal 4 (bus position 4)"] {
        assert!(reason.reason.as_ref().unwrap().contains(told), "`{told}` is missing in: {reason:?}");
    }
    let checked = text(&incomplete.command(&["check"]));
    assert!(checked.contains("PROBLEM  bus: terminal 4 and all"), "{checked}");
    let told = |status: &Status| {
        let reason = status.reason.as_deref().unwrap_or_default();
        reason.contains("terminal 1, while setting the interpolation")
            && status.problems[0].code() == "bus_setting_refused"
    };
    refusing.wait_until("the refused setting", told);
    assert!(
        text(&refusing.command(&["status"])).contains("NOT READY: no samples from any encoder: terminal 1,")
    );
    refusing.wait_for("waiting");
}
