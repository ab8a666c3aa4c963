//! Prepares the place for recordings in a task that may wait for the disk.

use shared::time::MonoNs;

use crate::claim::Claim;
use crate::problem::{Fact, Problem};
use crate::run::{self, RunError, Storage};
use crate::scheduler::{Pending, Scheduler};

/// A preparation that is under way.
pub(super) struct Tending(Pending<Result<Option<Claim>, RunError>>);

impl Tending {
    /// Claims the place unless `is_claimed`, and finishes the files of earlier runs.
    pub fn begin(scheduler: &dyn Scheduler, storage: &Storage, is_claimed: bool) -> Self {
        let storage = storage.clone();
        Self(Pending::start(scheduler, "leftovers", move || {
            let claimed = if is_claimed { Ok(None) } else { run::claim_directory(&storage) };
            if claimed.is_ok() {
                run::finish_leftovers(&storage);
            }
            claimed
        }))
    }

    /// Its result; `None` while it is under way.
    pub fn look(&self) -> Option<Result<Option<Claim>, RunError>> {
        // Files that were not finished are still there.
        self.0.poll().map(|outcome| outcome.unwrap_or(Ok(None)))
    }

    /// Why no run can begin yet.
    pub fn problem(&self, now: MonoNs) -> Problem {
        Fact::DiskRecovering { since_s: Some(now.seconds_since(self.0.since())) }.into()
    }
}
