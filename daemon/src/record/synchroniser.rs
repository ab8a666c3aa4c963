//! Synchronises the run's file with the disk (fsync) in a thread of its own, while the recorder writes more. The outcome goes
//! to [`RunProgress`], which reports as safe only what is synchronised; a failure goes to the recorder.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::time::Duration;

use shared::recording::RunSync;
use shared::time::MonoNs;

use super::progress::{RunProgress, Synced};
use crate::scheduler::{Died, Scheduler, Stepper, received};

/// How long a recorder that ends waits for a current synchronisation.
const RELEASE_TIMEOUT: Duration = Duration::from_secs(1);

/// The recorder's side: one synchronisation at a time.
pub(super) struct Synchroniser {
    /// The file, and the extent of it that a synchronisation covers.
    jobs: SyncSender<(RunSync, Synced)>,
    outcomes: Receiver<io::Result<()>>,
    is_busy: bool,
    /// The recorder waits for the last synchronisation: not on virtual time, where no other work would proceed.
    waits: bool,
}

/// The side that waits for the disk. It ends with the recorder.
struct SyncWork {
    jobs: Receiver<(RunSync, Synced)>,
    outcomes: SyncSender<io::Result<()>>,
    progress: Arc<RunProgress>,
    /// Distinguishes it from those of the run's earlier places, which may hang.
    number: u32,
    /// Job that [`Stepper::wait`] has received.
    next: Option<(RunSync, Synced)>,
}

/// Period in which a loop polls for work; a thread waits for it.
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
    /// Returns whether the recorder still needs it.
    fn synchronise(&self, file: RunSync, covers: Synced) -> bool {
        self.progress.syncing(self.number);
        let synced = file.sync();
        self.progress.synced(self.number, synced.is_ok().then_some(covers));
        // Release the file before its recorder may.
        drop(file);
        self.outcomes.send(synced).is_ok()
    }
}

impl Synchroniser {
    /// If the other side gets no thread, each synchronisation fails.
    pub fn new(progress: &Arc<RunProgress>, scheduler: &dyn Scheduler) -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let (jobs, jobs_out) = sync_channel(1);
        let (outcomes_in, outcomes) = sync_channel(1);
        let progress = Arc::clone(progress);
        let waits = progress.is_on_real_time();
        let work = SyncWork { jobs: jobs_out, outcomes: outcomes_in, progress, number, next: None };
        let _ = scheduler.start("synchroniser", Box::new(|| Box::new(work)));
        Self { jobs, outcomes, is_busy: false, waits }
    }

    /// Synchronises `file`, unless the previous synchronisation is still running.
    pub fn begin(&mut self, file: RunSync, covers: Synced) {
        if !self.is_busy {
            self.is_busy = true;
            let _ = self.jobs.send((file, covers));
        }
    }

    /// Takes the outcome of the last synchronisation, after which another can begin; returns its error if it failed.
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
    /// Leaves the file unlocked for its recovery, unless the synchronisation hangs.
    fn drop(&mut self) {
        if self.is_busy && self.waits {
            let _ = self.outcomes.recv_timeout(RELEASE_TIMEOUT);
        }
    }
}
