//! Recovers damaged files, and files that are incomplete after a crash, a kill or a power cut. The steps for a file are:
//! 1. Lock and read the file. If it is undamaged, give it its final name; this is the last step.
//! 2. Otherwise write its undamaged records into a new file (`.mcap.recovering`), and read that file back.
//! 3. Give the new file the final name.
//! 4. Remove the original. If some of its bytes could not be used, rename it to `.mcap.torn` instead.
//!
//! At every moment, at least one of the two files exists. The name of each file shows whether the file is complete.

use std::fs::File;
use std::io::{self, BufReader, BufWriter};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use nix::fcntl::Flock;
use nix::libc::{EOPNOTSUPP, EPERM};

use crate::recording::disk::{Disk, OpenFile, SystemDisk, is_absent};
use crate::recording::recover::{self, SalvageError, Salvaged};
use crate::recording::run_file::{
    ACTIVE_ENDING, FINISHED_ENDING, TORN_ENDING, UNNAMED_ENDING, io_error, rename, sync_parent,
};
use crate::recording::schema::RunMetadata;
use crate::recording::writer::WriteError;

/// Ending of a recovered file that has not been read back yet.
const RECOVERING_ENDING: &str = "mcap.recovering";
/// Largest number of `.mcap.torn` files of the same run. A number in their names distinguishes them.
const TORN_MAX: u32 = 1000;
/// Number of attempts to lock a file. An attempt can fail because another thread or process runs [`is_in_use`], which holds
/// a shared lock on the file for a few microseconds.
const LOCK_TRIES: u32 = 100;
const LOCK_PAUSE: Duration = Duration::from_millis(1);

/// Result of the recovery of a file.
#[derive(Debug, Clone, PartialEq)]
pub enum Recovery {
    /// The file is finished and undamaged. Nothing was changed.
    Whole {
        /// Content of the recording.
        content: Box<Salvaged>,
    },
    /// The file was finished and undamaged, and only lacked its final name.
    Renamed {
        /// Path with the final name.
        file: PathBuf,
        /// Content of the recording.
        content: Box<Salvaged>,
    },
    /// The undamaged records of the file are now in a finished recording.
    Recovered {
        /// Path of the finished recording.
        file: PathBuf,
        /// Path of the original under its new name `.mcap.torn`. `None` if the original was removed.
        torn: Option<PathBuf>,
        /// Content of the finished recording.
        content: Box<Salvaged>,
    },
}

/// Why a file could not be recovered. The file is then unchanged.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// The file does not have the name of a recording.
    #[error("{}: not a recording; its name must end in .mcap or .mcap.active", .0.display())]
    NotARecording(PathBuf),
    /// A running process writes the file.
    #[error("{}: is being written by a running ballbard; stop that run instead", .0.display())]
    Busy(PathBuf),
    /// A system call failed.
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Io {
        /// Path of the file concerned.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The content cannot be recovered.
    #[error("{}: {source}", path.display())]
    Salvage {
        /// Path of the file concerned.
        path: PathBuf,
        /// Why it cannot be salvaged.
        source: SalvageError,
    },
    /// A file could not be renamed, or the new file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// A file that was left incomplete.
#[derive(Debug)]
pub struct Leftover {
    /// Path under which it was found.
    pub file: PathBuf,
    /// Result of its recovery.
    pub outcome: Result<Recovery, RecoverError>,
}

/// Recovers a damaged or incomplete file. Its undamaged records become a finished recording.
pub fn recover_file(path: &Path) -> Result<Recovery, RecoverError> {
    recover_file_on(&SystemDisk, path)
}

/// [`recover_file`] on another disk.
pub fn recover_file_on(disk: &dyn Disk, path: &Path) -> Result<Recovery, RecoverError> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let active = name.strip_suffix(&format!(".{ACTIVE_ENDING}"));
    let stem = active.or_else(|| name.strip_suffix(&format!(".{FINISHED_ENDING}")));
    let stem = stem.ok_or_else(|| RecoverError::NotARecording(path.to_owned()))?;
    let io = |source| RecoverError::Io { path: path.to_owned(), source };
    let original = lock_left_behind(disk, path).map_err(|error| match error.kind() {
        io::ErrorKind::WouldBlock => RecoverError::Busy(path.to_owned()),
        _ => io(error),
    })?;
    let finished = path.with_file_name(format!("{stem}.{FINISHED_ENDING}"));
    let salvage = |source| RecoverError::Salvage { path: path.to_owned(), source };
    // If the file is undamaged, at most its name must be changed.
    if let Ok(content) = recover::check(BufReader::new(OpenFile::new(disk, &original))) {
        let content = Box::new(content);
        if active.is_none() {
            return Ok(Recovery::Whole { content });
        }
        disk.sync(&original).map_err(io)?;
        rename(disk, path, &finished)?;
        return Ok(Recovery::Renamed { file: finished, content });
    }
    // If a finished file with the final name exists, it may be the result of an earlier recovery.
    if active.is_some() && disk.has(&finished).map_err(io)? {
        let (run, _) = recover::find_run(OpenFile::new(disk, &original)).map_err(salvage)?;
        return keep_existing(disk, path, finished, &run);
    }
    let recovering = path.with_file_name(format!("{stem}.{RECOVERING_ENDING}"));
    let content = rewrite(disk, &original, &recovering).map_err(salvage)?;
    replace(disk, path, &recovering, &finished, content).inspect_err(|_| {
        // While the original has its name, the copy is not needed.
        if disk.has(path).unwrap_or(false) {
            let _ = disk.remove(&recovering);
        }
    })
}

/// Recovers every file of a directory that a crash left incomplete. Files of running processes are skipped. If nothing can
/// be recovered from a file, the file is renamed, so that later calls ignore it. Empty files are removed.
pub fn recover_leftovers(directory: &Path) -> Vec<Leftover> {
    recover_leftovers_on(&SystemDisk, directory)
}

/// [`recover_leftovers`] on another disk.
pub fn recover_leftovers_on(disk: &dyn Disk, directory: &Path) -> Vec<Leftover> {
    let mut files = match disk.list(directory) {
        Ok(files) => files,
        // If the directory does not exist yet, it contains no recordings.
        Err(error) if is_absent(&error) => return Vec::new(),
        Err(source) => {
            let file = directory.to_owned();
            let outcome = Err(RecoverError::Io { path: file.clone(), source });
            return vec![Leftover { file, outcome }];
        }
    };
    files.sort();
    files.retain(|path| is_left_over(path) && !remove_if_empty(disk, path) && !is_unnamed(path));
    let outcomes = files.into_iter().map(|file| Leftover { outcome: recover_file_on(disk, &file), file });
    outcomes
        .filter(|leftover| !matches!(leftover.outcome, Err(RecoverError::Busy(_))))
        .inspect(|leftover| {
            if let Err(RecoverError::Salvage { source: SalvageError::NothingWhole(_), .. }) = leftover.outcome
            {
                // Remove the file if it is empty. An earlier check of its length may have failed. Otherwise rename the file. If
                // both fail, the next start of the daemon tries again.
                let _ = remove_if_empty(disk, &leftover.file) || set_aside(disk, &leftover.file).is_ok();
            }
        })
        .collect()
}

/// Whether a crash can have left a file with this name. The name is either that of an unfinished run, or the temporary name
/// of a new file. A temporary name only counts if the process that created the file has ended.
fn is_left_over(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_active = !name.starts_with('.') && name.ends_with(&format!(".{ACTIVE_ENDING}"));
    is_active || unnamed_by(path).is_some_and(|process| !Path::new("/proc").join(process).exists())
}

fn is_unnamed(path: &Path) -> bool {
    unnamed_by(path).is_some()
}

/// Number of the process that created a file under a temporary name. The name contains this number.
fn unnamed_by(path: &Path) -> Option<&str> {
    let name = path.file_name()?.to_str()?.strip_prefix('.')?.strip_suffix(UNNAMED_ENDING)?;
    name.split_once('-').map(|(process, _)| process)
}

/// Removes an empty file, unless a process holds its lock. Returns whether the file was removed.
fn remove_if_empty(disk: &dyn Disk, path: &Path) -> bool {
    let is_empty = |file: &File| disk.length(file).is_ok_and(|length| length == 0);
    let unused = disk.open(path).ok().filter(is_empty).and_then(|_| lock_left_behind(disk, path).ok());
    unused.is_some_and(|unused| is_empty(&unused) && disk.remove(path).is_ok())
}

/// Writes the undamaged records of `original` into the file `recovering`, and reads that file back.
fn rewrite(disk: &dyn Disk, original: &File, recovering: &Path) -> Result<Salvaged, SalvageError> {
    let created = disk.create(recovering).map_err(io_error(recovering));
    let outcome = created.map_err(SalvageError::from).and_then(|file| {
        let sink = BufWriter::new(OpenFile::new(disk, &file));
        let (content, written) = recover::salvage(OpenFile::new(disk, original), sink)?;
        written.into_inner().map_err(|error| io_error(recovering)(error.into_error()))?;
        disk.sync(&file).map_err(io_error(recovering))?;
        recover::verify(BufReader::new(OpenFile::new(disk, &file)), &content)?;
        Ok(content)
    });
    if outcome.is_err() {
        // The original is unchanged, so the incomplete copy is not needed.
        let _ = disk.remove(recovering);
    }
    outcome
}

/// Gives the recovered file its final name. Then removes the original. If some of its bytes were not used, the
/// original is kept as `.mcap.torn`.
fn replace(
    disk: &dyn Disk,
    path: &Path,
    recovering: &Path,
    finished: &Path,
    content: Salvaged,
) -> Result<Recovery, RecoverError> {
    let torn = if path == finished {
        let torn = free_torn_name(disk, path)?;
        match disk.link(path, &torn) {
            // Some file systems, such as exFAT, have no hard links. On them, the final name is unused until the next rename.
            Err(error) if matches!(error.raw_os_error(), Some(EPERM | EOPNOTSUPP)) => {
                rename(disk, path, &torn)?;
            }
            linked => linked.map_err(io_error(&torn))?,
        }
        disk.replace(recovering, finished).map_err(io_error(finished))?;
        sync_parent(disk, finished)?;
        Some(torn)
    } else {
        rename(disk, recovering, finished)?;
        // If a damaged file has an end record, something was lost, even if no byte was skipped.
        if content.damage.is_some() || content.end.is_some() {
            Some(set_aside(disk, path)?)
        } else {
            disk.remove(path).map_err(io_error(path))?;
            sync_parent(disk, path)?;
            None
        }
    };
    Ok(Recovery::Recovered { file: finished.to_owned(), torn, content: Box::new(content) })
}

/// Handles the case that an unfinished and a finished file of the same name exist, as after a crash during an earlier
/// recovery. The finished file is kept if it is undamaged and of the same run.
fn keep_existing(
    disk: &dyn Disk,
    path: &Path,
    finished: PathBuf,
    run: &RunMetadata,
) -> Result<Recovery, RecoverError> {
    let existing = disk.open(&finished).ok();
    let existing = existing.and_then(|file| recover::check(BufReader::new(OpenFile::new(disk, &file))).ok());
    match existing.filter(|existing| existing.run == *run) {
        Some(existing) => {
            let torn = set_aside(disk, path)?;
            Ok(Recovery::Recovered { file: finished, torn: Some(torn), content: Box::new(existing) })
        }
        None => Err(WriteError::Exists(finished).into()),
    }
}

/// Renames a file to `.mcap.torn`, so that it is not a recording of the list any more. Returns the new path.
pub fn set_aside(disk: &dyn Disk, path: &Path) -> Result<PathBuf, WriteError> {
    let torn = free_torn_name(disk, path)?;
    rename(disk, path, &torn)?;
    Ok(torn)
}

fn free_torn_name(disk: &dyn Disk, path: &Path) -> Result<PathBuf, WriteError> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let stem = name.trim_end_matches(".active").trim_end_matches(".mcap");
    let numbered = (1..TORN_MAX).map(|number| format!("{stem}-{number}.{TORN_ENDING}"));
    let first = path.with_file_name(format!("{stem}.{TORN_ENDING}"));
    for candidate in std::iter::once(first.clone()).chain(numbered.map(|name| path.with_file_name(name))) {
        if !disk.has(&candidate).map_err(io_error(&candidate))? {
            return Ok(candidate);
        }
    }
    Err(WriteError::Exists(first))
}

/// Whether a running process writes the file. The test holds a shared lock for a moment, so several processes can
/// test at the same time.
pub fn is_in_use(disk: &dyn Disk, path: &Path) -> io::Result<bool> {
    disk.open(path).and_then(|file| disk.is_locked(file))
}

/// Locks a file. Fails with `WouldBlock` if a process writes the file. If only [`is_in_use`] of another thread or process
/// holds a shared lock, waits until that lock is released.
fn lock_left_behind(disk: &dyn Disk, path: &Path) -> io::Result<Flock<File>> {
    for _ in 0..LOCK_TRIES {
        match disk.lock(disk.open_to_lock(path)?) {
            Err(error)
                if error.kind() == io::ErrorKind::WouldBlock && !is_in_use(disk, path).unwrap_or(true) =>
            {
                thread::sleep(LOCK_PAUSE);
            }
            outcome => return outcome,
        }
    }
    Err(io::ErrorKind::WouldBlock.into())
}
