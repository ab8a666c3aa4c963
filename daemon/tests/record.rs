//! One run of `ballbard record` in virtual time. The tests check when the run ends, which files it leaves, and that it never
//! waits for a disk that hangs.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use ballbard::record::{RunSummary, Stop, Storage};
use ballbard::run::{self, BusChoice, RunDetails, RunError, RunRequest, Setup};
use shared::config::DaemonConfig;
use shared::recording::{Recording, WriteError};
use shared::time::MonoNs;

use crate::support::runs::{bar, daemon_in, in_parallel, leave};
use crate::support::wall::{Call, Fault, Wall};
use crate::support::world::{World, now, since, sleep};

/// Duration of a hang that is longer than any client waits.
const EVER: Duration = Duration::from_secs(60);
/// Longest time that the command needs to end if its run has no file yet.
const ENDS_WITHIN: Duration = Duration::from_secs(2);

/// The command `ballbard record`: its configuration, the disk on which it records, and the flag that interrupts it.
struct Command {
    _directory: tempfile::TempDir,
    daemon: DaemonConfig,
    wall: Arc<Wall>,
    request: RunRequest,
    stop: Stop,
}

impl Command {
    fn new(fault: Option<(Call, usize, Fault)>, duration: Option<Duration>) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let daemon = daemon_in(directory.path());
        let wall = Arc::new(Wall::new(&daemon.directory, fault));
        let run = RunDetails { name: "day".into(), duration, ..RunDetails::default() };
        let request = RunRequest { run, ..RunRequest::default() };
        Self { _directory: directory, daemon, wall, request, stop: Stop::default() }
    }

    /// Runs the command. Returns its result and the time that it took.
    async fn run(&self) -> (Result<RunSummary, RunError>, Duration) {
        let scheduler = World::here().unwrap().scheduler();
        let begun = now();
        let storage = Storage::on(self.wall.clone(), &self.daemon, &*scheduler).unwrap();
        let setup = Setup { scheduler, storage, daemon: self.daemon.clone(), bar: bar() };
        (run::record(&setup, &self.request, &self.stop).await, since(begun))
    }

    /// Interrupts the command after this time. The returned cell contains the instant of the
    /// interruption once it has happened.
    fn stop_after(&self, time: Duration) -> Rc<Cell<Option<MonoNs>>> {
        let (stop, asked) = (self.stop.clone(), Rc::<Cell<Option<MonoNs>>>::default());
        let at = Rc::clone(&asked);
        World::here().unwrap().spawn(async move {
            sleep(time).await;
            at.set(Some(now()));
            stop.stop("stopped by Ctrl-C");
        });
        asked
    }

    fn names(&self) -> Vec<String> {
        let listed = std::fs::read_dir(&self.daemon.directory).into_iter().flatten();
        listed.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }
}

#[test]
fn a_run_ends_after_its_duration_or_when_it_is_asked_to_and_its_file_has_the_cause() {
    World::live(async {
        let command = Command::new(None, Some(Duration::from_secs(2)));
        let (outcome, lasted) = command.run().await;
        let summary = outcome.unwrap();
        assert_eq!((summary.cycles, summary.cycles_valid, &*summary.cause), (200, 200, "duration reached"));
        assert!(lasted >= Duration::from_secs(2) && lasted < Duration::from_secs(4), "{lasted:?}");
        assert_eq!(Recording::open(&summary.path).unwrap().cycles.len(), 200);

        let command = Command::new(None, None);
        let asked = command.stop_after(Duration::from_secs(3));
        let (outcome, _) = command.run().await;
        let RunSummary { path, cycles, cause, .. } = outcome.unwrap();
        let took = since(asked.get().unwrap());
        assert_eq!(cause, "stopped by Ctrl-C");
        assert!((100..=300).contains(&cycles), "{cycles}");
        assert!(took < Duration::from_millis(200), "ended {took:?} after it was asked to");
        assert_eq!(Recording::open(&path).unwrap().end.cause, cause);
    });
}

#[test]
fn what_is_taken_is_in_a_file_while_the_run_goes_on() {
    World::live(async {
        let command = Rc::new(Command::new(None, Some(Duration::from_secs(3))));
        let watched = Rc::clone(&command);
        World::here().unwrap().spawn(async move {
            let file = watched.daemon.directory.join("day.mcap.active");
            let length = || std::fs::metadata(&file).map_or(0, |file| file.len());
            while length() == 0 {
                sleep(Duration::from_millis(10)).await;
            }
            let before = length();
            sleep(Duration::from_millis(1100)).await;
            // Five encoders at 100 Hz write more than 5000 bytes a second.
            assert!(length() > before + 5_000, "{before} bytes, a second later {}", length());
            watched.stop.stop("seen");
        });
        assert_eq!(command.run().await.0.unwrap().cause, "seen");
    });
}

#[test]
fn a_run_that_is_refused_leaves_no_file_and_the_next_one_can_begin() {
    World::live(async {
        let second = Some(Duration::from_secs(1));
        let command = Command::new(None, second);
        std::fs::create_dir(&command.daemon.directory).unwrap();
        leave(&command.daemon.directory, "day", 40, true);
        let (outcome, _) = command.run().await;
        assert!(matches!(outcome, Err(RunError::Write(WriteError::Exists(_)))), "{outcome:?}");
        assert!(
            command.names().contains(&"day.mcap".into())
                && !command.names().contains(&"day.mcap.active".into())
        );

        // The required free space is larger than any disk, so the run must be refused.
        let full =
            Command { daemon: DaemonConfig { disk_floor_mb: u32::MAX, ..command.daemon.clone() }, ..command };
        let (outcome, _) = full.run().await;
        assert!(
            matches!(&outcome, Err(RunError::Disk(problem)) if problem.code() == "disk_full"),
            "{outcome:?}"
        );

        let daemon = DaemonConfig { disk_floor_mb: 0, ..full.daemon.clone() };
        let mut next = Command { daemon, ..full };
        next.request.run.name = "next".into();
        assert_eq!(next.run().await.0.unwrap().cycles, 100);
    });
}

#[test]
fn a_bus_that_is_not_there_is_waited_for_until_somebody_ends_it() {
    World::live(async {
        let mut command = Command::new(None, None);
        command.request.bus = BusChoice::Interface("no-such".into());
        let (outcome, lasted) = command.run().await;
        assert!(
            matches!(outcome, Err(RunError::Open(_))) && lasted < Duration::from_millis(10),
            "{outcome:?}"
        );

        command.request.wait = true;
        command.stop_after(Duration::from_millis(4300));
        let (outcome, lasted) = command.run().await;
        let error = outcome.unwrap_err().to_string();
        assert!(error.contains("stopped by Ctrl-C") && error.contains("no-such"), "{error}");
        assert!(lasted >= Duration::from_millis(4300) && lasted < Duration::from_millis(4350), "{lasted:?}");
        assert!(!command.daemon.directory.exists());
    });
}

/// Interrupts a command while the disk hangs in `call`, before the run has a file. If `second` is given, the first hang then
/// ends, and the call `second` hangs.
fn check_hang(call: Call, second: Option<Call>) {
    World::live(async move {
        let hang = if second.is_some() { Duration::from_millis(1300) } else { EVER };
        let command = Command::new(Some((call, 0, Fault::Hangs(hang))), None);
        let (wall, stop) = (Arc::clone(&command.wall), command.stop.clone());
        let asked = Rc::<Cell<Option<MonoNs>>>::default();
        let at = Rc::clone(&asked);
        World::here().unwrap().spawn(async move {
            while wall.struck().is_none() {
                sleep(Duration::from_millis(5)).await;
            }
            if let Some(second) = second {
                wall.strike_next(second, Fault::Hangs(EVER));
            } else {
                sleep(Duration::from_millis(800)).await;
            }
            at.set(Some(now()));
            stop.stop("stopped by SIGTERM");
        });
        let (outcome, _) = command.run().await;
        let took = since(asked.get().unwrap());
        assert!(took < ENDS_WITHIN, "{call:?}, {second:?}: ended after {took:?}");
        let error = outcome.unwrap_err().to_string();
        for word in ["stopped by SIGTERM", "nothing was recorded", "disk"] {
            assert!(error.contains(word), "`{word}` is missing in: {error}");
        }
    });
}

#[test]
fn a_command_that_is_asked_to_end_before_the_disk_gave_its_run_a_file_does_not_wait_for_the_disk() {
    // Calls that prepare the directory, and calls that create, lock and name the file of the run.
    let calls =
        [Call::MakeDirectory, Call::Lock, Call::List, Call::Rename, Call::SyncDirectory, Call::Create];
    let mut cases: Vec<_> = calls.map(|call| (call, None)).into();
    cases.push((Call::MakeDirectory, Some(Call::Create)));
    in_parallel(&cases, 2, |(call, second)| check_hang(*call, *second));
}
