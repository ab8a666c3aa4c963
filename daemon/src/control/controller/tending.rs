//! The place for recordings is made ready by work of its own, which may wait for the disk.

use shared::time::MonoNs;

use crate::claim::Claim;
use crate::problem::{Fact, Problem};
use crate::run::{self, RunError, Storage};
use crate::scheduler::{Pending, Scheduler};

/// Work of this kind that goes on.
pub(super) struct Tending(Pending<Result<Option<Claim>, RunError>>);

impl Tending {
    /// Claims the place unless that is done, and finishes what earlier runs left there.
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

    /// What became of it; none while it goes on.
    pub fn look(&self) -> Option<Result<Option<Claim>, RunError>> {
        // What was not finished is still there.
        self.0.poll().map(|outcome| outcome.unwrap_or(Ok(None)))
    }

    /// Why no run can begin yet.
    pub fn problem(&self, now: MonoNs) -> Problem {
        Fact::DiskRecovering { since_s: Some(now.seconds_since(self.0.since())) }.into()
    }
}
