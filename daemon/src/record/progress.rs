//! Progress of a run: the cycles that were due, written and synchronised, the waits for the disk, and the resulting
//! problems. Recorder, synchroniser, storage and session update the progress. Status, page and storage read it. Reading
//! never waits for the disk.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use shared::recording::{DiskTiming, Flagged, RunPlace, TimingSummary};
use shared::time::MonoNs;

use crate::clock::Clock;
use crate::problem::{Fact, Problem};

/// Numbers of cycles that were passed to the ring. Only the thread of the cycle changes them.
#[derive(Debug, Default)]
pub struct Handed {
    /// Number of cycles that were due so far.
    pub due: AtomicU64,
    /// Number of these cycles that were lost because the ring was full.
    pub lost: AtomicU64,
}

/// Progress of a run. Reading it never waits for the disk.
#[derive(Debug)]
pub struct RunProgress {
    handed: Arc<Handed>,
    pub(super) limits: Limits,
    pub(super) clock: Clock,
    disk: Mutex<OnDisk>,
}

/// Limits of a run. If the progress exceeds them, a problem is reported.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Time between two cycles.
    pub cycle_period: Duration,
    /// Period in which the file is written and synchronised.
    pub sync_period: Duration,
    /// Largest number of cycles that may wait to be written.
    pub ring_cycles: usize,
    /// Whether the cycle waits for the disk, as in virtual time. In this case, waiting cycles are not a problem.
    pub cycle_waits: bool,
}

/// State that the threads report while they use the disk.
#[derive(Debug, Default)]
struct OnDisk {
    /// Number of cycles that were written, including lost ones.
    written: u64,
    /// Number of written cycles that were lost between bus and file.
    written_lost: u64,
    synced: Synced,
    /// When the write in progress began. `None` if the recorder is not writing.
    writing_since: Option<MonoNs>,
    /// The synchronisation in progress: number of its synchroniser, and when it began.
    syncing_since: Option<(u32, MonoNs)>,
    /// The longest waits of completed calls. [`OnDisk::longest_at`] also includes a call in progress.
    longest: DiskTiming,
    /// The current step of creating the run's file.
    opening: OpeningStep,
    /// Path and identity of the run's file. `None` before the file is created.
    place: Option<RunPlace>,
    /// Why the file is not in its place. `None` if it is in its place, or if the run has moved since.
    file_lost: Option<String>,
    /// Why the run has moved to another directory. `None` if the run has not moved.
    moved: Option<String>,
    timing: Option<TimingSummary>,
    flagged: Vec<Flagged>,
}

/// A step of creating the run's file. It is reported if it takes too long.
#[derive(Debug, Default)]
struct OpeningStep {
    what: &'static str,
    since: MonoNs,
}

/// The part of the file that survives a power failure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Synced {
    /// Number of cycles in this part.
    pub cycles: u64,
    /// Number of these cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Length of this part \[bytes\].
    pub bytes: u64,
    /// All cycles written before this time are included. `None` before the first synchronisation.
    pub at: Option<MonoNs>,
}

/// The state of [`RunProgress`] at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// The part of the file that survives a power failure.
    pub synced: Synced,
    /// Number of cycles that survive a kill of the program.
    pub written: u64,
    /// Number of cycles that were due.
    pub taken: u64,
    /// Number of these cycles that were lost between bus and file.
    pub lost: u64,
    /// Duration of the cycles that wait to be written \[s\].
    pub backlog_s: f64,
    /// Largest possible backlog \[s\]. If more cycles had to wait, they would be lost.
    pub backlog_limit_s: f64,
    /// Duration of the cycles that a power failure would lose now \[s\].
    pub unsynced_s: f64,
    /// Age of the last completed synchronisation. `None` before the first.
    pub sync_age: Option<Duration>,
    /// Longest waits for the disk, including the time so far of a call in progress.
    pub longest: DiskTiming,
    /// Path of the run's file. Empty until the file is created.
    pub file: PathBuf,
    /// Problems of the disk.
    pub problems: Vec<Problem>,
    /// Timing of the cycle; `None` in virtual time.
    pub timing: Option<TimingSummary>,
    /// Invalid cycles that were written, grouped by joint and reason.
    pub flagged: Vec<Flagged>,
}

impl RunProgress {
    /// The progress of a run whose file does not exist yet.
    pub fn new(handed: Arc<Handed>, limits: Limits, clock: Clock) -> Self {
        let opening = OpeningStep { what: "to begin with it", since: clock.now() };
        let disk = OnDisk { opening, ..OnDisk::default() };
        Self { handed, limits, clock, disk: Mutex::new(disk) }
    }

    fn disk(&self) -> MutexGuard<'_, OnDisk> {
        self.disk.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the current step of creating the run's file.
    pub fn opening(&self, what: &'static str) {
        self.disk().opening = OpeningStep { what, since: self.clock.now() };
    }

    /// Reports that the run's file was created.
    pub fn opened(&self, place: RunPlace) {
        self.disk().place = Some(place);
    }

    /// Whether the file of the run exists already.
    pub fn is_open(&self) -> bool {
        self.disk().place.is_some()
    }

    /// Reports that the recorder begins to write.
    pub fn writing(&self) {
        let mut disk = self.disk();
        let waiting_ns = self.ns_of(self.backlog_cycles(&disk));
        disk.longest.backlog_longest_ns = disk.longest.backlog_longest_ns.max(waiting_ns);
        disk.writing_since = Some(self.clock.now());
    }

    /// Reports that the recorder has finished writing. `cycles` is the number of cycles written so far. If the disk refused
    /// the data, this number has not grown. `lost` is the number of lost cycles among them.
    pub fn wrote(&self, cycles: u64, lost: u64) {
        let mut disk = self.disk();
        disk.longest = disk.longest_at(self.clock.now());
        disk.writing_since = None;
        (disk.written, disk.written_lost) = (cycles, lost);
    }

    /// Reports that a synchroniser begins its work.
    pub fn syncing(&self, number: u32) {
        self.disk().syncing_since = Some((number, self.clock.now()));
    }

    /// Reports that a synchroniser has finished. `synced` is `None` if the disk returned an error. The number is compared,
    /// because a synchroniser from before a move of the run may finish late.
    pub fn synced(&self, number: u32, synced: Option<Synced>) {
        let mut disk = self.disk();
        if disk.syncing_since.is_some_and(|(syncing, _)| syncing == number) {
            disk.longest = disk.longest_at(self.clock.now());
            disk.syncing_since = None;
        }
        if let Some(synced) = synced.filter(|synced| synced.cycles >= disk.synced.cycles) {
            disk.synced = synced;
        }
    }

    /// Sets the timing of the cycle so far, and the invalid cycles among the written ones.
    pub fn set_figures(&self, timing: Option<TimingSummary>, flagged: Vec<Flagged>) {
        let mut disk = self.disk();
        (disk.timing, disk.flagged) = (timing, flagged);
    }

    /// Longest waits for the disk so far, including the time so far of a call in progress.
    pub fn longest(&self) -> DiskTiming {
        self.disk().longest_at(self.clock.now())
    }

    /// Path and identity of the run's file. `None` before the file is created.
    pub fn place(&self) -> Option<RunPlace> {
        self.disk().place.clone()
    }

    /// Reports that the file is not in its place, so that the recorder checks this. Has no effect if `place` is no longer
    /// the place of the run's file.
    pub fn set_lost(&self, place: &RunPlace, why: String) {
        let mut disk = self.disk();
        if disk.place.as_ref().is_some_and(|current| current.is_same(place)) {
            disk.file_lost = Some(why);
        }
    }

    /// Why the file is not in its place. `None` if it is in its place. (The number of lost cycles is in [`Snapshot`].)
    pub fn lost(&self) -> Option<String> {
        self.disk().file_lost.clone()
    }

    /// Reports that the file is in its place again.
    pub fn found_again(&self) {
        self.disk().file_lost = None;
    }

    /// Reports that the run continues in another directory.
    pub fn moved(&self, place: RunPlace, why: String) {
        let mut disk = self.disk();
        disk.place = Some(place);
        disk.syncing_since = None;
        disk.file_lost = None;
        disk.moved = Some(why);
    }

    fn backlog_cycles(&self, disk: &OnDisk) -> u64 {
        let (due, lost) = (self.handed.due.load(Ordering::Acquire), self.handed.lost.load(Ordering::Relaxed));
        // A lost cycle does not wait to be written. Once its number has been written, it is included in the written cycles.
        let unwritten_lost = lost.saturating_sub(disk.written_lost);
        due.saturating_sub(disk.written.saturating_add(unwritten_lost)).min(self.limits.ring_cycles as u64)
    }

    fn ns_of(&self, cycles: u64) -> u64 {
        cycles.saturating_mul(self.limits.cycle_period.as_nanos() as u64)
    }

    /// The state of the run now.
    pub fn get(&self) -> Snapshot {
        let (disk, now) = (self.disk(), self.clock.now());
        let seconds = |cycles: u64| self.ns_of(cycles) as f64 * 1e-9;
        let (taken, lost) =
            (self.handed.due.load(Ordering::Acquire), self.handed.lost.load(Ordering::Relaxed));
        // If the file is not in its place, no cycle counts as safe.
        let is_in_place = disk.file_lost.is_none();
        let (synced, written) = if is_in_place { (disk.synced, disk.written) } else { Default::default() };
        let mut snapshot = Snapshot {
            synced,
            written,
            taken,
            lost,
            backlog_s: seconds(self.backlog_cycles(&disk)),
            backlog_limit_s: seconds(self.limits.ring_cycles as u64),
            unsynced_s: seconds(taken.saturating_sub(synced.cycles)),
            sync_age: synced.at.map(|at| Duration::from_nanos(now.ns_since(at).max(0) as u64)),
            longest: disk.longest_at(now),
            file: disk.place.as_ref().map(|place| place.path().to_owned()).unwrap_or_default(),
            problems: Vec::new(),
            timing: disk.timing.clone(),
            flagged: disk.flagged.clone(),
        };
        snapshot.problems = snapshot.find_problems(&self.limits, &disk, now);
        snapshot
    }
}

impl OnDisk {
    /// The longest waits. For a call in progress, the wait so far is used, so the result is a lower bound.
    fn longest_at(&self, now: MonoNs) -> DiskTiming {
        let lasted_ns = |since: Option<MonoNs>| since.map_or(0, |since| now.ns_since(since).max(0) as u64);
        let syncing_since = self.syncing_since.map(|(_, since)| since);
        DiskTiming {
            sync_longest_ns: self.longest.sync_longest_ns.max(lasted_ns(syncing_since)),
            write_longest_ns: self.longest.write_longest_ns.max(lasted_ns(self.writing_since)),
            ..self.longest
        }
    }
}

/// A problem is reported if the file of the run is not created within this time.
const OPENS_WITHIN: Duration = Duration::from_secs(1);
/// Number of synchronisation periods that may wait before a warning. One waiting period is usual; a busy disk
/// may cause a second one.
const WARNING_PERIODS: u32 = 2;

impl Snapshot {
    fn find_problems(&self, limits: &Limits, disk: &OnDisk, now: MonoNs) -> Vec<Problem> {
        let Self { lost, backlog_s, backlog_limit_s, unsynced_s, file, .. } = self;
        let usual_s = (limits.sync_period * WARNING_PERIODS).as_secs_f64();
        let since_s = now.seconds_since(disk.opening.since);
        let is_late = since_s > OPENS_WITHIN.as_secs_f64() && !limits.cycle_waits;
        let pending = (is_late && disk.place.is_none())
            .then(|| Fact::FilePending { since_s, step: disk.opening.what.into() });
        let displaced = disk.file_lost.clone().map(|error| Fact::FileLost { error });
        let moved = disk.moved.clone().map(|error| Fact::FileMoved { file: file.clone(), error });
        let lost = (*lost > 0).then_some(Fact::CyclesLost { cycles: *lost });
        let late = if limits.cycle_waits {
            None
        } else if *backlog_s > usual_s {
            Some(Fact::DiskBacklog { backlog_s: *backlog_s, limit_s: *backlog_limit_s })
        } else {
            (*unsynced_s > usual_s).then_some(Fact::DiskSlow { unsynced_s: *unsynced_s })
        };
        [pending, displaced, moved, lost, late].into_iter().flatten().map(Problem::from).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_shortens_no_later_backlog() {
        let handed = Arc::<Handed>::default();
        let limits = Limits {
            cycle_period: Duration::from_millis(10),
            sync_period: Duration::from_millis(500),
            ring_cycles: 1000,
            cycle_waits: false,
        };
        let progress = RunProgress::new(Arc::clone(&handed), limits, Clock::Real);
        let backlog = |due, lost, written, written_lost| {
            handed.due.store(due, Ordering::Relaxed);
            handed.lost.store(lost, Ordering::Relaxed);
            progress.wrote(written, written_lost);
            (progress.get().backlog_s / 0.01).round()
        };
        // 100 cycles are written. Of the next 100, 50 are lost and the other 50 wait.
        assert_eq!(backlog(200, 50, 100, 0), 50.0);
        // All of these are written; for the lost cycles, only the numbers are written. Then the disk hangs again.
        assert_eq!(backlog(200, 50, 200, 50), 0.0);
        assert_eq!(backlog(300, 50, 200, 50), 100.0);
    }
}
