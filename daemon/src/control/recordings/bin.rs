//! The bin: a deleted recording is kept with its note in a subfolder until the bin is emptied.

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

    fn deleted(&self, disk: &dyn Disk) -> io::Result<Vec<PathBuf>> {
        let mut files = Vec::new();
        for directory in &self.0 {
            files.extend(unless_absent(disk.list(&directory.join(FOLDER)))?);
        }
        files.retain(|file| stem(file, FINISHED_ENDING).is_some());
        Ok(files)
    }

    /// The recordings in the bin, the latest first.
    pub fn list(&self, disk: &dyn Disk) -> io::Result<Vec<RunLine>> {
        Ok(runs::lines(disk, self.deleted(disk)?))
    }

    /// Moves the recording of this name out of the bin; returns its new name, or `None` if the bin does not have it.
    pub fn restore(&self, disk: &dyn Disk, name: &str) -> io::Result<Option<String>> {
        let files = self.deleted(disk)?;
        let wanted = files.iter().find(|file| stem(file, FINISHED_ENDING).is_some_and(|stem| stem == name));
        let home = |file: &PathBuf| file.parent().and_then(Path::parent).map(Path::to_owned);
        let Some((file, home)) = wanted.and_then(|file| Some((file, home(file)?))) else { return Ok(None) };
        moved(disk, file, &home).map(Some)
    }

    /// Removes every recording in the bin from the disk, with its note; returns their number.
    pub fn empty(&self, disk: &dyn Disk) -> io::Result<u64> {
        let files = self.deleted(disk)?;
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
    moved(disk, recording, &bin)
}

/// Moves a recording and its note to a free name. The note is moved last: it is found only beside its recording.
fn moved(disk: &dyn Disk, file: &Path, directory: &Path) -> io::Result<String> {
    let name = free_name(disk, directory, &stem(file, FINISHED_ENDING).unwrap_or_default());
    let to = directory.join(format!("{name}.{FINISHED_ENDING}"));
    disk.rename(file, &to)?;
    unless_absent(disk.replace(&note::beside(file), &note::beside(&to)))?;
    disk.sync_directory(directory)?;
    disk.sync_directory(file.parent().unwrap_or(Path::new(".")))?;
    Ok(name)
}
