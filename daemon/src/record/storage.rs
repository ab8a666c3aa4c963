//! The directories of recordings, and the state of their disk: space, permissions, response time, and whether the file of
//! the current run still exists under its path.
//!
//! One task checks the disk periodically and stores the result. Reading this result never waits, even if the disk hangs.
//! Another task logs the problems, so that problems are logged even while the first task hangs. A full disk ends the run.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use shared::config::DaemonConfig;
use shared::recording::{Disk, Space, SystemDisk};
use shared::time::MonoNs;

use super::progress::RunProgress;
use super::stop::Stop;
use crate::clock::Clock;
use crate::problem::{Fact, Problem};
use crate::scheduler::Scheduler;

const BYTES_PER_MB: u64 = 1_000_000;
/// A check is reported as a problem if it has not finished after this time \[ns\]. A disk that does not answer must be
/// reported within a second. The rest of this second is a margin for a busy machine.
const ANSWERS_WITHIN_NS: i64 = 400_000_000;

/// The directories of recordings, with their current state. Clones share the state.
#[derive(Debug, Clone)]
pub struct Storage(Arc<StorageState>);

#[derive(Debug)]
struct StorageState {
    disk: Arc<dyn Disk>,
    clock: Clock,
    directory: PathBuf,
    spare: PathBuf,
    floor_bytes: u64,
    last_check: Mutex<LastCheck>,
    /// Progress and stop of the run whose file is checked. `None` if no run is checked.
    run: Mutex<Option<(Weak<RunProgress>, Stop)>>,
}

/// Result of the last completed check, and progress of the check that is running.
#[derive(Debug, Default)]
struct LastCheck {
    begun: MonoNs,
    /// The directory that is checked. It is the directory of the current run; without a run, that of the next run.
    directory: PathBuf,
    is_over: bool,
    /// Free space that exceeds the required minimum. `None` if it is unknown.
    usable_bytes: Option<u64>,
    problem: Option<Problem>,
}

impl Storage {
    /// Time between two checks. A lost file must be reported within a second. The report also passes through control and
    /// page. The periods of all three together are a third of a second.
    const CHECK_PERIOD: Duration = Duration::from_millis(100);

    /// The configured directories, on the disk of the operating system.
    pub fn new(daemon: &DaemonConfig, scheduler: &dyn Scheduler) -> std::io::Result<Self> {
        Self::on(Arc::new(SystemDisk), daemon, scheduler)
    }

    /// The configured directories, on another disk.
    pub fn on(
        disk: Arc<dyn Disk>,
        daemon: &DaemonConfig,
        scheduler: &dyn Scheduler,
    ) -> std::io::Result<Self> {
        let clock = scheduler.clock().clone();
        let last_check =
            LastCheck { begun: clock.now(), directory: daemon.directory.clone(), ..LastCheck::default() };
        let storage = Self(Arc::new(StorageState {
            disk,
            clock,
            directory: daemon.directory.clone(),
            spare: daemon.spare_directory.clone(),
            floor_bytes: u64::from(daemon.disk_floor_mb) * BYTES_PER_MB,
            last_check: Mutex::new(last_check),
            run: Mutex::new(None),
        }));
        let mut logged = Vec::new();
        storage.repeat("disk", scheduler, StorageState::check)?;
        storage.repeat("disk log", scheduler, move |shared| logged = shared.log(&logged))?;
        Ok(storage)
    }

    /// Repeats `work` once per period, as long as the storage is in use.
    fn repeat(
        &self,
        name: &str,
        scheduler: &dyn Scheduler,
        mut work: impl FnMut(&StorageState) + Send + 'static,
    ) -> std::io::Result<()> {
        let shared = Arc::downgrade(&self.0);
        let repeated = move |_: MonoNs| {
            work(&*shared.upgrade()?);
            Some(Self::CHECK_PERIOD)
        };
        scheduler.start(name, Box::new(|| Box::new(repeated)))
    }

    /// The disk of the recordings.
    pub fn disk(&self) -> Arc<dyn Disk> {
        Arc::clone(&self.0.disk)
    }

    /// Directory of the recordings.
    pub fn directory(&self) -> &Path {
        &self.0.directory
    }

    /// Directory in which a run continues if its own directory or disk is lost.
    pub fn spare(&self) -> &Path {
        &self.0.spare
    }

    /// From now on, checks the file of this run, and ends the run if the disk becomes full. The checks end with the run.
    pub fn watch(&self, progress: &Arc<RunProgress>, stop: &Stop) {
        *lock(&self.0.run) = Some((Arc::downgrade(progress), stop.clone()));
    }

    /// Free space that recordings may still use \[bytes\]: the free space minus the required minimum. 0 if the minimum is
    /// not reached, `None` if the free space is unknown.
    pub fn usable_bytes(&self) -> Option<u64> {
        lock(&self.0.last_check).usable_bytes
    }

    /// Whether the state of the disk is known. This is the case if the first check has finished, or if it has taken so long
    /// that the disk is reported as silent.
    pub fn is_known(&self) -> bool {
        lock(&self.0.last_check).is_over || self.0.silent_problem().is_some()
    }

    /// Why no run can be recorded now, and what to do. `None` if recording is possible.
    pub fn problem(&self) -> Option<Problem> {
        self.0.problem()
    }

    /// Why the free space in `directory` is not enough for a run, and what to do. `None` if it is enough. This call
    /// may wait for the disk.
    pub fn full(&self, directory: &Path) -> Option<Problem> {
        let space = self.0.disk.space(directory);
        space.is_ok_and(|space| self.0.is_full(space)).then(|| self.0.full_problem(directory))
    }
}

impl StorageState {
    fn check(&self) {
        let run = self.watched_run();
        let place = run.as_ref().and_then(|(progress, _)| progress.place());
        let directory = place.as_ref().and_then(|place| place.path().parent()).unwrap_or(&self.directory);
        {
            let mut last_check = lock(&self.last_check);
            (last_check.begun, last_check.is_over) = (self.clock.now(), false);
            directory.clone_into(&mut last_check.directory);
        }
        let space = self.disk.space(directory);
        let problem = self.problem_of(directory, &space);
        // If a file system does not report its free space, recording is permitted.
        let usable_bytes = space.ok().map(|space| space.free_bytes.saturating_sub(self.floor_bytes));
        if let Some((progress, stop)) = run.filter(|(_, stop)| !stop.is_stopped()) {
            if let Some(place) = &place
                && let Err(lost) = place.check()
            {
                progress.set_lost(place, lost.to_string());
            }
            if usable_bytes == Some(0) {
                stop.stop(&self.full_problem(directory).to_string());
            }
        }
        let mut last_check = lock(&self.last_check);
        (last_check.usable_bytes, last_check.problem, last_check.is_over) = (usable_bytes, problem, true);
    }

    fn problem_of(&self, directory: &Path, space: &std::io::Result<Space>) -> Option<Problem> {
        let fact = match space {
            Ok(space) if !space.is_writable => Fact::DiskUnwritable { directory: directory.to_owned() },
            Ok(space) if self.is_full(*space) => return Some(self.full_problem(directory)),
            Ok(_) => return None,
            Err(error) => {
                Fact::DiskError { place: directory.display().to_string(), error: error.to_string() }
            }
        };
        Some(fact.into())
    }

    fn is_full(&self, space: Space) -> bool {
        space.free_bytes <= self.floor_bytes
    }

    fn full_problem(&self, directory: &Path) -> Problem {
        let floor_mb = self.floor_bytes / BYTES_PER_MB;
        Fact::DiskFull { directory: directory.to_owned(), floor_mb }.into()
    }

    fn watched_run(&self) -> Option<(Arc<RunProgress>, Stop)> {
        lock(&self.run).as_ref().and_then(|(progress, stop)| Some((progress.upgrade()?, stop.clone())))
    }

    /// The problem that the current check has not finished in time. `None` if the check has finished or still has time.
    fn silent_problem(&self) -> Option<Problem> {
        let last_check = lock(&self.last_check);
        let now = self.clock.now();
        let is_silent = !last_check.is_over && now.ns_since(last_check.begun) > ANSWERS_WITHIN_NS;
        let (directory, silent_s) =
            (Some(last_check.directory.clone()), Some(now.seconds_since(last_check.begun)));
        is_silent.then(|| Fact::DiskSilent { directory, silent_s }.into())
    }

    fn problem(&self) -> Option<Problem> {
        self.silent_problem().or_else(|| lock(&self.last_check).problem.clone())
    }

    /// Problems of the disk and of the current run. Does not wait for the disk.
    fn problems(&self) -> Vec<Problem> {
        let run_problems =
            self.watched_run().map(|(progress, _)| progress.get().problems).unwrap_or_default();
        self.problem().into_iter().chain(run_problems).collect()
    }

    /// Logs the problems that are new: their codes are not in `before`. Returns the codes of all problems.
    fn log(&self, before: &[&'static str]) -> Vec<&'static str> {
        let problems = self.problems();
        for problem in problems.iter().filter(|problem| !before.contains(&problem.code())) {
            tracing::warn!(code = problem.code(), "{problem}");
        }
        problems.iter().map(Problem::code).collect()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
