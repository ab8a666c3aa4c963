//! The bin: a deleted recording and its note are kept in the subfolder `.bin` until the bin is emptied.

use std::io;
use std::path::{Path, PathBuf};

use shared::recording::{Disk, FINISHED_ENDING};

use super::runs::{self, RunLine, free_name, stem};
use super::{note, unless_absent};

/// Folder of the deleted recordings, inside the directory of the recordings.
const FOLDER: &str = ".bin";

/// The bin of each directory. Each directory has its own bin, so that deleting and restoring are renames on one disk.
fn bins(directories: &[PathBuf]) -> Vec<PathBuf> {
    directories.iter().map(|directory| directory.join(FOLDER)).collect()
}

/// Lists the recordings in the bins of these directories, the latest first.
pub fn list(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<Vec<RunLine>> {
    runs::list(disk, &bins(directories))
}

/// Moves the recording of this name out of the bin. Returns its new name, or `None` if no bin contains the recording.
pub fn restore(disk: &dyn Disk, directories: &[PathBuf], name: &str) -> io::Result<Option<String>> {
    let Some(file) = runs::find(disk, &bins(directories), name)? else { return Ok(None) };
    let Some(directory) = file.parent().and_then(Path::parent) else { return Ok(None) };
    move_to_free_name(disk, &file, directory, directories).map(Some)
}

/// Removes all recordings in the bins, with their notes, from the disk. Returns the number of removed recordings.
pub fn empty(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<u64> {
    let mut files = runs::files(disk, &bins(directories))?;
    files.retain(|file| stem(file, FINISHED_ENDING).is_some());
    for file in &files {
        // Another process may have removed the file since the listing.
        unless_absent(disk.remove(file))?;
        note::remove(disk, file)?;
    }
    Ok(files.len() as u64)
}

/// Moves a finished recording into the bin of its directory. Returns the name of the recording in the bin.
pub fn put(disk: &dyn Disk, recording: &Path) -> io::Result<String> {
    let bin = recording.parent().unwrap_or(Path::new(".")).join(FOLDER);
    disk.make_directory(&bin)?;
    move_to_free_name(disk, recording, &bin, std::slice::from_ref(&bin))
}

/// Moves a recording and its note into `directory`, to a name that is free in all of `directories`. The note is moved last,
/// because a note is found only through the recording next to it.
fn move_to_free_name(
    disk: &dyn Disk,
    file: &Path,
    directory: &Path,
    directories: &[PathBuf],
) -> io::Result<String> {
    let name = free_name(disk, directories, &stem(file, FINISHED_ENDING).unwrap_or_default());
    let new_file = directory.join(format!("{name}.{FINISHED_ENDING}"));
    disk.rename(file, &new_file)?;
    unless_absent(disk.replace(&note::beside(file), &note::beside(&new_file)))?;
    disk.sync_directory(directory)?;
    disk.sync_directory(file.parent().unwrap_or(Path::new(".")))?;
    Ok(name)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use shared::recording::SystemDisk;

    use super::*;

    #[test]
    fn a_bin_is_emptied_if_the_spare_directory_is_the_other_directory() {
        let home = tempfile::tempdir().unwrap();
        let [runs, link] = ["runs", "link"].map(|name| home.path().join(name));
        fs::create_dir(&runs).unwrap();
        symlink(&runs, &link).unwrap();
        for spare in [&runs, &link] {
            for name in ["one", "two"] {
                let recording = runs.join(format!("{name}.mcap"));
                fs::write(&recording, "").unwrap();
                put(&SystemDisk, &recording).unwrap();
            }
            let directories = [runs.clone(), spare.clone()];
            empty(&SystemDisk, &directories).unwrap();
            assert!(list(&SystemDisk, &directories).unwrap().is_empty());
        }
    }
}
