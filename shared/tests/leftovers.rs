//! Files that crashed runs left in a directory are found, completed and labelled. Files in use are not touched.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::fs::{File, Permissions};
use std::io;
use std::os::unix::fs::{FileExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use nix::fcntl::{FcntlArg, Flock, FlockArg, fcntl};
use shared::recording::{
    Disk, Recording, RecordingWriter, RecoverError, Recovery, RunFile, RunOverview, SystemDisk, is_in_use,
    recover_file, recover_file_on, recover_leftovers, recover_leftovers_on,
};

use crate::support::run::{START, cycle, run};

/// Starts a run in a directory and writes 40 cycles. The run is not finished.
fn running(directory: &Path, name: &str) -> RecordingWriter<RunFile> {
    let mut writer = RecordingWriter::create(directory, &run(name)).unwrap();
    for number in 0..40 {
        writer.write_cycle(&cycle(number)).unwrap();
        if number % 20 == 19 {
            writer.sync().unwrap();
        }
    }
    writer
}

/// The file of such a run after its process was killed: it has the same content, but no lock.
fn left_behind(directory: &Path, name: &str) -> PathBuf {
    let elsewhere = tempfile::tempdir().unwrap();
    let writer = running(elsewhere.path(), name);
    let left = directory.join(format!("{name}.mcap.active"));
    std::fs::copy(elsewhere.path().join(format!("{name}.mcap.active")), &left).unwrap();
    drop(writer);
    left
}

fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).unwrap().flatten();
    let mut names: Vec<_> = entries.map(|entry| entry.file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Locks a file as another process does while it checks whether the file is in use.
fn checking(path: &Path) -> Flock<File> {
    Flock::lock(File::open(path).unwrap(), FlockArg::LockSharedNonblock).unwrap()
}

#[test]
fn two_checks_at_once_do_not_take_each_other_for_the_writer() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "crashed");
    let _other = checking(&left);
    assert!(!is_in_use(&SystemDisk, &left).unwrap());
    let writer = running(directory.path(), "running");
    assert!(is_in_use(&SystemDisk, writer.sink().place().path()).unwrap());
}

/// A disk with a file that another process is checking. That process releases its lock on the first
/// attempt to lock the file.
#[derive(Debug)]
struct Checked(Mutex<Option<Flock<File>>>);

impl Disk for Checked {
    fn lock(&self, file: File) -> io::Result<Flock<File>> {
        let locked = SystemDisk.lock(file);
        self.0.lock().unwrap().take();
        locked
    }
}

#[test]
fn a_run_left_behind_is_recovered_while_another_process_checks_it() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "crashed");
    let disk = Checked(Mutex::new(Some(checking(&left))));
    let leftovers = recover_leftovers_on(&disk, directory.path());
    assert!(matches!(leftovers[..], [ref one] if one.outcome.is_ok()), "{leftovers:?}");
}

/// A disk that locks a file only if it is open for writing, like NFS.
#[derive(Debug)]
struct Nfs;

impl Disk for Nfs {
    fn lock(&self, file: File) -> io::Result<Flock<File>> {
        let mode = fcntl(&file, FcntlArg::F_GETFL)? & nix::libc::O_ACCMODE;
        if mode == nix::libc::O_RDONLY {
            return Err(io::Error::from_raw_os_error(nix::libc::EBADF));
        }
        SystemDisk.lock(file)
    }
}

#[test]
fn a_run_left_behind_on_nfs_is_recovered() {
    let directory = tempfile::tempdir().unwrap();
    left_behind(directory.path(), "crashed");
    let leftovers = recover_leftovers_on(&Nfs, directory.path());
    assert!(matches!(leftovers[..], [ref one] if one.outcome.is_ok()), "{leftovers:?}");
}

#[test]
fn a_run_left_behind_that_this_user_may_only_read_is_recovered() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "crashed");
    std::fs::set_permissions(left, Permissions::from_mode(0o400)).unwrap();
    let leftovers = recover_leftovers(directory.path());
    assert!(matches!(leftovers[..], [ref one] if one.outcome.is_ok()), "{leftovers:?}");
}

#[test]
fn a_run_left_behind_is_finished_and_labelled() {
    let directory = tempfile::tempdir().unwrap();
    left_behind(directory.path(), "crashed");
    let leftovers = recover_leftovers(directory.path());
    assert!(matches!(leftovers[..], [ref one] if one.outcome.is_ok()), "{leftovers:?}");
    assert_eq!(names(directory.path()), ["crashed.mcap"]);
    let path = directory.path().join("crashed.mcap");
    let recording = Recording::open(&path).unwrap();
    assert_eq!(recording.cycles.len(), 40);
    let last = recording.cycles.last().unwrap().sample_time;
    assert!(recording.end.recovered && recording.end.ended == last);
    for part in ["recovered", "40 cycles", &last.to_string()] {
        assert!(recording.end.cause.contains(part), "{}", recording.end.cause);
    }
    let overview = RunOverview::open(&path).unwrap();
    assert_eq!((overview.run, overview.end), (recording.run, recording.end));
    assert!(recover_leftovers(directory.path()).is_empty());
}

#[test]
fn a_file_that_is_being_written_is_left_alone() {
    let directory = tempfile::tempdir().unwrap();
    let writer = running(directory.path(), "alive");
    assert!(recover_leftovers(directory.path()).is_empty());
    let active = directory.path().join("alive.mcap.active");
    assert!(matches!(recover_file(&active), Err(RecoverError::Busy(_))));
    let path = writer.finish("stopped", START).unwrap();
    assert_eq!(Recording::open(&path).unwrap().end.cause, "stopped");
    assert_eq!(names(directory.path()), ["alive.mcap"]);
}

#[test]
fn the_original_of_a_torn_file_is_kept() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "torn");
    let mut bytes = std::fs::read(&left).unwrap();
    bytes.truncate(bytes.len() - 5);
    std::fs::write(&left, &bytes).unwrap();
    let Ok(Recovery::Recovered { torn: Some(torn), content, .. }) = recover_file(&left) else { panic!() };
    // The last chunk is complete. Only an index behind it is truncated.
    assert_eq!((content.cycles, std::fs::read(torn).unwrap()), (40, bytes));
    assert_eq!(names(directory.path()), ["torn.mcap", "torn.mcap.torn"]);
}

/// A finished recording of 40 cycles with a wrong bit in the middle: its path and its bytes.
fn damaged(directory: &Path) -> (PathBuf, Vec<u8>) {
    let path = running(directory, "damaged").finish("stopped", START).unwrap();
    assert!(matches!(recover_file(&path), Ok(Recovery::Whole { .. })));
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    (path, bytes)
}

/// A disk that refuses hard links with this error number.
#[derive(Debug)]
struct WithoutLinks(i32);

impl Disk for WithoutLinks {
    fn link(&self, _: &Path, _: &Path) -> io::Result<()> {
        Err(io::Error::from_raw_os_error(self.0))
    }
}

#[test]
fn a_damaged_finished_recording_is_replaced_by_what_is_whole_and_kept() {
    let exfat = WithoutLinks(nix::libc::EPERM);
    for disk in [&SystemDisk as &dyn Disk, &exfat] {
        let directory = tempfile::tempdir().unwrap();
        let (path, bytes) = damaged(directory.path());
        let Ok(Recovery::Recovered { torn: Some(torn), content, .. }) = recover_file_on(disk, &path) else {
            panic!()
        };
        let recording = Recording::open(&path).unwrap();
        assert_eq!(recording.cycles.len() as u64, content.cycles);
        assert!(recording.end.recovered);
        // The file has two chunks of 20 cycles. At any position of the damage, one chunk is lost and the other is kept.
        assert_eq!((content.cycles, content.cycles_lost, recording.end.cycles_lost), (40, 20, 20));
        assert_eq!(std::fs::read(torn).unwrap(), bytes);
        assert_eq!(names(directory.path()), ["damaged.mcap", "damaged.mcap.torn"]);
    }
}

#[test]
fn a_damaged_finished_recording_that_cannot_be_replaced_stays_alone() {
    let directory = tempfile::tempdir().unwrap();
    let (path, bytes) = damaged(directory.path());
    let refused = recover_file_on(&WithoutLinks(nix::libc::ENOSPC), &path).unwrap_err().to_string();
    assert!(refused.contains("damaged.mcap.torn"), "{refused}");
    assert_eq!(names(directory.path()), ["damaged.mcap"]);
    assert_eq!(std::fs::read(&path).unwrap(), bytes);
}

#[test]
fn a_finished_file_that_only_lacks_its_name_gets_it() {
    let directory = tempfile::tempdir().unwrap();
    let path = running(directory.path(), "named").finish("stopped", START).unwrap();
    std::fs::rename(&path, directory.path().join("named.mcap.active")).unwrap();
    let leftovers = recover_leftovers(directory.path());
    assert!(matches!(leftovers[0].outcome, Ok(Recovery::Renamed { .. })), "{leftovers:?}");
    assert!(!Recording::open(&path).unwrap().end.recovered);
}

#[test]
fn a_crash_during_recovery_leaves_nothing_to_choose_between() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "twice");
    let bytes = std::fs::read(&left).unwrap();
    recover_file(&left).unwrap();
    // The original was not removed yet, and a partial file of an earlier recovery exists.
    std::fs::write(&left, &bytes).unwrap();
    std::fs::write(directory.path().join("twice.mcap.recovering"), "half").unwrap();
    assert!(recover_leftovers(directory.path())[0].outcome.is_ok());
    assert_eq!(Recording::open(&directory.path().join("twice.mcap")).unwrap().cycles.len(), 40);
    assert!(directory.path().join("twice.mcap.torn").exists() && !left.exists());
}

#[test]
fn a_link_in_the_place_of_the_new_file_is_not_followed() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "linked");
    let other = directory.path().join("other");
    std::fs::write(&other, "precious").unwrap();
    symlink(&other, directory.path().join("linked.mcap.recovering")).unwrap();
    assert!(recover_file(&left).is_err());
    assert_eq!(std::fs::read(&other).unwrap(), b"precious");
    // The link is removed like an incomplete copy, so the next attempt succeeds.
    recover_file(&left).unwrap();
    assert_eq!(std::fs::read(&other).unwrap(), b"precious");
}

#[test]
fn another_run_of_the_same_name_is_never_replaced() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "taken");
    std::fs::write(directory.path().join("taken.mcap"), "precious").unwrap();
    assert!(recover_file(&left).is_err());
    assert_eq!(std::fs::read(directory.path().join("taken.mcap")).unwrap(), b"precious");
    assert!(left.exists());
}

#[test]
fn what_was_never_a_recording_is_set_aside_once() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("notes.mcap.active"), "not a recording").unwrap();
    assert!(recover_leftovers(directory.path())[0].outcome.is_err());
    assert_eq!(names(directory.path()), ["notes.mcap.torn"]);
    assert!(recover_leftovers(directory.path()).is_empty());
    assert!(matches!(recover_file(Path::new("notes.txt")), Err(RecoverError::NotARecording(_))));
}

#[test]
fn of_files_without_a_byte_nothing_is_kept() {
    let directory = tempfile::tempdir().unwrap();
    // Three empty files. The first two are from kills: between the name and the first byte, and between creation and name.
    // The third belongs to a process that is starting.
    let living = format!(".{}-0.new", std::process::id());
    for name in ["empty.mcap.active", ".999999999-0.new", &living] {
        std::fs::write(directory.path().join(name), "").unwrap();
    }
    assert!(recover_leftovers(directory.path()).is_empty());
    assert_eq!(names(directory.path()), [living]);
}

/// A disk that stores wrong bytes and reports no error.
#[derive(Debug)]
struct Forgetful;

impl Disk for Forgetful {
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
        file.write_at(&vec![0; bytes.len()], offset)
    }
}

#[test]
fn a_recovered_file_that_does_not_read_back_is_refused_and_the_original_stays() {
    let directory = tempfile::tempdir().unwrap();
    let left = left_behind(directory.path(), "crashed");
    let before = std::fs::read(&left).unwrap();
    let refused = recover_file_on(&Forgetful, &left).unwrap_err().to_string();
    assert!(refused.contains("does not read back"), "{refused}");
    assert_eq!(names(directory.path()), ["crashed.mcap.active"]);
    assert_eq!(std::fs::read(&left).unwrap(), before);
}
