//! Results of `ballbard check`, and the system calls that its sandbox permits.

use std::path::Path;
use std::process::Command;

use ballbard::control::status::CheckLine;
use serde_json::json;

use super::rig::{Running, changed, shipped, text};

#[test]
fn check_fails_where_no_run_can_begin_and_not_for_less() {
    let service = Running::start();
    // The required free space is larger than any disk.
    let config = changed("disk_floor_mb = 500", "disk_floor_mb = 4000000000");
    let full = Running::in_directory(tempfile::tempdir().unwrap(), config.path(), &[]);
    service.wait_for("waiting");
    // A file that cannot be recovered. It does not affect later runs.
    std::fs::write(service.directory.path().join("torn.mcap.active"), "no recording").unwrap();
    let lines: Vec<CheckLine> = service.get("check");
    assert!(
        lines.iter().any(|line| line.remedy.is_some()) && !lines.iter().any(|line| line.stops),
        "{lines:?}"
    );
    let output = service.command(&["check"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output));
    assert!(text(&output).contains("warning  left-over files:"), "{}", text(&output));
    service.granted("start", &json!({"name": "begun", "duration_s": 0.2}));
    full.wait_for("waiting");
    let output = full.command(&["check"]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("PROBLEM  disk:"), "{}", text(&output));
    // No reason overrides a full disk.
    assert!(!text(&output).contains("--reason"), "{}", text(&output));
    let (status, reply) = full.post("start", &json!({"name": "full"}));
    assert_eq!(status, 409);
    let error = reply["error"].as_str().unwrap();
    assert!(error.contains("disk floor") && !error.contains("reason"), "{reply}");
    assert_eq!(std::fs::read_dir(full.directory.path()).unwrap().count(), 0);
}

#[test]
#[ignore = "needs Python, systemd-analyze and libseccomp"]
fn the_unit_of_the_package_permits_every_system_call_of_the_service() {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let filter = tests.join("tests/unit_filter.py");
    let python = std::env::var_os("BALLBAR_PYTHON").unwrap_or_else(|| "python3".into());
    let filtered = |program: &str| {
        let mut command = Command::new(&python);
        command.arg(&filter).arg(tests.join("debian/ballbard.service")).arg(program);
        command
    };
    // Check that the filter is active: a program that uses a call outside the filter must be killed.
    assert_eq!(filtered("chroot").arg("/").status().unwrap().code(), None);
    let command = filtered(env!("CARGO_BIN_EXE_ballbard"));
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("proxy.sock");
    let more = ["--listen", "127.0.0.1:0", "--behind-proxy", socket.to_str().unwrap(), "--foxglove"];
    let mut service = Running::by(command, directory, &shipped(), &more);
    service.wait_for("waiting");
    let lines: Vec<CheckLine> = service.get("check");
    let clock = lines.iter().find(|line| line.subject == "clock").unwrap();
    assert!(clock.finding.contains("synchronised") && !clock.finding.contains("report"), "{clock:?}");
    service.granted("start", &json!({"name": "run", "note": "x"}));
    service.granted("mark", &json!({"text": "here"}));
    service.wait_until("cycles", |status| status.run.as_ref().is_some_and(|run| run.cycles > 100));
    service.granted("stop", &json!({}));
    service.granted("note", &json!({"name": "run", "note": "y"}));
    let _: serde_json::Value = service.get("runs/run/plot");
    service.granted("delete", &json!({"name": "run"}));
    service.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(service.ended(std::time::Duration::from_secs(10)).success());
}

#[test]
#[ignore = "needs root and util-linux"]
fn under_a_limit_of_locked_memory_nothing_is_locked_so_that_no_allocation_of_a_run_fails() {
    let mut command = Command::new("prlimit");
    command.args(["--memlock=8388608", "setpriv", "--bounding-set=-ipc_lock", "--inh-caps=-ipc_lock"]);
    command.arg(env!("CARGO_BIN_EXE_ballbard"));
    let service = Running::by(command, tempfile::tempdir().unwrap(), &shipped(), &[]);
    service.wait_for("waiting");
    let status = std::fs::read_to_string(format!("/proc/{}/status", service.child.id())).unwrap();
    assert!(
        status.lines().any(|line| line.starts_with("VmLck:") && line.ends_with("\t       0 kB")),
        "{status}"
    );
    let lines: Vec<CheckLine> = service.get("check");
    let line = lines.iter().find(|line| line.subject == "real time").unwrap();
    assert!(line.finding.contains("at most 8 MiB may be locked"), "{line:?}");
}
