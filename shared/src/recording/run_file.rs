//! A run's file on disk: created locked, published by a rename, never replacing another.

use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, Flock, FlockArg, RenameFlags, renameat2};

use super::writer::WriteError;

/// Ending of a finished recording.
pub const FINISHED_ENDING: &str = "mcap";
/// Ending of a recording that is being written, or that was left by a crash.
pub const ACTIVE_ENDING: &str = "mcap.active";
/// Ending of the original of a recovered recording, kept where a part of it could not be read.
pub const TORN_ENDING: &str = "mcap.torn";

/// Longest name: with the longest ending it fits into the 143 bytes that encrypted file systems leave of 255.
const NAME_BYTES_MAX: usize = 120;

/// A run's file on disk, `.mcap.active` until it is finished. Whoever has one holds the lock on the file, which
/// ends with the process however it ends: a file without the lock has been left behind.
#[derive(Debug)]
pub struct RunFile {
    file: Flock<File>,
    active: PathBuf,
    finished: PathBuf,
}

impl RunFile {
    /// Creates `<directory>/<name>.mcap.active`; the directory is made where it is missing.
    pub fn create(directory: &Path, name: &str) -> Result<Self, WriteError> {
        check_name(name)?;
        std::fs::create_dir_all(directory).map_err(io_error(directory))?;
        let active = directory.join(format!("{name}.{ACTIVE_ENDING}"));
        let finished = directory.join(format!("{name}.{FINISHED_ENDING}"));
        if finished.exists() {
            return Err(WriteError::Exists(finished));
        }
        let file = create_locked(directory, &active)?;
        sync_directory(directory).map_err(io_error(directory))?;
        Ok(Self { file, active, finished })
    }

    /// Where the bytes are while the run goes on.
    pub fn active_path(&self) -> &Path {
        &self.active
    }

    /// Gives the file its final name, without ever replacing another.
    pub(super) fn publish(self) -> Result<PathBuf, WriteError> {
        let Self { file, active, finished } = self;
        file.sync_all().map_err(io_error(&finished))?;
        rename(&active, &finished)?;
        Ok(finished)
    }
}

/// Refuses names that are not plain file names, that a command would take for an option, or that say what state a
/// file is in.
fn check_name(name: &str) -> Result<(), WriteError> {
    let plain = |c: char| c.is_alphanumeric() || "-_.+".contains(c);
    let endings = [FINISHED_ENDING, "active", "torn", "recovering"];
    let has_ending = endings.iter().any(|ending| name.split('.').skip(1).any(|part| part == *ending));
    if name.is_empty()
        || name.starts_with(['.', '-'])
        || name.len() > NAME_BYTES_MAX
        || has_ending
        || !name.chars().all(plain)
    {
        return Err(WriteError::Name(name.to_owned()));
    }
    Ok(())
}

/// A new file that bears its name only once it is locked, so that nobody takes it for one left behind.
fn create_locked(directory: &Path, active: &Path) -> Result<Flock<File>, WriteError> {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let hidden = directory.join(format!(".{}-{number}.new", std::process::id()));
    let file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(true)
        .open(&hidden)
        .map_err(io_error(&hidden))?;
    let named = lock(file).map_err(io_error(&hidden)).and_then(|file| {
        rename_without_replacing(&hidden, active).map_err(exists_or_io(active))?;
        Ok(file)
    });
    if named.is_err() {
        // It is empty; what went wrong is reported, not this.
        let _ = std::fs::remove_file(&hidden);
    }
    named
}

/// Locks a file against every other process; `WouldBlock` where one has it.
pub(super) fn lock(file: File) -> io::Result<Flock<File>> {
    Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, error)| error.into())
}

/// Renames without replacing, and makes the new name survive a power cut.
pub(super) fn rename(from: &Path, to: &Path) -> Result<(), WriteError> {
    rename_without_replacing(from, to).map_err(exists_or_io(to))?;
    let directory = to.parent().unwrap_or(Path::new("."));
    sync_directory(directory).map_err(io_error(directory))
}

fn rename_without_replacing(from: &Path, to: &Path) -> io::Result<()> {
    match renameat2(AT_FDCWD, from, AT_FDCWD, to, RenameFlags::RENAME_NOREPLACE) {
        // Some file systems know no such rename; the name was free when the run began.
        Err(Errno::EINVAL | Errno::ENOSYS) if !to.exists() => std::fs::rename(from, to),
        result => result.map_err(io::Error::from),
    }
}

pub(super) fn sync_directory(directory: &Path) -> io::Result<()> {
    let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
    File::open(directory)?.sync_all()
}

pub(super) fn io_error(path: &Path) -> impl FnOnce(io::Error) -> WriteError {
    let path = path.to_owned();
    move |source| WriteError::Io { path, source }
}

fn exists_or_io(path: &Path) -> impl FnOnce(io::Error) -> WriteError {
    let path = path.to_owned();
    move |source| {
        if source.kind() == io::ErrorKind::AlreadyExists {
            WriteError::Exists(path)
        } else {
            WriteError::Io { path, source }
        }
    }
}

impl Write for RunFile {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.file.write(buffer)
    }

    /// Returns when everything written so far survives a power cut.
    fn flush(&mut self) -> io::Result<()> {
        self.file.sync_data()
    }
}

impl Seek for RunFile {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.file.seek(position)
    }
}
