//! The place for recordings made ready by a thread that may wait for the disk, so that nobody else does.

use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::thread;
use std::time::Instant;

use crate::claim::Claim;
use crate::problem::{Fact, Problem};
use crate::run::{self, RunError, Storage};

/// Work of this kind that goes on.
pub(super) struct Tending {
    since: Instant,
    outcome: Receiver<Result<Option<Claim>, RunError>>,
}

impl Tending {
    /// Claims the place unless that is done, and finishes what earlier runs left there.
    pub fn begin(storage: &Storage, is_claimed: bool) -> Self {
        let (result, outcome) = sync_channel(1);
        let storage = storage.clone();
        let tend = move || {
            let claimed = if is_claimed { Ok(None) } else { run::claim_directory(&storage) };
            if claimed.is_ok() {
                run::finish_leftovers(&storage);
            }
            // Nobody waits any more if the service has ended meanwhile.
            let _ = result.send(claimed);
        };
        // Without a thread nobody sends, and the place is as it is.
        let _ = thread::Builder::new().name("leftovers".into()).spawn(tend);
        Self { since: Instant::now(), outcome }
    }

    /// What became of it; none while it goes on.
    pub fn look(&self) -> Option<Result<Option<Claim>, RunError>> {
        match self.outcome.try_recv() {
            Ok(outcome) => Some(outcome),
            Err(TryRecvError::Empty) => None,
            // Its cause is in the log, and what it did not finish is still there.
            Err(TryRecvError::Disconnected) => Some(Ok(None)),
        }
    }

    /// Why no run can begin yet.
    pub fn problem(&self) -> Problem {
        Fact::DiskRecovering { since_s: Some(self.since.elapsed().as_secs_f64()) }.into()
    }
}
