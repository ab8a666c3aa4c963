//! A recorder in virtual time. Its input is a simulated cycle that never waits. Its output is a simulated disk.
//! An observer checks its reports.

use std::cell::RefCell;
use std::collections::HashMap;
use std::fs::Metadata;
use std::io::Cursor;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::Duration;

use ballbard::clock::Clock;
use ballbard::cycle::CycleTiming;
use ballbard::problem::Problem;
use ballbard::record::{
    self, Limits, Marker, Recorder, RunLink, RunProgress, RunSummary, Snapshot, Stop, Storage,
};
use ballbard::scheduler::Stepper;
use shared::recording::{RecordingWriter, WriteError, salvage};
use shared::time::{MonoNs, UtcNs};

use crate::support::runs::{daemon_in, metadata, record_of};
use crate::support::wall::Wall;
use crate::support::world::World;

/// Length, rates and disturbances of the run to record.
#[derive(Debug, Clone)]
pub struct Plan {
    pub period: Duration,
    pub cycles: u64,
    pub sync_period: Duration,
    pub ring_cycles: usize,
    /// Numbers of the cycles during which a marker is set.
    pub marks: Vec<u64>,
    /// Number of a cycle, and a change that is made to the run's directory after this cycle.
    pub interfere: Option<(u64, Way)>,
}

/// A function that changes the directory of the run.
pub type Way = fn(&Path);

/// An observation of the recorder and its disk during the recording.
#[derive(Debug)]
pub struct Look {
    pub snapshot: Snapshot,
    /// Problem of the disk that the storage reports, if there is one.
    pub problem: Option<Problem>,
    /// Number of bytes of the run's file that would survive a power cut at the time of the observation.
    pub synced_bytes: u64,
    /// Number of bytes of the run's file that would survive a kill of the process at the time of the observation.
    pub written_bytes: u64,
    /// Whether the file of the snapshot still existed when its bytes were counted.
    pub is_steady: bool,
    /// Time from the first cycle to the observation.
    pub at: Duration,
}

/// Result of a recording, with all observations.
pub struct Outcome {
    pub result: Result<RunSummary, WriteError>,
    pub looks: Vec<Look>,
    pub wall: Arc<Wall>,
    /// Time from the first cycle to the fault. `None` if the fault came before the first cycle or never.
    pub struck: Option<Duration>,
    /// Time from the last cycle until the file was finished.
    pub finishing: Duration,
    /// Sample time of cycle 0.
    pub first: UtcNs,
    pub directory: tempfile::TempDir,
}

impl Outcome {
    pub fn home(&self) -> PathBuf {
        self.directory.path().join("runs")
    }

    pub fn spare(&self) -> PathBuf {
        self.directory.path().join("spare")
    }

    /// Largest value of a duration over all observations. `of` returns the duration of a snapshot.
    pub fn worst(&self, of: impl Fn(&Snapshot) -> f64) -> f64 {
        self.looks.iter().map(|look| of(&look.snapshot)).fold(0.0, f64::max)
    }

    /// Whether any observation has a problem whose text contains this word.
    pub fn was_told(&self, word: &str) -> bool {
        let told = |look: &Look| {
            let is_in = |problem: &Problem| problem.text.contains(word);
            look.snapshot.problems.iter().chain(&look.problem).any(is_in)
        };
        self.looks.iter().any(told)
    }

    /// Checks the reports of all observations. `bytes` is the content of the file at the end of the run. At the time of an
    /// observation, the file was the beginning of these bytes. All cycles that an observation reported as safe must be
    /// readable from the bytes that were safe at that time.
    pub fn check_claims(&self, bytes: &[u8]) {
        let mut known = HashMap::new();
        let mut cycles_in = |length| *known.entry(length).or_insert_with(|| cycles_in(bytes, length));
        let mut checked = (0, 0);
        for Look { snapshot, synced_bytes, written_bytes, .. } in
            self.looks.iter().filter(|look| look.is_steady)
        {
            let claims = (snapshot.synced.cycles, snapshot.written);
            if claims != checked {
                checked = claims;
                assert!(cycles_in(*synced_bytes) >= claims.0, "a power cut: {snapshot:?} {synced_bytes}");
                assert!(cycles_in(*written_bytes) >= claims.1, "a kill: {snapshot:?} {written_bytes}");
            }
        }
    }
}

/// Number of cycles that can be read from the first `length` bytes.
fn cycles_in(bytes: &[u8], length: u64) -> u64 {
    let cut = &bytes[..bytes.len().min(length as usize)];
    salvage(Cursor::new(cut), Cursor::new(Vec::new()))
        .map_or(0, |(salvaged, _)| salvaged.cycles - salvaged.cycles_lost)
}

/// Records the run on a simulated disk, in virtual time. If no file can be created for the run, the result
/// is an error without observations.
pub fn record(plan: &Plan, wall: impl FnOnce(&Path) -> Wall) -> Outcome {
    let world = World::begin();
    let outcome = record_in(&world, plan, wall);
    world.end();
    outcome
}

fn record_in(world: &World, plan: &Plan, wall: impl FnOnce(&Path) -> Wall) -> Outcome {
    let directory = tempfile::tempdir().unwrap();
    let daemon = daemon_in(directory.path());
    let wall = Arc::new(wall(&daemon.directory));
    let (clock, run) = (&world.clock, metadata(plan.period));
    // The sample times of the run are times of the monotonic clock.
    clock.step_utc(run.utc_minus_monotonic_ns - clock.utc_minus_monotonic_ns());
    let storage = Storage::on(wall.clone(), &daemon, &*world.scheduler()).unwrap();
    let outcome = Outcome {
        result: Err(WriteError::Lost(PathBuf::new())),
        looks: Vec::new(),
        wall: Arc::clone(&wall),
        struck: None,
        finishing: Duration::ZERO,
        first: UtcNs(0),
        directory,
    };
    let writer = match RecordingWriter::create_on(storage.disk(), storage.directory(), &run) {
        Ok(writer) => writer,
        Err(error) => return Outcome { result: Err(error), ..outcome },
    };
    // If the ring is full, the cycle drops records, as it does in real time. It never waits.
    let (sink, source) = record::ring(plan.ring_cycles, record::FullRing::Drops);
    let limits = Limits {
        cycle_period: plan.period,
        sync_period: plan.sync_period,
        ring_cycles: plan.ring_cycles,
        cycle_waits: false,
    };
    let place = writer.sink().place().clone();
    let progress = Arc::new(RunProgress::new(Arc::clone(source.handed()), limits, clock.clone()));
    progress.opened(place);
    let stop = Stop::default();
    storage.watch(&progress, &stop);
    let (marks, marks_rx) = sync_channel(100);
    let link = RunLink {
        marks: marks_rx,
        progress: Arc::clone(&progress),
        storage: storage.clone(),
        scheduler: world.scheduler(),
    };
    let recorder = Recorder::new(source, writer, &run, link);
    let first = clock.now();
    let ended = Rc::<RefCell<Ended>>::default();
    let looks = Rc::<RefCell<Vec<Look>>>::default();
    let plan = plan.clone();
    world.add(Cycle {
        plan,
        next: 0,
        first,
        sink: Some(sink),
        marks,
        stop,
        home: outcome.home(),
        ended: ended.clone(),
    });
    world.add(Writing { recorder: Some(recorder), ended: ended.clone(), clock: clock.clone() });
    world.add(Looker { storage, progress, wall: Arc::clone(&wall), first, looks: looks.clone() });
    while ended.borrow().result.is_none() {
        assert!(world.step(MonoNs(i64::MAX)), "no actor is due");
    }
    let Ended { result, at, last_cycle } = ended.take();
    Outcome {
        result: result.unwrap(),
        looks: looks.take(),
        struck: wall.struck_at().filter(|at| *at > first).map(|at| since(at, first)),
        finishing: since(at, last_cycle),
        first: UtcNs(first.0),
        ..outcome
    }
}

fn since(at: MonoNs, from: MonoNs) -> Duration {
    Duration::from_nanos(at.ns_since(from).max(0) as u64)
}

/// Result of a run, the instant of its end, and the instant of its last cycle.
#[derive(Default)]
struct Ended {
    result: Option<Result<RunSummary, WriteError>>,
    at: MonoNs,
    last_cycle: MonoNs,
}

/// Simulates the cycle: passes one record per period to the recorder and never waits.
struct Cycle {
    plan: Plan,
    next: u64,
    first: MonoNs,
    /// `None` after the last cycle.
    sink: Option<record::CycleSink>,
    marks: SyncSender<Marker>,
    stop: Stop,
    home: PathBuf,
    ended: Rc<RefCell<Ended>>,
}

impl Stepper for Cycle {
    fn poll(&mut self, now: MonoNs) -> Option<Duration> {
        let sink = self.sink.as_mut()?;
        let (cycle, period_ns) = (self.next, self.plan.period.as_nanos() as i64);
        if cycle == self.plan.cycles || sink.is_abandoned() {
            // The stop is set before the ring is dropped, as the real cycle does. While the file is being finished, it is
            // then not reported as lost.
            self.stop.stop("test over");
            self.sink = None;
            self.ended.borrow_mut().last_cycle = now;
            return None;
        }
        let at = self.first.plus_ns(period_ns * cycle as i64);
        sink.push(&record_of(cycle, UtcNs(at.0)));
        sink.push_timing(CycleTiming { late_ns: 1000, round_trip_ns: Some(1), duration_ns: 1 });
        if self.plan.marks.contains(&cycle) {
            // A marker is set in the middle of the cycle.
            let at = at.plus_ns(period_ns / 2);
            self.marks.send(Marker { at, text: format!("cycle {cycle}") }).unwrap();
        }
        if let Some((after, interfere)) = self.plan.interfere
            && after == cycle
        {
            interfere(&self.home);
        }
        self.next += 1;
        Some(since(self.first.plus_ns(period_ns * self.next as i64), now))
    }
}

/// Polls the recorder, and finishes the file at the end of the run.
struct Writing {
    recorder: Option<Recorder>,
    ended: Rc<RefCell<Ended>>,
    clock: Clock,
}

impl Stepper for Writing {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        let result = match self.recorder.as_mut()?.poll() {
            Ok(true) => return Some(Recorder::PERIOD),
            Ok(false) => self.recorder.take()?.finish("test over".into()),
            Err(error) => Err(error),
        };
        self.recorder = None;
        let mut ended = self.ended.borrow_mut();
        (ended.result, ended.at) = (Some(result), self.clock.now());
        None
    }
}

/// Observes the run and its disk every 5 ms.
struct Looker {
    storage: Storage,
    progress: Arc<RunProgress>,
    wall: Arc<Wall>,
    first: MonoNs,
    looks: Rc<RefCell<Vec<Look>>>,
}

impl Stepper for Looker {
    fn poll(&mut self, now: MonoNs) -> Option<Duration> {
        let (problem, snapshot) = (self.storage.problem(), self.progress.get());
        // The lengths are measured after the snapshot was taken, because they must include the data that the snapshot
        // reports. All lengths are those of one file.
        let file = std::fs::metadata(&snapshot.file).ok();
        let written_bytes = file.as_ref().map_or(0, Metadata::len);
        let synced_bytes = file.as_ref().map_or(0, |file| self.wall.synced_bytes(file.ino()));
        let (is_steady, at) = (file.is_some(), since(now, self.first));
        self.looks.borrow_mut().push(Look { snapshot, problem, synced_bytes, written_bytes, is_steady, at });
        Some(Duration::from_millis(5))
    }
}
