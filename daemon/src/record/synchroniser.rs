//! Synchronises the run's file with the disk (fsync) in a thread of its own, while the recorder continues to
//! write. The outcome is reported to [`RunProgress`], in which only synchronised data count as safe. An error is
//! also returned to the recorder.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::time::Duration;

use shared::recording::RunSync;
use shared::time::MonoNs;

use super::progress::{RunProgress, Synced};
use crate::scheduler::{Died, Scheduler, Stepper, received};

/// Longest time for which a recorder that ends waits for a synchronisation in progress.
const RELEASE_TIMEOUT: Duration = Duration::from_secs(1);

/// The side of the recorder. It requests one synchronisation at a time.
pub(super) struct Synchroniser {
    /// Each job is a file, and the extent of the file that the synchronisation covers.
    jobs: SyncSender<(RunSync, Synced)>,
    outcomes: Receiver<io::Result<()>>,
    is_busy: bool,
    /// Whether the recorder waits for the last synchronisation when it ends. On virtual time it does not wait, because the
    /// synchronisation could not proceed in the meantime.
    waits: bool,
}

/// The side that waits for the disk. It ends when the recorder drops its side.
struct SyncWork {
    jobs: Receiver<(RunSync, Synced)>,
    outcomes: SyncSender<io::Result<()>>,
    progress: Arc<RunProgress>,
    /// Number that distinguishes this synchroniser from those before a move of the run, which may hang.
    number: u32,
    /// The job that [`Stepper::wait`] has received.
    next: Option<(RunSync, Synced)>,
}

/// Period in which a loop on virtual time polls for jobs. A thread blocks until it receives one.
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
        // Release this handle before the recorder gets the outcome. Otherwise the file would stay locked when the
        // recorder releases its own handle.
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

    /// Takes the outcome of the last synchronisation if it has finished. Returns its error if it failed. After
    /// that, another synchronisation can begin.
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
    /// Waits for a synchronisation in progress, which keeps the file locked, so that the file can be recovered. Does not
    /// wait long if the disk hangs.
    fn drop(&mut self) {
        if self.is_busy && self.waits {
            let _ = self.outcomes.recv_timeout(RELEASE_TIMEOUT);
        }
    }
}
