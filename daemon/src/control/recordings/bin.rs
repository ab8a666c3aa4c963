//! The bin: a deleted recording is kept with its note in the subfolder `.bin` until the bin is emptied.

use std::io;
use std::path::{Path, PathBuf};

use shared::recording::{Disk, FINISHED_ENDING};

use super::runs::{self, RunLine, free_name, stem};
use super::{note, unless_absent};

/// Folder of deleted recordings, in the directory of the others.
const FOLDER: &str = ".bin";

/// The bin of each directory: they are separate, so that deleting and restoring are renames.
fn bins(directories: &[PathBuf]) -> Vec<PathBuf> {
    directories.iter().map(|directory| directory.join(FOLDER)).collect()
}

/// The recordings in the bins of these directories, the latest first.
pub fn list(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<Vec<RunLine>> {
    runs::list(disk, &bins(directories))
}

/// Moves the recording of this name out of the bin; returns its new name, or `None` if no bin has it.
pub fn restore(disk: &dyn Disk, directories: &[PathBuf], name: &str) -> io::Result<Option<String>> {
    let Some(file) = runs::find(disk, &bins(directories), name)? else { return Ok(None) };
    let Some(directory) = file.parent().and_then(Path::parent) else { return Ok(None) };
    move_to_free_name(disk, &file, directory).map(Some)
}

/// Removes every recording in the bins from the disk, with its note; returns their number.
pub fn empty(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<u64> {
    let mut files = runs::files(disk, &bins(directories))?;
    files.retain(|file| stem(file, FINISHED_ENDING).is_some());
    for file in &files {
        disk.remove(file)?;
        note::remove(disk, file)?;
    }
    Ok(files.len() as u64)
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
