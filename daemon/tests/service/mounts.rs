//! File systems that are unmounted, become read-only or full beneath a run, each in a mount namespace of the service's own.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use ballbard::control::status::{LastRun, Status};
use serde_json::json;
use shared::recording::Recording;

use super::rig::{Running, copied};

/// A second, and what a busy machine adds.
const TOLD_WITHIN: Duration = Duration::from_secs(2);

/// A service whose recordings go to a file system of their own.
struct Mounted {
    service: Running,
    /// Has the spare place, and the image of that file system where it has one.
    outside: tempfile::TempDir,
}

impl Mounted {
    /// `mount` mounts it at `$1`; `$2` is a file that it may use.
    fn begin(mount: &str) -> Self {
        let outside = tempfile::tempdir().unwrap();
        let config = copied();
        let file = config.path().join("daemon.toml");
        let daemon = std::fs::read_to_string(&file).unwrap();
        let spare = format!("spare_directory = {:?}", outside.path().join("spare"));
        let daemon = daemon.replace("spare_directory = \"/var/tmp/ballbard\"", &spare);
        std::fs::write(file, daemon.replace("disk_floor_mb = 500", "disk_floor_mb = 0")).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let mut command = Command::new("unshare");
        command.args(["--mount", "--propagation", "private", "sh", "-ec"]);
        command.arg(format!("{mount}; shift 2; exec \"$@\"")).arg("sh");
        command.arg(directory.path()).arg(outside.path().join("image")).arg(env!("CARGO_BIN_EXE_ballbard"));
        command.stderr(Stdio::null());
        let service = Running::by(command, directory, config.path(), &[]);
        service.wait_for("waiting");
        service.granted("start", &json!({"name": "run"}));
        service.wait_for("writing");
        Self { service, outside }
    }

    /// In the service's namespace, with its directory as `$1`.
    fn does(&self, script: &str) {
        let mut command = Command::new("nsenter");
        command.arg("--target").arg(self.service.child.id().to_string()).args(["--mount", "sh", "-ec"]);
        let status = command.arg(script).arg("sh").arg(self.service.directory.path()).status().unwrap();
        assert!(status.success(), "{script}; namespaces and mounts need root");
    }

    /// Does it in mid-run, and waits until that is told.
    fn told_after(&self, script: &str, word: &str) -> Status {
        self.does(script);
        let done = Instant::now();
        let told = self.service.wait_until("what happened", |status| {
            status.reason.as_ref().is_some_and(|reason| reason.contains(word)) || status.last.is_some()
        });
        assert!(done.elapsed() < TOLD_WITHIN, "told after {:?}", done.elapsed());
        told
    }

    /// Goes on for a second, stops, and looks at the file of which `stop` says that it is there.
    fn stopped(&self, place: &Path) -> LastRun {
        let before = self.service.wait_for("writing").run.unwrap().cycles;
        std::thread::sleep(Duration::from_secs(1));
        let last = self.service.granted("stop", &json!({})).last.unwrap();
        let file = PathBuf::from(last.file.as_ref().unwrap());
        assert_eq!(file, place.join("run.mcap"));
        let seen = format!("/proc/{}/root{}", self.service.child.id(), file.display());
        let recording = Recording::open(Path::new(&seen)).unwrap();
        assert!(last.cycles > before + 50, "{last:?}");
        assert_eq!((recording.cycles.len() as u64, last.cycles_lost), (last.cycles, 0));
        last
    }

    fn spare(&self) -> PathBuf {
        self.outside.path().join("spare")
    }
}

const TMPFS: &str = "mount -t tmpfs -o size=4m tmpfs \"$1\"";

#[test]
#[ignore = "needs root for a mount namespace"]
fn a_file_system_that_is_unmounted_in_mid_run_is_told_and_no_cycle_is_lost() {
    let mounted = Mounted::begin(TMPFS);
    let told = mounted.told_after("umount --lazy \"$1\"", "not there any more");
    assert!(told.last.is_none(), "{told:?}");
    // Its directory is there, on the file system beneath.
    mounted.stopped(mounted.service.directory.path());
}

#[test]
#[ignore = "needs root for a mount namespace and a loop device"]
fn a_file_system_that_becomes_read_only_in_mid_run_is_told_and_the_run_goes_on_in_the_spare_place() {
    let mounted =
        Mounted::begin("truncate -s 16M \"$2\"; mkfs.ext4 -q -F \"$2\"; mount -o loop \"$2\" \"$1\"");
    // As the kernel does where it finds the file system damaged.
    let told = mounted.told_after("mount -o remount,abort \"$1\"", "the run goes on in");
    assert!(told.last.is_none(), "{told:?}");
    mounted.stopped(&mounted.spare());
    let next = mounted.service.post("start", &json!({"name": "next"}));
    assert!(next.0 == 409 && next.1["error"].as_str().unwrap().contains("ead-only"), "{next:?}");
}

#[test]
#[ignore = "needs root for a mount namespace"]
fn a_file_system_that_becomes_full_at_once_ends_the_run_with_all_of_it_where_there_is_room() {
    let mounted = Mounted::begin(TMPFS);
    // Until nothing is left, not even for the end of the file.
    mounted.told_after("dd if=/dev/zero of=\"$1\"/others bs=4096 2>/dev/null || true", "disk floor");
    let last = mounted.service.wait_until("its end", |status| status.last.is_some()).last.unwrap();
    assert!(last.cause.contains("disk floor") && last.error.is_none(), "{last:?}");
    let file = PathBuf::from(last.file.unwrap());
    assert!(file == mounted.spare().join("run.mcap") || file.starts_with(mounted.service.directory.path()));
    let seen = format!("/proc/{}/root{}", mounted.service.child.id(), file.display());
    let recording = Recording::open(Path::new(&seen)).unwrap();
    assert_eq!((recording.cycles.len() as u64, last.cycles_lost), (last.cycles, 0));
    let (status, refused) = mounted.service.post("start", &json!({"name": "next"}));
    assert!(status == 409 && refused["error"].as_str().unwrap().contains("disk floor"), "{refused}");
}

#[test]
#[ignore = "needs root for a mount namespace"]
fn a_run_whose_file_system_is_hidden_and_that_has_no_spare_place_is_no_success_for_who_stops_it() {
    let mounted = Mounted::begin(TMPFS);
    std::fs::write(mounted.spare(), "in the way").unwrap();
    let told = mounted.told_after("mount -t tmpfs -o ro tmpfs \"$1\"", "not there any more");
    let (status, answer) = mounted.service.post("stop", &json!({}));
    let last = mounted.service.get::<Status>("status").last.or(told.last).unwrap();
    assert!(last.file.is_none() && last.error.is_some(), "{last:?}");
    // Stopped while it was lost, or when it had ended by itself.
    assert!(status == 500 || answer["answer"] == "idle", "{status} {answer}");
}
