//! Where the disk enters: every call that a recording in the making puts to it.
//!
//! The methods are the system's own; a test overrides them to refuse, delay or cut short any call.

use std::fmt::Debug;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::Path;

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, Flock, FlockArg, RenameFlags, renameat2};
use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access};

/// Device and inode: which file it is, whatever its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileId {
    device: u64,
    inode: u64,
}

/// What a file system has left.
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

    /// Locks a file against every other process; `WouldBlock` where one has it.
    fn lock(&self, file: File) -> io::Result<Flock<File>> {
        Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, error)| error.into())
    }

    /// Renames without replacing.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        match renameat2(AT_FDCWD, from, AT_FDCWD, to, RenameFlags::RENAME_NOREPLACE) {
            // Some file systems know no such rename; the name was free when the run began.
            Err(Errno::EINVAL | Errno::ENOSYS) if !to.exists() => std::fs::rename(from, to),
            result => result.map_err(io::Error::from),
        }
    }

    /// Removes a file.
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

    /// Which file an open one is.
    fn id_of(&self, file: &File) -> io::Result<FileId> {
        file.metadata().map(|found| FileId { device: found.dev(), inode: found.ino() })
    }

    /// Which file has this name.
    fn id_at(&self, path: &Path) -> io::Result<FileId> {
        std::fs::metadata(path).map(|found| FileId { device: found.dev(), inode: found.ino() })
    }

    /// What is left where a directory is or will be.
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

/// The system's disk.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemDisk;

impl Disk for SystemDisk {}
