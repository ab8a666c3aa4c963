//! All calls to the disk go through this module: for recordings, their recovery and lists, claims of directories, reference
//! marks and the log.
//!
//! The default methods of [`Disk`] call the operating system. Tests override them, so that a call fails, is delayed or
//! writes only some of its bytes.

use std::fmt::{self, Debug};
use std::fs::{File, Metadata, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::fd::BorrowedFd;
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, Flock, FlockArg, RenameFlags, renameat2};
use nix::libc::O_NOFOLLOW;
use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access, write};

/// Identifies a file independently of its name: by device, inode and time of creation. The time is needed because a new file
/// may get the inode of a removed file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileId {
    device: u64,
    inode: u64,
    /// Time of creation. `None` if the file system does not record it.
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
    /// Whether files can be created there. This requires that the path is a directory, that this user may write there, and
    /// that the file system is not read-only.
    pub is_writable: bool,
}

/// Operations on a disk. Each call may block for any time.
pub trait Disk: Debug + Send + Sync {
    /// Creates a directory and its missing parents. Succeeds if the directory exists.
    fn make_directory(&self, directory: &Path) -> io::Result<()> {
        std::fs::create_dir_all(directory)
    }

    /// Opens a new file for reading and writing. An existing file is emptied. Fails if the name is a symbolic link: in a
    /// directory of another user, the link could lead to any file.
    fn create(&self, path: &Path) -> io::Result<File> {
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(true).custom_flags(O_NOFOLLOW).open(path)
    }

    /// Opens an existing file for reading.
    fn open(&self, path: &Path) -> io::Result<File> {
        File::open(path)
    }

    /// Opens an existing file to lock it. The file is opened for reading and writing, because NFS refuses the lock otherwise. If
    /// this user may not write it, it is opened for reading.
    fn open_to_lock(&self, path: &Path) -> io::Result<File> {
        OpenOptions::new().read(true).write(true).open(path).or_else(|_| self.open(path))
    }

    /// Paths of the entries of a directory, in no particular order.
    fn list(&self, directory: &Path) -> io::Result<Vec<PathBuf>> {
        std::fs::read_dir(directory)?.map(|entry| Ok(entry?.path())).collect()
    }

    /// Locks a file exclusively. Fails with `WouldBlock` if another process has locked it.
    fn lock(&self, file: File) -> io::Result<Flock<File>> {
        Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, error)| error.into())
    }

    /// Whether another process has locked the file with [`lock`](Self::lock). Several processes may check
    /// this at the same time.
    fn is_locked(&self, file: File) -> io::Result<bool> {
        match Flock::lock(file, FlockArg::LockSharedNonblock) {
            Ok(_) => Ok(false),
            Err((_, Errno::EWOULDBLOCK)) => Ok(true),
            Err((_, error)) => Err(error.into()),
        }
    }

    /// Renames a file. Fails if a file with the new name exists.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        match renameat2(AT_FDCWD, from, AT_FDCWD, to, RenameFlags::RENAME_NOREPLACE) {
            // Some file systems do not support the flag that forbids replacement. In this case the name is checked just
            // before the rename. The name was free when the run began.
            Err(Errno::EINVAL | Errno::ENOSYS) if !to.exists() => std::fs::rename(from, to),
            result => result.map_err(io::Error::from),
        }
    }

    /// Renames a file. An existing file with the new name is replaced.
    fn replace(&self, from: &Path, to: &Path) -> io::Result<()> {
        std::fs::rename(from, to)
    }

    /// Adds a second name to a file. Fails if a file with that name exists.
    fn link(&self, path: &Path, name: &Path) -> io::Result<()> {
        std::fs::hard_link(path, name)
    }

    /// Removes a file from its directory.
    fn remove(&self, path: &Path) -> io::Result<()> {
        std::fs::remove_file(path)
    }

    /// Synchronises a directory: after the return, the names in it survive a power cut.
    fn sync_directory(&self, directory: &Path) -> io::Result<()> {
        let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
        File::open(directory)?.sync_all()
    }

    /// Writes at an offset in the file. Returns the number of bytes that were written, which may be smaller than requested.
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
        file.write_at(bytes, offset)
    }

    /// Reads from an offset in the file. Returns the number of bytes that were read, 0 at the end of the file.
    fn read_at(&self, file: &File, buffer: &mut [u8], offset: u64) -> io::Result<usize> {
        file.read_at(buffer, offset)
    }

    /// Synchronises a file: after the return, all data written before survive a power cut.
    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_data()
    }

    /// Length of an open file \[bytes\].
    fn length(&self, file: &File) -> io::Result<u64> {
        file.metadata().map(|found| found.len())
    }

    /// Appends to a stream, such as the output of the log. Returns the number of bytes that were written.
    fn append(&self, stream: BorrowedFd<'_>, bytes: &[u8]) -> io::Result<usize> {
        Ok(write(stream, bytes)?)
    }

    /// Identity of an open file.
    fn id_of(&self, file: &File) -> io::Result<FileId> {
        file.metadata().map(FileId::from)
    }

    /// Identity of the file with this name.
    fn id_at(&self, path: &Path) -> io::Result<FileId> {
        std::fs::metadata(path).map(FileId::from)
    }

    /// Whether a file or directory with this name exists.
    fn has(&self, path: &Path) -> io::Result<bool> {
        match self.id_at(path) {
            Ok(_) => Ok(true),
            Err(error) if is_absent(&error) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Free space of the file system of a directory. The directory may be missing if it will be created later.
    fn space(&self, directory: &Path) -> io::Result<Space> {
        // A missing directory will be created on the file system of its nearest parent that exists.
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

/// Reads and writes an open file sequentially from its beginning. All calls go through a [`Disk`].
#[derive(Debug)]
pub struct OpenFile<'a> {
    disk: &'a dyn Disk,
    file: &'a File,
    position: u64,
}

impl<'a> OpenFile<'a> {
    /// Starts at the beginning of an open file.
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

    /// Synchronises the file: after the return, everything written so far survives a power cut.
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

/// The disk of the operating system.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemDisk;

impl Disk for SystemDisk {}
