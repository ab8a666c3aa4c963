//! Every call to the disk for recordings, their recovery and lists, claims, reference marks and the log.
//!
//! The methods are the system's own; a test overrides them to refuse, delay or cut short any call.

use std::fmt::{self, Debug};
use std::fs::{File, Metadata, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::fd::BorrowedFd;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, Flock, FlockArg, RenameFlags, renameat2};
use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access, write};

/// Device, inode and time of creation: which file it is, whatever its name. The time is needed because a new file may get the
/// inode of a removed one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileId {
    device: u64,
    inode: u64,
    /// `None` if the file system does not record it.
    made: Option<SystemTime>,
}

impl From<Metadata> for FileId {
    fn from(found: Metadata) -> Self {
        Self { device: found.dev(), inode: found.ino(), made: found.created().ok() }
    }
}

impl fmt::Display for FileId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let made = self.made.and_then(|made| made.duration_since(UNIX_EPOCH).ok());
        write!(formatter, "{}:{}:{}", self.device, self.inode, made.map_or(0, |made| made.as_nanos()))
    }
}

/// Free space of a file system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Space {
    /// Bytes that this user may still write.
    pub free_bytes: u64,
    /// The directory takes files: it is one, this user may, and its file system is not read-only.
    pub is_writable: bool,
}

/// The disk, call by call. Each may block for as long as the disk likes.
pub trait Disk: Debug + Send + Sync {
    /// Makes a directory and those above it; one that is there is fine.
    fn make_directory(&self, directory: &Path) -> io::Result<()> {
        std::fs::create_dir_all(directory)
    }

    /// A new file, empty.
    fn create(&self, path: &Path) -> io::Result<File> {
        OpenOptions::new().read(true).write(true).create(true).truncate(true).open(path)
    }

    /// A file that is there, for reading.
    fn open(&self, path: &Path) -> io::Result<File> {
        File::open(path)
    }

    /// What is in a directory, in no order.
    fn list(&self, directory: &Path) -> io::Result<Vec<PathBuf>> {
        std::fs::read_dir(directory)?.map(|entry| Ok(entry?.path())).collect()
    }

    /// Locks a file against every other process; `WouldBlock` if one has locked it.
    fn lock(&self, file: File) -> io::Result<Flock<File>> {
        Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, error)| error.into())
    }

    /// Whether another process has locked the file with [`lock`](Self::lock). Any number of processes may test it at a time.
    fn is_locked(&self, file: File) -> io::Result<bool> {
        match Flock::lock(file, FlockArg::LockSharedNonblock) {
            Ok(_) => Ok(false),
            Err((_, Errno::EWOULDBLOCK)) => Ok(true),
            Err((_, error)) => Err(error.into()),
        }
    }

    /// Renames without replacing another file.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        match renameat2(AT_FDCWD, from, AT_FDCWD, to, RenameFlags::RENAME_NOREPLACE) {
            // Some file systems lack such a rename; the name was free when the run began.
            Err(Errno::EINVAL | Errno::ENOSYS) if !to.exists() => std::fs::rename(from, to),
            result => result.map_err(io::Error::from),
        }
    }

    /// Renames and replaces a file of that name.
    fn replace(&self, from: &Path, to: &Path) -> io::Result<()> {
        std::fs::rename(from, to)
    }

    /// Gives a file a second name, which no other may have.
    fn link(&self, path: &Path, name: &Path) -> io::Result<()> {
        std::fs::hard_link(path, name)
    }

    /// Removes a file from its directory.
    fn remove(&self, path: &Path) -> io::Result<()> {
        std::fs::remove_file(path)
    }

    /// Returns when names in the directory survive a power cut.
    fn sync_directory(&self, directory: &Path) -> io::Result<()> {
        let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
        File::open(directory)?.sync_all()
    }

    /// Writes at a place of the file; how many bytes it took.
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
        file.write_at(bytes, offset)
    }

    /// Reads from a place of the file; how many bytes it gave.
    fn read_at(&self, file: &File, buffer: &mut [u8], offset: u64) -> io::Result<usize> {
        file.read_at(buffer, offset)
    }

    /// Returns when what was written before survives a power cut.
    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_data()
    }

    /// Length of an open file \[bytes\].
    fn length(&self, file: &File) -> io::Result<u64> {
        file.metadata().map(|found| found.len())
    }

    /// Appends to a stream, such as the log's; how many bytes it took.
    fn append(&self, stream: BorrowedFd<'_>, bytes: &[u8]) -> io::Result<usize> {
        Ok(write(stream, bytes)?)
    }

    /// Which file an open one is.
    fn id_of(&self, file: &File) -> io::Result<FileId> {
        file.metadata().map(FileId::from)
    }

    /// Which file has this name.
    fn id_at(&self, path: &Path) -> io::Result<FileId> {
        std::fs::metadata(path).map(FileId::from)
    }

    /// Whether anything has this name.
    fn has(&self, path: &Path) -> io::Result<bool> {
        match self.id_at(path) {
            Ok(_) => Ok(true),
            Err(error) if is_absent(&error) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Free space at a directory that exists or will be created.
    fn space(&self, directory: &Path) -> io::Result<Space> {
        // One that is not there yet will be made on the file system of the nearest one that is.
        let existing = directory.ancestors().find(|path| path.exists()).unwrap_or(Path::new("."));
        let existing = if existing.as_os_str().is_empty() { Path::new(".") } else { existing };
        let system = statvfs(existing)?;
        Ok(Space {
            free_bytes: system.blocks_available() as u64 * system.fragment_size() as u64,
            is_writable: existing.is_dir() && access(existing, AccessFlags::W_OK).is_ok(),
        })
    }
}

/// Whether an error means that the file does not exist.
pub fn is_absent(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}

/// An open file from its beginning, each call through its disk.
#[derive(Debug)]
pub struct OpenFile<'a> {
    disk: &'a dyn Disk,
    file: &'a File,
    position: u64,
}

impl<'a> OpenFile<'a> {
    /// An open file at its beginning.
    pub fn new(disk: &'a dyn Disk, file: &'a File) -> Self {
        Self { disk, file, position: 0 }
    }
}

impl Read for OpenFile<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.disk.read_at(self.file, buffer, self.position)?;
        self.position += count as u64;
        Ok(count)
    }
}

impl Write for OpenFile<'_> {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        let count = self.disk.write_at(self.file, buffer, self.position)?;
        self.position += count as u64;
        Ok(count)
    }

    /// Returns when everything written so far survives a power cut.
    fn flush(&mut self) -> io::Result<()> {
        self.disk.sync(self.file)
    }
}

impl Seek for OpenFile<'_> {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        let (from, by) = match position {
            SeekFrom::Start(start) => (start, 0),
            SeekFrom::Current(by) => (self.position, by),
            SeekFrom::End(by) => (self.disk.length(self.file)?, by),
        };
        self.position = from.checked_add_signed(by).ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.position)
    }
}

/// The system's disk.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemDisk;

impl Disk for SystemDisk {}
