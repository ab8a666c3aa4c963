//! The file of a run on a disk that fails, is removed or becomes full. No data that can be recovered are lost,
//! and every reported file exists.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use shared::recording::{Disk, Recording, RecordingWriter, RunFile, WriteError};

use crate::support::run::{START, cycle, run};

/// A disk that accepts this number of bytes in total, at most 1000 with each write.
#[derive(Debug)]
struct Full(AtomicU64);

impl Disk for Full {
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
        use std::os::unix::fs::FileExt;
        let room = self.0.load(Ordering::Relaxed).min(bytes.len() as u64).min(1000);
        if room == 0 {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.0.fetch_sub(room, Ordering::Relaxed);
        file.write_at(&bytes[..room as usize], offset)
    }
}

fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).unwrap().flatten();
    let mut names: Vec<_> = entries.map(|entry| entry.file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn write(writer: &mut RecordingWriter<RunFile>, cycles: std::ops::Range<u64>) {
    for number in cycles {
        writer.write_cycle(&cycle(number)).unwrap();
    }
    writer.sync().unwrap();
}

fn all_are_in(path: &Path, cycles: u64) {
    assert_eq!(Recording::open(path).unwrap().cycles, (0..cycles).map(cycle).collect::<Vec<_>>());
}

#[test]
fn a_start_on_a_full_disk_leaves_no_file() {
    for room in [0, 100, 1000] {
        let directory = tempfile::tempdir().unwrap();
        let full = Arc::new(Full(room.into()));
        let refused = RecordingWriter::create_on(full, directory.path(), &run("full")).err().unwrap();
        assert!(refused.to_string().contains("full.mcap.active"), "{refused}");
        assert_eq!(names(directory.path()), [""; 0]);
    }
}

#[test]
fn a_run_whose_file_was_removed_has_all_of_it_in_another_place() {
    let (directory, spare) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut writer = RecordingWriter::create(directory.path(), &run("gone")).unwrap();
    write(&mut writer, 0..20);
    let place = writer.sink().place().clone();
    place.check().unwrap();
    std::fs::remove_file(place.path()).unwrap();
    assert!(matches!(place.check(), Err(WriteError::Lost(_))));
    // In the spare directory, another file has the name of the run, and the next name is used too.
    std::fs::write(spare.path().join("gone.mcap"), "precious").unwrap();
    std::fs::write(spare.path().join("gone-2.mcap.active"), "precious").unwrap();
    writer.sink_mut().move_to(spare.path()).unwrap();
    write(&mut writer, 20..40);
    let path = writer.finish("stopped", START).unwrap();
    assert_eq!(path, spare.path().join("gone-3.mcap"));
    all_are_in(&path, 40);
    assert_eq!(std::fs::read(spare.path().join("gone.mcap")).unwrap(), b"precious");
}

/// A function that changes a directory and the run's file in it.
type Way<'a> = &'a dyn Fn(&Path, &Path);

#[test]
fn a_file_that_is_not_there_any_more_never_gets_its_final_name() {
    let replaced = |directory: &Path, active: &Path| {
        std::fs::remove_file(active).unwrap();
        std::fs::write(directory.join("lost.mcap.active"), "another").unwrap();
    };
    let removed = |_: &Path, active: &Path| std::fs::remove_file(active).unwrap();
    let directory_removed = |directory: &Path, _: &Path| std::fs::remove_dir_all(directory).unwrap();
    let moved = |directory: &Path, active: &Path| {
        std::fs::rename(active, directory.join("mine.mcap.active")).unwrap();
    };
    let ways: [Way<'_>; 4] = [&replaced, &removed, &directory_removed, &moved];
    for way in ways {
        let parent = tempfile::tempdir().unwrap();
        let directory = parent.path().join("runs");
        let mut writer = RecordingWriter::create(&directory, &run("lost")).unwrap();
        write(&mut writer, 0..5);
        let place = writer.sink().place().clone();
        way(&directory, place.path());
        assert!(matches!(place.check(), Err(WriteError::Lost(_))));
        assert!(matches!(writer.finish("stopped", START), Err(WriteError::Lost(_))));
        assert!(!directory.join("lost.mcap").exists());
    }
}

#[test]
fn what_a_full_disk_refused_goes_out_first_where_there_is_room() {
    for room in [3000, 4000, 5000, 6000, 7000, 8000] {
        let (directory, spare) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let full = Arc::new(Full(u64::MAX.into()));
        let disk: Arc<dyn Disk> = full.clone();
        let mut writer = RecordingWriter::create_on(disk, directory.path(), &run("full")).unwrap();
        full.0.store(room, Ordering::Relaxed);
        let mut refusals = 0;
        for number in 0..300 {
            let outcome = writer.write_cycle(&cycle(number)).and_then(|()| writer.cut());
            if let Err(error) = outcome {
                assert!(error.to_string().contains("full.mcap.active"), "{error}");
                refusals += 1;
                full.0.store(u64::MAX, Ordering::Relaxed);
                writer.sink_mut().move_to(spare.path()).unwrap();
                writer.write_out().unwrap();
                // The copy is complete, so the original was removed.
                assert_eq!(names(directory.path()), [""; 0]);
            }
        }
        assert_eq!(refusals, 1);
        all_are_in(&writer.finish("stopped", START).unwrap(), 300);
    }
}

/// A disk that returns other bytes than those that were written.
#[derive(Debug)]
struct Forgetful;

impl Disk for Forgetful {
    fn read_at(&self, _: &File, buffer: &mut [u8], _: u64) -> io::Result<usize> {
        buffer.fill(0);
        Ok(buffer.len())
    }
}

#[test]
fn a_copy_of_what_does_not_read_back_is_refused_and_the_run_stays_where_it_is() {
    let (directory, spare) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut writer = RecordingWriter::create_on(Arc::new(Forgetful), directory.path(), &run("odd")).unwrap();
    write(&mut writer, 0..20);
    let refused = writer.sink_mut().move_to(spare.path()).unwrap_err();
    assert!(refused.to_string().contains("does not read back"), "{refused}");
    assert_eq!(names(spare.path()), [""; 0]);
    write(&mut writer, 20..40);
    all_are_in(&writer.finish("stopped", START).unwrap(), 40);
}
