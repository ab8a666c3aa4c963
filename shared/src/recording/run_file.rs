//! The file of a run on disk. Its steps are:
//! 1. Create the file under a hidden temporary name and lock it.
//! 2. Rename it to `<name>.mcap.active`, and write the run.
//! 3. At the end of the run, rename it to `<name>.mcap`.
//!
//! None of these steps replaces an existing file.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use crc32fast::Hasher;
use nix::fcntl::Flock;

use super::disk::{Disk, FileId, is_absent};
use super::writer::WriteError;

/// Ending of a complete recording.
pub const FINISHED_ENDING: &str = "mcap";
/// Ending of a recording that is being written, or that a crash left incomplete.
pub const ACTIVE_ENDING: &str = "mcap.active";
/// Ending of the original of a recovered recording. The original is kept if some of its bytes could not be recovered.
pub const TORN_ENDING: &str = "mcap.torn";

/// Longest name of a run \[bytes\]. The name with the longest ending then fits into 143 bytes, the limit of encrypted file
/// systems. Other file systems allow 255 bytes.
const NAME_BYTES_MAX: usize = 120;
/// Number of bytes that are copied at a time.
const COPY_BYTES: usize = 1 << 20;
/// A run may continue in another directory in which its name is taken. A number below this limit is then added to the name.
const COPY_NAMES: u32 = 100;

/// The file of a run on disk, with the ending `.mcap.active` until it is complete. The process that writes the file holds a
/// lock on it. The kernel releases the lock when that process ends, even by a crash. A file without a lock therefore belongs
/// to no running process.
#[derive(Debug)]
pub struct RunFile {
    place: RunPlace,
    file: Arc<Flock<File>>,
    finished: PathBuf,
    /// Number of bytes that were written to the file.
    length: u64,
    /// Checksum over all bytes that were written.
    checksum: Hasher,
}

/// Path and identity of a run's file. Used to check whether the file still exists under its path.
#[derive(Debug, Clone)]
pub struct RunPlace {
    disk: Arc<dyn Disk>,
    path: PathBuf,
    id: FileId,
}

/// Synchronises a run's file from another thread while more data are written to it.
#[derive(Debug, Clone)]
pub struct RunSync {
    place: RunPlace,
    file: Arc<Flock<File>>,
}

impl RunFile {
    /// Creates `<directory>/<name>.mcap.active`. A missing directory is created. After an error no file is left.
    pub fn create(disk: Arc<dyn Disk>, directory: &Path, name: &str) -> Result<Self, WriteError> {
        check_name(name)?;
        disk.make_directory(directory).map_err(io_error(directory))?;
        let path = directory.join(format!("{name}.{ACTIVE_ENDING}"));
        let finished = directory.join(format!("{name}.{FINISHED_ENDING}"));
        if disk.has(&finished).map_err(io_error(&finished))? {
            return Err(WriteError::Exists(finished));
        }
        let file = create_locked(&*disk, directory, &path)?;
        let named = disk.sync_directory(directory).and_then(|()| disk.id_of(&file));
        let id = named.map_err(|source| {
            // The file is empty and is removed. The caller gets the original error, even if the removal fails, too.
            let _ = disk.remove(&path);
            io_error(directory)(source)
        })?;
        let place = RunPlace { disk, path, id };
        Ok(Self { place, file: Arc::new(file), finished, length: 0, checksum: Hasher::new() })
    }

    /// Path and identity of the file during the run.
    pub fn place(&self) -> &RunPlace {
        &self.place
    }

    /// Number of bytes that were written to the file.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// A handle for the thread that synchronises the file.
    pub fn synchroniser(&self) -> RunSync {
        RunSync { place: self.place.clone(), file: Arc::clone(&self.file) }
    }

    /// Copies the file into `directory` and continues to write the copy. If the name is taken in that directory, a
    /// number is added to it. Then the old file is removed if it still exists, because the copy is complete. After
    /// an error nothing is changed.
    pub fn move_to(&mut self, directory: &Path) -> Result<(), WriteError> {
        let stem = self.finished.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        let numbered = (2..COPY_NAMES).map(|number| format!("{stem}-{number}"));
        let mut copy = Err(WriteError::Exists(directory.join(stem)));
        for name in std::iter::once(stem.to_owned()).chain(numbered) {
            copy = Self::create(Arc::clone(&self.place.disk), directory, &name);
            if !matches!(copy, Err(WriteError::Exists(_))) {
                break;
            }
        }
        let mut copy = copy?;
        if let Err(error) = copy.take_over(self) {
            copy.place.remove();
            return Err(error);
        }
        let old = std::mem::replace(self, copy);
        if old.place.check().is_ok() {
            old.place.remove();
        }
        Ok(())
    }

    /// Copies the content of another file into this one. Compares the copy with the checksum of the bytes that were written.
    fn take_over(&mut self, other: &Self) -> Result<(), WriteError> {
        let disk = Arc::clone(&self.place.disk);
        let unreadable = io_error(&other.place.path);
        let mut buffer = vec![0; COPY_BYTES];
        let read = |buffer: &mut [u8], at: u64| match disk.read_at(&other.file, buffer, at) {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            result => result,
        };
        while self.length < other.length {
            let wanted = COPY_BYTES.min((other.length - self.length) as usize);
            let count = read(&mut buffer[..wanted], self.length).map_err(&unreadable)?;
            self.write_all(&buffer[..count]).map_err(io_error(&self.place.path))?;
        }
        if self.checksum.clone().finalize() != other.checksum.clone().finalize() {
            return Err(unreadable(io::Error::other("it does not read back as it was written")));
        }
        disk.sync(&self.file).map_err(io_error(&self.place.path))
    }

    /// Gives the file its final name. Fails if a file with that name exists. When this function returns, the file is on disk
    /// under the returned path.
    pub fn publish(&mut self) -> Result<PathBuf, WriteError> {
        let disk = Arc::clone(&self.place.disk);
        disk.sync(&self.file).map_err(io_error(&self.place.path))?;
        self.place.check()?;
        disk.rename(&self.place.path, &self.finished).map_err(exists_or_io(&self.finished))?;
        // `move_to` needs the current path to remove the old file, so the new path is stored at once.
        self.place.path.clone_from(&self.finished);
        sync_parent(&*disk, &self.finished)?;
        self.place.check()?;
        Ok(self.finished.clone())
    }
}

impl RunPlace {
    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether both values are the same file under the same path. Comparing the paths is not enough, because another run or
    /// a copy may have got the path.
    pub fn is_same(&self, other: &Self) -> bool {
        self.path == other.path && self.id == other.id
    }

    /// Checks that the path still leads to the run's file, and returns [`WriteError::Lost`] otherwise.
    pub fn check(&self) -> Result<(), WriteError> {
        match self.disk.id_at(&self.path) {
            Ok(id) if id == self.id => Ok(()),
            Ok(_) => Err(WriteError::Lost(self.path.clone())),
            Err(error) if is_absent(&error) => Err(WriteError::Lost(self.path.clone())),
            Err(error) => Err(io_error(&self.path)(error)),
        }
    }

    /// Adds the path of the file to an error.
    fn named(&self, error: &io::Error) -> io::Error {
        io::Error::new(error.kind(), format!("{}: {error}", self.path.display()))
    }

    /// Removes the file, whose content is not needed.
    pub(super) fn remove(&self) {
        // The caller reports why the file is removed. If the removal fails, too, an unused file remains, which does no harm.
        let _ = self.disk.remove(&self.path);
    }
}

impl RunSync {
    /// Synchronises the file: after the return, all data written before survive a power cut.
    pub fn sync(&self) -> io::Result<()> {
        self.place.disk.sync(&self.file).map_err(|error| self.place.named(&error))
    }
}

/// Endings that show the state of a file. A run's name must not contain them.
const RESERVED_ENDINGS: [&str; 4] = [FINISHED_ENDING, "active", "torn", "recovering"];

fn is_plain(c: char) -> bool {
    c.is_alphanumeric() || "-_.+".contains(c)
}

/// Turns typed text into a valid name for a run. Letters, digits, `-`, `_`, `+` and `.` are kept, other characters become
/// `-`. `None` if the result has no letter or digit.
pub fn run_name(typed: &str) -> Option<String> {
    // Combining characters: some keyboards send accents separately from the letters.
    let is_accent = |c: &char| ('\u{300}'..='\u{36f}').contains(c);
    let mut plain = String::new();
    for c in typed.trim().chars().filter(|c| !is_accent(c)) {
        if is_plain(c) {
            plain.push(c);
        } else if !plain.ends_with('-') {
            plain.push('-');
        }
    }
    while plain.len() > NAME_BYTES_MAX {
        plain.pop();
    }
    let mut name = String::new();
    for (index, part) in plain.trim_end_matches(['.', '-']).split('.').enumerate() {
        let separator = if RESERVED_ENDINGS.contains(&part) { "-" } else { "." };
        name.push_str(if index > 0 { separator } else { "" });
        name.push_str(part);
    }
    let name = name.trim_start_matches(['.', '-']);
    let has_content = name.chars().any(char::is_alphanumeric);
    (has_content && check_name(name).is_ok()).then(|| name.to_owned())
}

/// Refuses a name that is not a plain file name. Also refuses two kinds of names: names that a command line would read as an
/// option, and names that contain one of [`RESERVED_ENDINGS`].
fn check_name(name: &str) -> Result<(), WriteError> {
    let has_ending = name.split('.').skip(1).any(|part| RESERVED_ENDINGS.contains(&part));
    if name.is_empty()
        || name.starts_with(['.', '-'])
        || name.len() > NAME_BYTES_MAX
        || has_ending
        || !name.chars().all(is_plain)
    {
        return Err(WriteError::Name(name.to_owned()));
    }
    Ok(())
}

/// Creates a file under a hidden name, locks it, and only then gives it its name. If the file had its name before it is
/// locked, another process could consider it a file that a crash left behind.
fn create_locked(disk: &dyn Disk, directory: &Path, active: &Path) -> Result<Flock<File>, WriteError> {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let hidden = directory.join(format!(".{}-{number}{UNNAMED_ENDING}", std::process::id()));
    let file = disk.create(&hidden).map_err(io_error(&hidden))?;
    let named = disk.lock(file).map_err(io_error(&hidden)).and_then(|file| {
        disk.rename(&hidden, active).map_err(exists_or_io(active))?;
        Ok(file)
    });
    if named.is_err() {
        // The file is empty and is removed. The caller gets the original error, even if the removal fails, too.
        let _ = disk.remove(&hidden);
    }
    named
}

/// Ending of the temporary name, which a file has until it is locked. The temporary name begins with a dot.
pub(super) const UNNAMED_ENDING: &str = ".new";

/// Renames a file. Fails if a file with the new name exists. When this function returns, the new name survives a power cut.
pub(super) fn rename(disk: &dyn Disk, from: &Path, to: &Path) -> Result<(), WriteError> {
    disk.rename(from, to).map_err(exists_or_io(to))?;
    sync_parent(disk, to)
}

/// Synchronises the directory of `path`, so that the name of the file survives a power cut.
pub(super) fn sync_parent(disk: &dyn Disk, path: &Path) -> Result<(), WriteError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    disk.sync_directory(directory).map_err(io_error(directory))
}

pub(super) fn io_error(path: &Path) -> impl Fn(io::Error) -> WriteError + use<> {
    let path = path.to_owned();
    move |source| WriteError::Io { path: path.clone(), source }
}

fn exists_or_io(path: &Path) -> impl FnOnce(io::Error) -> WriteError + use<> {
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
        let written = self.place.disk.write_at(&self.file, buffer, self.length);
        let count = written.map_err(|error| self.place.named(&error))?;
        self.length += count as u64;
        self.checksum.update(&buffer[..count]);
        Ok(count)
    }

    /// Synchronises the file: after the return, everything written so far survives a power cut.
    fn flush(&mut self) -> io::Result<()> {
        self.synchroniser().sync()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_people_type_becomes_a_name_that_is_accepted() {
        for (typed, name) in [
            ("monday-1", "monday-1"),
            ("Montag 1", "Montag-1"),
            (" Prüfling  7 / links ", "Prüfling-7-links"),
            ("Pru\u{308}fling", "Prufling"),
            ("../../etc/passwd", "etc-passwd"),
            ("a.mcap.active", "a-mcap-active"),
            ("v1.2+b", "v1.2+b"),
            (&"x".repeat(500), &"x".repeat(NAME_BYTES_MAX)),
            (&"ü".repeat(500), &"ü".repeat(NAME_BYTES_MAX / 2)),
        ] {
            assert_eq!(run_name(typed).as_deref(), Some(name), "{typed}");
        }
        for typed in ["", " ", "..", "-", "///", "\u{202e}", "_"] {
            assert_eq!(run_name(typed), None, "{typed:?}");
        }
    }

    #[test]
    fn every_text_becomes_a_name_that_a_file_may_have_or_none() {
        for code in (0..=0x2fff).filter_map(char::from_u32) {
            for typed in [format!("{code}a.{code}mcap"), format!("a.mcap{code}"), format!("a{code}")] {
                if let Some(name) = run_name(&typed) {
                    assert!(check_name(&name).is_ok(), "{typed:?}: {name:?}");
                    assert_eq!(run_name(&name), Some(name));
                }
            }
        }
    }
}
