//! Progress of a run for other threads, which never wait for the disk: cycles that were due, written and synchronised, the
//! waits of recorder and synchroniser for the disk, and the problems that follow. Recorder, synchroniser,
//! storage and session update it; status, page and storage read it.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use shared::recording::{DiskTiming, Flagged, RunPlace, TimingSummary};
use shared::time::MonoNs;

use crate::clock::Clock;
use crate::problem::{Fact, Problem};

/// Counts of the cycles that the cycle's thread has handed to the ring. It alone writes them.
#[derive(Debug, Default)]
pub struct Handed {
    /// Cycles that were due so far.
    pub due: AtomicU64,
    /// Cycles among them that found the ring full.
    pub lost: AtomicU64,
}

/// Progress of a run: cycles taken from the bus, written, synchronised. Reading it never waits for the disk.
#[derive(Debug)]
pub struct RunProgress {
    handed: Arc<Handed>,
    limits: Limits,
    clock: Clock,
    disk: Mutex<OnDisk>,
}

/// Limits of a run.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Time between two cycles.
    pub cycle_period: Duration,
    /// Period of writing and synchronisation.
    pub sync_period: Duration,
    /// Cycles that may wait to be written.
    pub ring_cycles: usize,
    /// The cycle waits for the disk, as on virtual time: a backlog is usual then.
    pub cycle_waits: bool,
}

/// What the threads that use the disk have reported.
#[derive(Debug, Default)]
struct OnDisk {
    written: u64,
    /// Cycles among them that were lost between bus and file.
    written_lost: u64,
    synced: Synced,
    writing_since: Option<MonoNs>,
    /// Number of the synchroniser that is working, and since when.
    syncing_since: Option<(u32, MonoNs)>,
    /// The longest waits of completed calls, see [`OnDisk::longest_at`].
    longest: DiskTiming,
    /// Step before the run has its file.
    opening: OpeningStep,
    /// `None` before the run has its file.
    place: Option<RunPlace>,
    /// Why the file is not in its place, until the run is moved.
    file_lost: Option<String>,
    /// Why the run was moved; `None` if it was not.
    moved: Option<String>,
    timing: Option<TimingSummary>,
    flagged: Vec<Flagged>,
}

/// The disk's current step before a run has its file.
#[derive(Debug, Default)]
struct OpeningStep {
    what: &'static str,
    since: MonoNs,
}

/// Extent of the file that survives a power failure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Synced {
    /// Number of cycles in the file.
    pub cycles: u64,
    /// Cycles among them in which every encoder is valid.
    pub cycles_valid: u64,
    /// Length of the file \[bytes\].
    pub bytes: u64,
    /// All cycles written before this time are included; `None` before the first synchronisation.
    pub at: Option<MonoNs>,
}

/// [`RunProgress`] at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Extent that survives a power failure.
    pub synced: Synced,
    /// Cycles that survive a kill of the program.
    pub written: u64,
    /// Cycles that were due.
    pub taken: u64,
    /// Cycles among them that were lost between bus and file.
    pub lost: u64,
    /// Cycles that wait to be written, as time \[s\].
    pub backlog_s: f64,
    /// Above this backlog cycles are lost \[s\].
    pub backlog_limit_s: f64,
    /// Duration of cycles that a power failure would lose now \[s\].
    pub unsynced_s: f64,
    /// Age of the last complete synchronisation; `None` before the first.
    pub sync_age: Option<Duration>,
    /// Longest waits for the disk, including that of a current call.
    pub longest: DiskTiming,
    /// Where the run is written; empty until its file is there.
    pub file: PathBuf,
    /// Problems of the disk.
    pub problems: Vec<Problem>,
    /// Timing of the cycle; `None` on virtual time.
    pub timing: Option<TimingSummary>,
    /// Invalid cycles that are written, by joint and reason.
    pub flagged: Vec<Flagged>,
}

impl RunProgress {
    /// For a run that has no file yet.
    pub fn new(handed: Arc<Handed>, limits: Limits, clock: Clock) -> Self {
        let opening = OpeningStep { what: "to begin with it", since: clock.now() };
        let disk = OnDisk { opening, ..OnDisk::default() };
        Self { handed, limits, clock, disk: Mutex::new(disk) }
    }

    fn disk(&self) -> MutexGuard<'_, OnDisk> {
        self.disk.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// False on virtual time.
    pub(super) fn is_on_real_time(&self) -> bool {
        self.clock.is_real()
    }

    pub(super) fn sync_period(&self) -> Duration {
        self.limits.sync_period
    }

    /// Sets the disk's current step before the run has its file.
    pub fn opening(&self, what: &'static str) {
        self.disk().opening = OpeningStep { what, since: self.clock.now() };
    }

    /// The run's file is created.
    pub fn opened(&self, place: RunPlace) {
        self.disk().place = Some(place);
    }

    /// Whether the run has its file.
    pub fn is_open(&self) -> bool {
        self.disk().place.is_some()
    }

    /// The recorder is about to write.
    pub fn writing(&self) {
        let mut disk = self.disk();
        let waiting_ns = self.ns_of(self.backlog_cycles(&disk));
        disk.longest.backlog_longest_ns = disk.longest.backlog_longest_ns.max(waiting_ns);
        disk.writing_since = Some(self.clock.now());
    }

    /// The recorder has written: the number of cycles so far, fewer if the disk refused, and of lost ones among them.
    pub fn wrote(&self, cycles: u64, lost: u64) {
        let mut disk = self.disk();
        disk.longest = disk.longest_at(self.clock.now());
        disk.writing_since = None;
        (disk.written, disk.written_lost) = (cycles, lost);
    }

    /// A synchroniser starts its work.
    pub fn syncing(&self, number: u32) {
        self.disk().syncing_since = Some((number, self.clock.now()));
    }

    /// A synchroniser has finished; `None` if the disk refused. That of an earlier place may finish late.
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

    /// Sets the timing of the cycle so far, and the invalid cycles among those written.
    pub fn set_figures(&self, timing: Option<TimingSummary>, flagged: Vec<Flagged>) {
        let mut disk = self.disk();
        (disk.timing, disk.flagged) = (timing, flagged);
    }

    /// Longest waits for the disk so far, including that of a current call.
    pub fn longest(&self) -> DiskTiming {
        self.disk().longest_at(self.clock.now())
    }

    /// Place of the run's file; `None` before it is created.
    pub fn place(&self) -> Option<RunPlace> {
        self.disk().place.clone()
    }

    /// The file is not in its place, which the recorder will check. Has no effect if the run's file is another one by now.
    pub fn set_lost(&self, place: &RunPlace, why: String) {
        let mut disk = self.disk();
        if disk.place.as_ref().is_some_and(|current| current.is_same(place)) {
            disk.file_lost = Some(why);
        }
    }

    /// Why the file is not in its place; lost cycles are in [`Snapshot`].
    pub fn lost(&self) -> Option<String> {
        self.disk().file_lost.clone()
    }

    /// The file is in its place again.
    pub fn found_again(&self) {
        self.disk().file_lost = None;
    }

    /// The run continues in another place.
    pub fn moved(&self, place: RunPlace, why: String) {
        let mut disk = self.disk();
        disk.place = Some(place);
        disk.syncing_since = None;
        disk.file_lost = None;
        disk.moved = Some(why);
    }

    fn backlog_cycles(&self, disk: &OnDisk) -> u64 {
        let (due, lost) = (self.handed.due.load(Ordering::Acquire), self.handed.lost.load(Ordering::Relaxed));
        // A lost cycle does not wait, and once its number is written it is among the written ones.
        let unwritten_lost = lost.saturating_sub(disk.written_lost);
        due.saturating_sub(disk.written.saturating_add(unwritten_lost)).min(self.limits.ring_cycles as u64)
    }

    fn ns_of(&self, cycles: u64) -> u64 {
        cycles.saturating_mul(self.limits.cycle_period.as_nanos() as u64)
    }

    /// State of the run at this moment.
    pub fn get(&self) -> Snapshot {
        let (disk, now) = (self.disk(), self.clock.now());
        let seconds = |cycles: u64| self.ns_of(cycles) as f64 * 1e-9;
        let (taken, lost) =
            (self.handed.due.load(Ordering::Acquire), self.handed.lost.load(Ordering::Relaxed));
        // Nothing is safe in a file that is lost.
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
    /// The longest waits, including that of the current call, which will not become shorter.
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

/// A run whose file takes longer to create is reported.
const OPENS_WITHIN: Duration = Duration::from_secs(1);
/// Number of synchronisation periods that may wait before a warning: one is usual, the other for a busy disk.
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
        // 100 written, 50 of the next 100 lost, the other 50 wait.
        assert_eq!(backlog(200, 50, 100, 0), 50.0);
        // All of these are written, the lost ones by their numbers; then the disk hangs again.
        assert_eq!(backlog(200, 50, 200, 50), 0.0);
        assert_eq!(backlog(300, 50, 200, 50), 100.0);
    }
}
