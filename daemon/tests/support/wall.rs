//! A disk that injects a fault into one call. For each file, it counts the bytes that would survive a power cut.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::File;
use std::io;
use std::os::fd::BorrowedFd;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use nix::fcntl::Flock;
use shared::recording::{Disk, FileId, Space, SystemDisk};
use shared::time::MonoNs;

use super::world::{World, pass};

/// Identifies a call of the `Disk` trait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Call {
    MakeDirectory,
    Create,
    Open,
    List,
    Lock,
    Rename,
    Replace,
    Link,
    Remove,
    SyncDirectory,
    Write,
    Read,
    Sync,
    Length,
    IdOf,
    IdAt,
    Space,
    Append,
}

impl Call {
    /// Whether the call still succeeds on a disk that has failed, because its data are in memory.
    fn asks_only(self) -> bool {
        use Call::{IdAt, IdOf, Length, List, Open, Read, Space};
        matches!(self, Open | List | Read | Length | IdAt | IdOf | Space)
    }

    /// Whether the call transfers bytes.
    pub fn moves_bytes(self) -> bool {
        matches!(self, Self::Write | Self::Read | Self::Append)
    }
}

/// Effect of a fault on the call into which it is injected, and on later calls.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Refuses only this call.
    Fails,
    /// Refuses this call, and all later calls in the directory of the run.
    Dies,
    /// Refuses this call, and all later calls.
    DiesEverywhere,
    /// Delays only this call. In real time, [`Wall::release`] ends the delay early.
    Hangs(Duration),
    /// Transfers a single byte in this call.
    CutsShort,
}

/// A simulated disk with one fault. Files are stored on the real disk.
#[derive(Debug)]
pub struct Wall {
    /// Duration by which each synchronisation takes longer than on the real disk.
    sync_takes: Duration,
    /// The directory of the run. [`Fault::Dies`] affects only this directory.
    home: PathBuf,
    state: Mutex<State>,
    released: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// The fault, with the kind of its call and the number of this call among the calls of this kind, from 0.
    fault: Option<(Call, usize, Fault)>,
    calls: BTreeMap<Call, usize>,
    /// Number of bytes that were written, by inode. The next field counts only the bytes that were written
    /// before a completed synchronisation started.
    written: HashMap<u64, u64>,
    synced: HashMap<u64, u64>,
    /// Inodes of files of which a synchronisation has failed.
    failed: HashSet<u64>,
    inodes: HashMap<u64, bool>,
    is_dead: bool,
    is_released: bool,
    struck: Option<Instant>,
    /// Virtual time at which the fault occurred. The field `struck` is the real time.
    struck_at: Option<MonoNs>,
}

/// Number of bytes that a call may transfer.
enum Permit {
    All,
    OneByte,
}

impl Wall {
    pub fn new(home: &Path, fault: Option<(Call, usize, Fault)>) -> Self {
        let state = Mutex::new(State { fault, ..State::default() });
        Self { sync_takes: Duration::ZERO, home: home.to_owned(), state, released: Condvar::new() }
    }

    /// A disk without faults. Each synchronisation takes the additional time `sync_takes`.
    pub fn slow(home: &Path, sync_takes: Duration) -> Self {
        Self { sync_takes, ..Self::new(home, None) }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }

    /// Number of calls of each kind up to now.
    pub fn calls(&self) -> BTreeMap<Call, usize> {
        self.state().calls.clone()
    }

    /// Injects this fault into the next call of this kind. An earlier fault is replaced.
    pub fn strike_next(&self, call: Call, fault: Fault) {
        let mut state = self.state();
        let nth = state.calls.get(&call).copied().unwrap_or(0);
        (state.fault, state.struck, state.is_released) = (Some((call, nth, fault)), None, false);
    }

    /// Ends a hang in real time.
    pub fn release(&self) {
        self.state().is_released = true;
        self.released.notify_all();
    }

    /// Real time at which the fault occurred. `None` if it has not occurred.
    pub fn struck(&self) -> Option<Instant> {
        self.state().struck
    }

    /// Virtual time at which the fault occurred. `None` if it has not occurred.
    pub fn struck_at(&self) -> Option<MonoNs> {
        self.state().struck_at
    }

    /// Number of bytes of a file that would survive a power cut now.
    pub fn synced_bytes(&self, inode: u64) -> u64 {
        self.state().synced.get(&inode).copied().unwrap_or(0)
    }

    fn enter(&self, call: Call, is_home: bool) -> io::Result<Permit> {
        let mut state = self.state();
        let count = state.calls.entry(call).or_default();
        let number = *count;
        *count += 1;
        let refusal = || Err(io::Error::from_raw_os_error(nix::libc::EIO));
        let Some((at, nth, fault)) = state.fault else { return Ok(Permit::All) };
        let strikes = call == at && number == nth;
        if strikes {
            state.struck = Some(Instant::now());
            state.struck_at = World::here().map(|world| world.clock.now());
        }
        match fault {
            Fault::Dies | Fault::DiesEverywhere => {
                state.is_dead |= strikes;
                let is_hit = state.is_dead && (is_home || fault == Fault::DiesEverywhere);
                if strikes || (is_hit && !call.asks_only()) { refusal() } else { Ok(Permit::All) }
            }
            _ if !strikes => Ok(Permit::All),
            Fault::Fails => refusal(),
            Fault::CutsShort => Ok(Permit::OneByte),
            Fault::Hangs(time) => {
                if World::here().is_some() {
                    drop(state);
                    pass(time);
                } else {
                    let is_held = |state: &mut State| !state.is_released;
                    drop(self.released.wait_timeout_while(state, time, is_held).unwrap());
                }
                Ok(Permit::All)
            }
        }
    }

    fn at(&self, call: Call, path: &Path) -> io::Result<Permit> {
        self.enter(call, path.starts_with(&self.home))
    }

    fn on(&self, call: Call, file: &File) -> io::Result<Permit> {
        let is_home = file.metadata().is_ok_and(|found| self.state().inodes.get(&found.ino()) == Some(&true));
        self.enter(call, is_home)
    }
}

fn allowed(permit: &Permit, bytes: usize) -> usize {
    match permit {
        Permit::All => bytes,
        Permit::OneByte => bytes.min(1),
    }
}

impl Disk for Wall {
    fn make_directory(&self, directory: &Path) -> io::Result<()> {
        self.at(Call::MakeDirectory, directory)?;
        SystemDisk.make_directory(directory)
    }

    fn create(&self, path: &Path) -> io::Result<File> {
        self.at(Call::Create, path)?;
        let file = SystemDisk.create(path)?;
        let inode = file.metadata()?.ino();
        let mut state = self.state();
        state.inodes.insert(inode, path.starts_with(&self.home));
        // The file may have the inode of a removed file.
        state.written.remove(&inode);
        state.synced.remove(&inode);
        state.failed.remove(&inode);
        Ok(file)
    }

    fn open(&self, path: &Path) -> io::Result<File> {
        self.at(Call::Open, path)?;
        let file = SystemDisk.open(path)?;
        self.state().inodes.insert(file.metadata()?.ino(), path.starts_with(&self.home));
        Ok(file)
    }

    fn open_to_lock(&self, path: &Path) -> io::Result<File> {
        self.at(Call::Open, path)?;
        let file = SystemDisk.open_to_lock(path)?;
        self.state().inodes.insert(file.metadata()?.ino(), path.starts_with(&self.home));
        Ok(file)
    }

    fn list(&self, directory: &Path) -> io::Result<Vec<PathBuf>> {
        self.at(Call::List, directory)?;
        SystemDisk.list(directory)
    }

    fn replace(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.at(Call::Replace, to)?;
        SystemDisk.replace(from, to)
    }

    fn link(&self, path: &Path, name: &Path) -> io::Result<()> {
        self.at(Call::Link, name)?;
        SystemDisk.link(path, name)
    }

    fn length(&self, file: &File) -> io::Result<u64> {
        self.on(Call::Length, file)?;
        SystemDisk.length(file)
    }

    fn append(&self, stream: BorrowedFd<'_>, bytes: &[u8]) -> io::Result<usize> {
        let permit = self.enter(Call::Append, false)?;
        SystemDisk.append(stream, &bytes[..allowed(&permit, bytes.len())])
    }

    fn lock(&self, file: File) -> io::Result<Flock<File>> {
        self.on(Call::Lock, &file)?;
        SystemDisk.lock(file)
    }

    fn is_locked(&self, file: File) -> io::Result<bool> {
        self.on(Call::Lock, &file)?;
        SystemDisk.is_locked(file)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.at(Call::Rename, to)?;
        SystemDisk.rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.at(Call::Remove, path)?;
        SystemDisk.remove(path)
    }

    fn sync_directory(&self, directory: &Path) -> io::Result<()> {
        self.at(Call::SyncDirectory, directory)?;
        SystemDisk.sync_directory(directory)
    }

    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
        let permit = self.on(Call::Write, file)?;
        let count = file.write_at(&bytes[..allowed(&permit, bytes.len())], offset)?;
        self.state().written.insert(file.metadata()?.ino(), offset + count as u64);
        Ok(count)
    }

    fn read_at(&self, file: &File, buffer: &mut [u8], offset: u64) -> io::Result<usize> {
        let permit = self.on(Call::Read, file)?;
        let length = allowed(&permit, buffer.len());
        file.read_at(&mut buffer[..length], offset)
    }

    /// Data that are written during a synchronisation are not covered by it. After a synchronisation has failed, later ones
    /// succeed but cover no further data of the file, because Linux reports a failed write only once.
    fn sync(&self, file: &File) -> io::Result<()> {
        let inode = file.metadata()?.ino();
        let covered = self.state().written.get(&inode).copied().unwrap_or(0);
        if let Err(error) = self.on(Call::Sync, file) {
            self.state().failed.insert(inode);
            return Err(error);
        }
        pass(self.sync_takes);
        let mut state = self.state();
        if state.failed.contains(&inode) {
            return Ok(());
        }
        let synced = state.synced.entry(inode).or_default();
        *synced = covered.max(*synced);
        Ok(())
    }

    fn id_of(&self, file: &File) -> io::Result<FileId> {
        self.on(Call::IdOf, file)?;
        SystemDisk.id_of(file)
    }

    fn id_at(&self, path: &Path) -> io::Result<FileId> {
        self.at(Call::IdAt, path)?;
        SystemDisk.id_at(path)
    }

    fn space(&self, directory: &Path) -> io::Result<Space> {
        self.at(Call::Space, directory)?;
        SystemDisk.space(directory)
    }
}
