//! A disk in memory. It loses data that were not synchronised, and fails on request.

use std::cell::RefCell;
use std::io::{self, Seek, SeekFrom, Write};
use std::rc::Rc;

/// All written bytes, and which of them were synchronised.
#[derive(Debug, Default)]
pub struct Disk {
    /// The file as the writing program sees it.
    pub bytes: Vec<u8>,
    /// Length of the file at each synchronisation \[bytes\].
    pub synced: Vec<usize>,
    /// Begin and end of each unsynchronised write \[bytes\].
    pub unsynced: Vec<(usize, usize)>,
    /// Length of the file beyond which writes are refused \[bytes\].
    pub capacity: Option<usize>,
    /// Length \[bytes\]. The first write that crosses it is refused, later ones are not.
    pub refuse_once_at: Option<usize>,
    /// Largest number of bytes that a single write accepts.
    pub at_once: Option<usize>,
    /// Error number of a refused write.
    pub errno: i32,
    /// Number of synchronisations that still succeed.
    pub syncs_left: Option<usize>,
}

/// The file on such a disk. Clones share the file.
#[derive(Debug, Clone, Default)]
pub struct DiskFile(pub Rc<RefCell<Disk>>);

impl DiskFile {
    /// A disk that refuses writes beyond `capacity` bytes with `errno`.
    pub fn full_at(capacity: usize, errno: i32) -> Self {
        Self(Rc::new(RefCell::new(Disk { capacity: Some(capacity), errno, ..Disk::default() })))
    }

    /// A disk that refuses the write across byte `offset` with `errno` once, and accepts all others.
    pub fn refusing_once_at(offset: usize, errno: i32) -> Self {
        Self(Rc::new(RefCell::new(Disk { refuse_once_at: Some(offset), errno, ..Disk::default() })))
    }

    /// A disk that accepts at most `bytes` bytes with each write.
    pub fn taking_at_most(bytes: usize) -> Self {
        Self(Rc::new(RefCell::new(Disk { at_once: Some(bytes), ..Disk::default() })))
    }

    /// A disk on which `syncs` synchronisations succeed and all later ones fail.
    pub fn failing_after(syncs: usize, errno: i32) -> Self {
        Self(Rc::new(RefCell::new(Disk { syncs_left: Some(syncs), errno, ..Disk::default() })))
    }

    /// Current content of the disk.
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
        // A recording is only ever appended to, so no other position is needed.
        match position {
            SeekFrom::Current(0) | SeekFrom::End(0) => Ok(self.0.borrow().bytes.len() as u64),
            other => Err(io::Error::other(format!("a recording must not seek: {other:?}"))),
        }
    }
}
