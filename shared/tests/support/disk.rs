//! A disk in memory that forgets what was not synchronised, and fails on request.

use std::cell::RefCell;
use std::io::{self, Seek, SeekFrom, Write};
use std::rc::Rc;

/// Everything that was written, and what of it was synchronised.
#[derive(Debug, Default)]
pub struct Disk {
    /// The file as the writing program sees it.
    pub bytes: Vec<u8>,
    /// Length at each synchronisation.
    pub synced: Vec<usize>,
    /// Where each write that is not synchronised yet begins and ends.
    pub unsynced: Vec<(usize, usize)>,
    /// Writes beyond this length are refused.
    pub capacity: Option<usize>,
    /// The write that crosses this length is refused, once.
    pub refuse_once_at: Option<usize>,
    /// Most bytes that one write takes.
    pub at_once: Option<usize>,
    /// The error that refusing gives.
    pub errno: i32,
    /// Synchronisations that still succeed.
    pub syncs_left: Option<usize>,
}

/// The file on that disk. Clones are the same file.
#[derive(Debug, Clone, Default)]
pub struct DiskFile(pub Rc<RefCell<Disk>>);

impl DiskFile {
    /// A disk that refuses with `errno` what does not fit into `capacity` bytes.
    pub fn full_at(capacity: usize, errno: i32) -> Self {
        Self(Rc::new(RefCell::new(Disk { capacity: Some(capacity), errno, ..Disk::default() })))
    }

    /// A disk that takes what comes before byte `offset`, refuses with `errno` once, and takes everything again.
    pub fn refusing_once_at(offset: usize, errno: i32) -> Self {
        Self(Rc::new(RefCell::new(Disk { refuse_once_at: Some(offset), errno, ..Disk::default() })))
    }

    /// A disk that takes at most `bytes` with each write.
    pub fn taking_at_most(bytes: usize) -> Self {
        Self(Rc::new(RefCell::new(Disk { at_once: Some(bytes), ..Disk::default() })))
    }

    /// A disk whose synchronisation fails for good after `syncs` of them.
    pub fn failing_after(syncs: usize, errno: i32) -> Self {
        Self(Rc::new(RefCell::new(Disk { syncs_left: Some(syncs), errno, ..Disk::default() })))
    }

    /// What is on the disk now.
    pub fn bytes(&self) -> Vec<u8> {
        self.0.borrow().bytes.clone()
    }
}

impl Write for DiskFile {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        let mut disk = self.0.borrow_mut();
        let begin = disk.bytes.len();
        let limits = [disk.capacity, disk.refuse_once_at].into_iter().flatten();
        let room = limits.map(|limit| limit.saturating_sub(begin)).min().unwrap_or(usize::MAX);
        if room == 0 && !buffer.is_empty() {
            disk.refuse_once_at = None;
            return Err(io::Error::from_raw_os_error(disk.errno));
        }
        let room = room.min(disk.at_once.unwrap_or(usize::MAX));
        let taken = &buffer[..room.min(buffer.len())];
        disk.bytes.extend_from_slice(taken);
        disk.unsynced.push((begin, begin + taken.len()));
        Ok(taken.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let mut disk = self.0.borrow_mut();
        if disk.syncs_left == Some(0) {
            return Err(io::Error::from_raw_os_error(disk.errno));
        }
        disk.syncs_left = disk.syncs_left.map(|left| left - 1);
        let length = disk.bytes.len();
        disk.synced.push(length);
        disk.unsynced.clear();
        Ok(())
    }
}

impl Seek for DiskFile {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        // A recording is appended to, never patched.
        match position {
            SeekFrom::Current(0) | SeekFrom::End(0) => Ok(self.0.borrow().bytes.len() as u64),
            other => Err(io::Error::other(format!("a recording must not seek: {other:?}"))),
        }
    }
}
