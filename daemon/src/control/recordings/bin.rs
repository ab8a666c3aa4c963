//! The bin: a deleted recording is kept with its note in the subfolder `.bin` until the bin is emptied.

use std::io;
use std::path::{Path, PathBuf};

use shared::recording::{Disk, FINISHED_ENDING};

use super::runs::{self, RunLine, free_name, stem};
use super::{note, unless_absent};

/// Folder of deleted recordings, in the directory of the others.
const FOLDER: &str = ".bin";

/// The directories of recordings: that of the service and the spare one. Each has its own bin, so that deleting and
/// restoring are renames.
#[derive(Debug, Clone)]
pub struct Places([PathBuf; 2]);

impl Places {
    /// For these two directories.
    pub fn new(directory: &Path, spare: &Path) -> Self {
        Self([directory.to_owned(), spare.to_owned()])
    }

    /// Files of the recordings in both bins.
    fn deleted_files(&self, disk: &dyn Disk) -> io::Result<Vec<PathBuf>> {
        let mut files = Vec::new();
        for directory in &self.0 {
            files.extend(unless_absent(disk.list(&directory.join(FOLDER)))?);
        }
        files.retain(|file| stem(file, FINISHED_ENDING).is_some());
        Ok(files)
    }

    /// The recordings in the bin, the latest first.
    pub fn list(&self, disk: &dyn Disk) -> io::Result<Vec<RunLine>> {
        Ok(runs::lines(disk, self.deleted_files(disk)?))
    }

    /// Moves the recording of this name out of the bin; returns its new name, or `None` if the bin does not have it.
    pub fn restore(&self, disk: &dyn Disk, name: &str) -> io::Result<Option<String>> {
        let files = self.deleted_files(disk)?;
        let wanted = files.iter().find(|file| stem(file, FINISHED_ENDING).is_some_and(|stem| stem == name));
        let Some(file) = wanted else { return Ok(None) };
        let Some(directory) = file.parent().and_then(Path::parent) else { return Ok(None) };
        move_to_free_name(disk, file, directory).map(Some)
    }

    /// Removes every recording in the bin from the disk, with its note; returns their number.
    pub fn empty(&self, disk: &dyn Disk) -> io::Result<u64> {
        let files = self.deleted_files(disk)?;
        for file in &files {
            disk.remove(file)?;
            note::remove(disk, file)?;
        }
        Ok(files.len() as u64)
    }
}

/// Moves a finished recording into the bin of its directory; returns its name there.
pub fn put(disk: &dyn Disk, recording: &Path) -> io::Result<String> {
    let bin = recording.parent().unwrap_or(Path::new(".")).join(FOLDER);
    disk.make_directory(&bin)?;
    move_to_free_name(disk, recording, &bin)
}

/// Moves a recording and its note to a free name. The note is moved last: it is found only beside its recording.
fn move_to_free_name(disk: &dyn Disk, file: &Path, directory: &Path) -> io::Result<String> {
    let name = free_name(disk, directory, &stem(file, FINISHED_ENDING).unwrap_or_default());
    let new_file = directory.join(format!("{name}.{FINISHED_ENDING}"));
    disk.rename(file, &new_file)?;
    unless_absent(disk.replace(&note::beside(file), &note::beside(&new_file)))?;
    disk.sync_directory(directory)?;
    disk.sync_directory(file.parent().unwrap_or(Path::new(".")))?;
    Ok(name)
}
