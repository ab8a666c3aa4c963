//! Has the disk keep what was written, while more is written.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread;
use std::time::Duration;

use shared::recording::RunSync;

use super::STACK_BYTES;
use super::progress::{Progress, Synced};

/// A synchronisation that goes on when its recorder ends may still take this long.
const LETS_GO_WITHIN: Duration = Duration::from_secs(1);
/// A thread that waits for the disk to have what was written, while more is written. It ends with the recorder.
pub(super) struct Synchroniser {
    jobs: SyncSender<(RunSync, Synced)>,
    outcomes: Receiver<io::Result<()>>,
    is_busy: bool,
}

impl Synchroniser {
    pub fn new(progress: &Arc<Progress>) -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let (jobs, waiting) = sync_channel::<(RunSync, Synced)>(1);
        let (outcome, outcomes) = sync_channel(1);
        let progress = Arc::clone(progress);
        let body = move || {
            while let Ok((file, covered)) = waiting.recv() {
                progress.syncing(number);
                let synced = file.sync();
                progress.synced(number, synced.is_ok().then_some(covered));
                // Let go of the file before its recorder may.
                drop(file);
                if outcome.send(synced).is_err() {
                    return;
                }
            }
        };
        // Where there is no thread to be had nobody takes jobs, and each fails.
        let _ = thread::Builder::new().name("synchroniser".into()).stack_size(STACK_BYTES).spawn(body);
        Self { jobs, outcomes, is_busy: false }
    }

    /// Synchronises `file`, unless it is still at it.
    pub fn begin(&mut self, file: RunSync, covers: Synced) {
        if !self.is_busy {
            self.is_busy = true;
            let _ = self.jobs.send((file, covers));
        }
    }

    /// Why the last synchronisation failed; told once.
    pub fn problem(&mut self) -> Option<io::Error> {
        if !self.is_busy {
            return None;
        }
        let outcome = match self.outcomes.try_recv() {
            Ok(outcome) => outcome,
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => Err(io::Error::other("no thread to synchronise the file")),
        };
        self.is_busy = false;
        outcome.err()
    }
}

impl Drop for Synchroniser {
    /// Whoever recovers the file should find it unlocked; one that hangs is not waited for.
    fn drop(&mut self) {
        if self.is_busy {
            let _ = self.outcomes.recv_timeout(LETS_GO_WITHIN);
        }
    }
}
