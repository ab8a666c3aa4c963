//! Synchronises the file of a run with the disk (fsync). This takes place in a separate thread, while the recorder continues
//! to write. The outcome is reported to [`RunProgress`], which counts only synchronised data as safe. The recorder also
//! receives the error, if there is one.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::time::Duration;

use shared::recording::RunSync;
use shared::time::MonoNs;

use super::progress::{RunProgress, Synced};
use crate::scheduler::{Died, Scheduler, Stepper, received};

/// When the recorder ends, it waits at most this long for a synchronisation in progress.
const RELEASE_TIMEOUT: Duration = Duration::from_secs(1);

/// The recorder's side. The recorder requests one synchronisation at a time.
pub(super) struct Synchroniser {
    /// Each job consists of a file, and of the content of the file that the synchronisation makes safe.
    jobs: SyncSender<(RunSync, Synced)>,
    outcomes: Receiver<io::Result<()>>,
    is_busy: bool,
    /// Whether the recorder waits for a synchronisation in progress when it ends. In virtual time it does not wait, because
    /// the synchronisation cannot proceed while the recorder waits.
    waits: bool,
}

/// The side that waits for the disk. It ends when the recorder drops the other side.
struct SyncWork {
    jobs: Receiver<(RunSync, Synced)>,
    outcomes: SyncSender<io::Result<()>>,
    progress: Arc<RunProgress>,
    /// Number of this synchroniser. It differs from that of earlier synchronisers of the same run, which may
    /// still hang after a move.
    number: u32,
    /// The job that [`Stepper::wait`] has received.
    next: Option<(RunSync, Synced)>,
}

/// In virtual time, a loop polls for jobs with this period. In real time, the thread blocks until it receives a job.
const POLL_PERIOD: Duration = Duration::from_millis(1);

impl Stepper for SyncWork {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        let is_needed = match self.next.take().map_or_else(|| self.jobs.try_recv(), Ok) {
            Ok((file, covers)) => self.synchronise(file, covers),
            Err(TryRecvError::Empty) => true,
            Err(TryRecvError::Disconnected) => false,
        };
        is_needed.then_some(POLL_PERIOD)
    }

    fn wait(&mut self, _: Duration) {
        self.next = self.jobs.recv().ok();
    }
}

impl SyncWork {
    /// Synchronises a file and reports the outcome. Returns whether the recorder still exists.
    fn synchronise(&self, file: RunSync, covers: Synced) -> bool {
        self.progress.syncing(self.number);
        let synced = file.sync();
        self.progress.synced(self.number, synced.is_ok().then_some(covers));
        // This handle is released before the recorder receives the outcome. Otherwise the file would still be locked after
        // the recorder has released its own handle.
        drop(file);
        self.outcomes.send(synced).is_ok()
    }
}

impl Synchroniser {
    /// A synchroniser with its own thread. If the thread cannot be started, each synchronisation fails.
    pub fn new(progress: &Arc<RunProgress>, scheduler: &dyn Scheduler) -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let (jobs, jobs_out) = sync_channel(1);
        let (outcomes_in, outcomes) = sync_channel(1);
        let progress = Arc::clone(progress);
        let waits = progress.clock.is_real();
        let work = SyncWork { jobs: jobs_out, outcomes: outcomes_in, progress, number, next: None };
        let _ = scheduler.start("synchroniser", Box::new(|| Box::new(work)));
        Self { jobs, outcomes, is_busy: false, waits }
    }

    /// Begins to synchronise `file`, unless the previous synchronisation is still running.
    pub fn begin(&mut self, file: RunSync, covers: Synced) {
        if !self.is_busy {
            self.is_busy = true;
            let _ = self.jobs.send((file, covers));
        }
    }

    /// Whether a synchronisation is in progress, or its outcome was not taken yet.
    pub fn is_busy(&self) -> bool {
        self.is_busy
    }

    /// Takes the outcome of the last synchronisation if it has finished. Returns the error if it failed. Afterwards
    /// the next synchronisation can begin.
    pub fn problem(&mut self) -> Option<io::Error> {
        if !self.is_busy {
            return None;
        }
        let outcome = received(&self.outcomes)?;
        self.is_busy = false;
        outcome.unwrap_or_else(|Died| Err(io::Error::other("no thread to synchronise the file"))).err()
    }
}

impl Drop for Synchroniser {
    /// Waits for a synchronisation in progress, because it keeps the file locked, and a locked file cannot be recovered. If
    /// the disk hangs, the wait ends after a time-out.
    fn drop(&mut self) {
        if self.is_busy && self.waits {
            let _ = self.outcomes.recv_timeout(RELEASE_TIMEOUT);
        }
    }
}
