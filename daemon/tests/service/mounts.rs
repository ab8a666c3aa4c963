//! File systems that are unmounted, become read-only or become full during a run. Each file system is mounted in the mount
//! namespace of the service.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use ballbard::control::status::{LastRun, Status};
use serde_json::json;
use shared::recording::Recording;

use super::codes::{assert_reported, is_in_file};
use super::rig::{Running, copied};
use crate::support::PROGRAM;

/// Longest time until a problem is reported, on a busy machine. Tests in virtual time check the limit of one second.
const REPORTED_WITHIN: Duration = Duration::from_secs(20);

/// A service that records on a file system of its own. A run is in progress.
struct Mounted {
    service: Running,
    /// Contains the spare directory, the log and, if the file system has one, its image.
    outside: tempfile::TempDir,
}

impl Mounted {
    /// Starts the service and a run. `mount` is a shell command that mounts the file system on `$1`. It may use the file
    /// `$2` as the image of the file system.
    fn begin(mount: &str) -> Self {
        Self::with_ring(mount, 60)
    }

    /// Like [`Self::begin`], with a ring of the length `ring_s` \[s\].
    fn with_ring(mount: &str, ring_s: u32) -> Self {
        let outside = tempfile::tempdir().unwrap();
        let config = copied();
        let file = config.path().join("daemon.toml");
        let daemon = std::fs::read_to_string(&file).unwrap();
        let spare = format!("spare_directory = {:?}", outside.path().join("spare"));
        let daemon = daemon.replace("spare_directory = \"/var/tmp/ballbard\"", &spare);
        let daemon = daemon.replace("ring_s = 60", &format!("ring_s = {ring_s}"));
        std::fs::write(file, daemon.replace("disk_floor_mb = 500", "disk_floor_mb = 1")).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let mut command = Command::new("unshare");
        command.args(["--mount", "--propagation", "private", "sh", "-ec"]);
        command.arg(format!("{mount}; shift 2; exec \"$@\"")).arg("sh");
        command.arg(directory.path()).arg(outside.path().join("image")).arg(PROGRAM);
        command.stderr(File::create(outside.path().join("log")).unwrap());
        let service = Running::by(command, directory, config.path(), &[]);
        service.wait_for("waiting");
        service.granted("start", &json!({"name": "run"}));
        service.wait_for("writing");
        Self { service, outside }
    }

    /// Runs a shell command in the namespace of the service. `$1` is the directory of the service's recordings.
    fn does(&self, script: &str) {
        let mut command = Command::new("nsenter");
        command.arg("--target").arg(self.service.child.id().to_string()).args(["--mount", "sh", "-ec"]);
        let status = command.arg(script).arg("sh").arg(self.service.directory.path()).status().unwrap();
        assert!(status.success(), "{script}; namespaces and mounts need root");
    }

    /// Runs a shell command during a run. Waits until status and log contain one of these words. Returns the status.
    fn reported_after(&self, script: &str, words: &[&str]) -> Status {
        let is_in = |text: &str| words.iter().any(|word| text.contains(word));
        self.does(script);
        let done = Instant::now();
        let status = self.service.wait_until("what happened", |status| {
            status.reason.as_deref().is_some_and(is_in) || status.last.is_some()
        });
        while !is_in(&self.log()) {
            assert!(done.elapsed() < REPORTED_WITHIN, "not in the log: {}", self.log());
            std::thread::sleep(Duration::from_millis(10));
        }
        assert!(done.elapsed() < REPORTED_WITHIN, "reported after {:?}", done.elapsed());
        status
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.outside.path().join("log")).unwrap()
    }

    /// Waits a second and stops the run. Reads the file that the answer names. The file must be in the directory `place`.
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
const EXT4: &str = "truncate -s 16M \"$2\"; mkfs.ext4 -q -F \"$2\"; mount -o loop \"$2\" \"$1\"";

#[test]
#[ignore = "needs root for a mount namespace"]
fn a_file_system_that_is_unmounted_in_mid_run_is_reported_and_no_cycle_is_lost() {
    let mounted = Mounted::begin(TMPFS);
    let told = mounted.reported_after("umount --lazy \"$1\"", &["not there any more"]);
    assert!(told.last.is_none(), "{told:?}");
    // After the unmount, the directory of the underlying file system is visible at the same path.
    mounted.stopped(mounted.service.directory.path());
}

#[test]
#[ignore = "needs root for a mount namespace and a loop device"]
fn a_file_system_that_becomes_read_only_in_mid_run_is_reported_and_the_run_goes_on_in_the_spare_place() {
    let mounted = Mounted::begin(EXT4);
    // The kernel remounts a file system as read-only in the same way when it detects damage.
    let told = mounted.reported_after("mount -o remount,abort \"$1\"", &["the run continues in"]);
    assert!(told.last.is_none(), "{told:?}");
    mounted.stopped(&mounted.spare());
    let next = mounted.service.post("start", &json!({"name": "next"}));
    assert!(next.0 == 409 && next.1["error"].as_str().unwrap().contains("ead-only"), "{next:?}");
}

#[test]
#[ignore = "needs root for a mount namespace and a loop device"]
fn a_file_system_that_takes_nothing_for_a_while_is_reported_in_status_and_log_and_no_cycle_is_lost() {
    let mounted = Mounted::begin(EXT4);
    mounted.does("fsfreeze --freeze \"$1\"");
    let frozen = Instant::now();
    let word = "wait to be written";
    let is_reported = || {
        let reason = mounted.service.get::<Status>("status").reason.unwrap_or_default();
        reason.contains(word) && mounted.log().contains(word)
    };
    // The warning must come after more than two synchronisation periods.
    while !is_reported() && frozen.elapsed() < REPORTED_WITHIN {
        std::thread::sleep(Duration::from_millis(20));
    }
    let reported = frozen.elapsed();
    mounted.does("fsfreeze --unfreeze \"$1\"");
    assert!(reported < REPORTED_WITHIN, "{}", mounted.log());
    mounted.service.wait_until("the end of it", |status| status.reason.is_none());
    mounted.stopped(mounted.service.directory.path());
}

#[test]
#[ignore = "needs root for a mount namespace"]
fn a_run_on_a_file_system_that_becomes_full_at_once_is_whole_where_there_is_room() {
    let mounted = Mounted::begin(TMPFS);
    // Fill the disk until not even the end of the file fits. The run then ends at the limit of free space. If the disk
    // refuses a write of the recorder before that, the run continues in the spare directory.
    let fill = "dd if=/dev/zero of=\"$1\"/others bs=65536 2>/dev/null || true";
    mounted.reported_after(fill, &["disk floor", "No space left"]);
    mounted.service.granted("stop", &json!({}));
    let last = mounted.service.wait_until("its end", |status| status.last.is_some()).last.unwrap();
    assert!(
        last.error.is_none() && (last.cause.contains("disk floor") || last.cause == "stopped"),
        "{last:?}"
    );
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
    let told = mounted.reported_after("mount -t tmpfs -o ro tmpfs \"$1\"", &["not there any more"]);
    let (status, answer) = mounted.service.post("stop", &json!({}));
    let last = mounted.service.get::<Status>("status").last.or(told.last).unwrap();
    assert!(last.file.is_none() && last.error.is_some(), "{last:?}");
    // The request may come while the directory is missing (500), or after the run has ended (idle).
    assert!(status == 500 || answer["answer"] == "idle", "{status} {answer}");
}

/// Makes a change to the file system during a run, and reverses it. All outputs must report the problem with this code.
fn check_code(mount: &str, ring_s: u32, [begin, end]: [&str; 2], code: &str) {
    let mounted = Mounted::with_ring(mount, ring_s);
    mounted.does(begin);
    assert_reported(&mounted.service, &mounted.outside.path().join("log"), code);
    mounted.does(end);
    let stopped = mounted.service.granted("stop", &json!({}));
    let last = stopped.last.or(mounted.service.get::<Status>("status").last).unwrap();
    let seen = format!("/proc/{}/root{}", mounted.service.child.id(), last.file.unwrap());
    let recording = Recording::open(Path::new(&seen)).unwrap();
    assert!(is_in_file(&recording, code), "{code} is not in the file: {:?}", recording.events);
    println!("| {begin:<50} | {code:<13} | status, page, metrics, log, file |");
}

#[test]
#[ignore = "needs root for a mount namespace and a loop device"]
fn each_fault_of_the_disk_has_the_same_code_wherever_it_is_reported() {
    let freeze = ["fsfreeze --freeze \"$1\"", "fsfreeze --unfreeze \"$1\""];
    let fill = "dd if=/dev/zero of=\"$1\"/others bs=65536 count=50 2>/dev/null";
    check_code(EXT4, 60, ["mount -o remount,abort \"$1\"", "true"], "file_moved");
    check_code(TMPFS, 60, [fill, "true"], "disk_full");
    check_code(EXT4, 60, freeze, "disk_backlog");
    check_code(EXT4, 1, freeze, "cycles_lost");
}
