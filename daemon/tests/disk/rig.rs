//! A recorder between a cycle that goes on whatever happens and a disk, and somebody who looks at it.

use std::collections::HashMap;
use std::fmt::Debug;
use std::fs::Metadata;
use std::io::Cursor;
use std::os::unix::fs::MetadataExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use ballbard::clock::Clock;
use ballbard::cycle::CycleTiming;
use ballbard::problem::Problem;
use ballbard::record::{
    self, Limits, Mark, Progress, Recorder, RunLink, RunSummary, Snapshot, Stop, Storage,
};
use shared::config::DaemonConfig;
use shared::encoder::EncoderScale;
use shared::recording::schema::{CycleRecord, EncoderInfo, EncoderSample, RunMetadata};
use shared::recording::{RecordingWriter, WriteError, salvage};
use shared::time::{MonoNs, UtcNs};

use super::wall::Wall;

/// What is to be recorded.
#[derive(Debug, Clone)]
pub struct Plan {
    pub period: Duration,
    pub cycles: u64,
    pub sync_period: Duration,
    pub ring_cycles: usize,
    /// Cycles at whose instant somebody sets a marker.
    pub marks: Vec<u64>,
    /// After this cycle something is done to the directory.
    pub interfere: Option<(u64, Way)>,
}

/// Something that happens to the run's directory.
pub type Way = fn(&Path);

/// What was seen while it was recorded.
#[derive(Debug)]
pub struct Look {
    pub snapshot: Snapshot,
    /// Of the disk as a place for recordings.
    pub problem: Option<Problem>,
    /// Bytes of the run's file that would have survived a power cut then.
    pub synced_bytes: u64,
    /// Bytes that would have survived a kill.
    pub written_bytes: u64,
    /// The run was in one place while somebody looked.
    pub is_steady: bool,
    /// Since the run began.
    pub at: Duration,
}

/// What became of it.
pub struct Outcome {
    pub result: Result<RunSummary, WriteError>,
    pub looks: Vec<Look>,
    pub wall: Arc<Wall>,
    /// When the first cycle was.
    pub begun: Instant,
    /// From the last cycle to the end.
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

    /// The longest that anything was seen to be, over all looks.
    pub fn worst(&self, of: impl Fn(&Snapshot) -> f64) -> f64 {
        self.looks.iter().map(|look| of(&look.snapshot)).fold(0.0, f64::max)
    }

    /// Whoever looked was told something with this word in it.
    pub fn was_told(&self, word: &str) -> bool {
        let told = |look: &Look| {
            let is_in = |problem: &Problem| problem.text.contains(word);
            look.snapshot.problems.iter().chain(&look.problem).any(is_in)
        };
        self.looks.iter().any(told)
    }

    /// What was said to be safe when somebody looked is in what `bytes` begins with: the file of today has the same
    /// bytes as that of then, and more.
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

/// Cycles that can be taken out of the first `length` bytes.
fn cycles_in(bytes: &[u8], length: u64) -> u64 {
    let cut = &bytes[..bytes.len().min(length as usize)];
    salvage(Cursor::new(cut), Cursor::new(Vec::new()))
        .map_or(0, |(salvaged, _)| salvaged.cycles - salvaged.cycles_lost)
}

pub fn metadata(period: Duration) -> RunMetadata {
    RunMetadata {
        name: "run".into(),
        operator: String::new(),
        robot: String::new(),
        bar: String::new(),
        payload: String::new(),
        note: String::new(),
        started: UtcNs(0),
        software: String::new(),
        bus: String::new(),
        replay_of: None,
        cycle_period_ns: period.as_nanos() as u64,
        distributed_clocks: true,
        utc_minus_monotonic_ns: 0,
        encoders: vec![EncoderInfo { joint: 1, scale: EncoderScale::default() }],
        devices: Vec::new(),
        daemon_config: String::new(),
        ball_bar_config: String::new(),
    }
}

fn record_of(cycle: u64, time: UtcNs) -> CycleRecord {
    let mut record = CycleRecord { cycle, sample_time: time, encoder_count: 1, ..CycleRecord::default() };
    record.encoders[0] =
        EncoderSample { joint: 1, count: cycle as u32, valid: true, ..EncoderSample::default() };
    record
}

/// A run of so many cycles as a crash leaves it, or finished.
pub fn leave(directory: &Path, name: &str, cycles: u64, is_finished: bool) {
    let period = Duration::from_millis(10);
    let run = RunMetadata { name: name.into(), ..metadata(period) };
    let elsewhere = tempfile::tempdir().unwrap();
    let mut writer = RecordingWriter::create(elsewhere.path(), &run).unwrap();
    for cycle in 0..cycles {
        writer.write_cycle(&record_of(cycle, UtcNs(0).plus_ns(cycle as i64 * 10_000_000))).unwrap();
        if cycle % 20 == 19 {
            writer.cut().unwrap();
        }
    }
    // Copied while it is locked: whoever has the lock is not killed with it.
    let (file, _writer) = if is_finished {
        (writer.finish("test over", UtcNs(0)).unwrap(), None)
    } else {
        (writer.sink().place().path().to_owned(), Some(writer))
    };
    std::fs::copy(&file, directory.join(file.file_name().unwrap())).unwrap();
}

/// Records on a disk; the file cannot even be begun where the result says so and nobody looked.
pub fn record(plan: &Plan, wall: impl FnOnce(&Path) -> Wall) -> Outcome {
    let directory = tempfile::tempdir().unwrap();
    let daemon = DaemonConfig {
        directory: directory.path().join("runs"),
        spare_directory: directory.path().join("spare"),
        disk_floor_mb: 0,
        ..DaemonConfig::default()
    };
    let wall = Arc::new(wall(&daemon.directory));
    let storage = Storage::on(wall.clone(), &daemon).unwrap();
    let run = metadata(plan.period);
    let mut outcome = Outcome {
        result: Err(WriteError::Lost(PathBuf::new())),
        looks: Vec::new(),
        wall: Arc::clone(&wall),
        begun: Instant::now(),
        finishing: Duration::ZERO,
        first: UtcNs(0),
        directory,
    };
    let writer = match RecordingWriter::create_on(storage.disk(), storage.directory(), &run) {
        Ok(writer) => writer,
        Err(error) => return Outcome { result: Err(error), ..outcome },
    };
    let (sink, source) = record::ring(plan.ring_cycles, &Clock::Real);
    let limits = Limits {
        cycle_period: plan.period,
        sync_period: plan.sync_period,
        ring_cycles: plan.ring_cycles,
        cycle_waits: false,
    };
    let place = writer.sink().place().clone();
    let progress = Arc::new(Progress::new(Arc::clone(source.handed()), limits, Clock::Real));
    progress.opened(place);
    let stop = Stop::default();
    storage.watch(&progress, &stop);
    let (marks, marks_rx) = sync_channel(100);
    let link = RunLink { marks: marks_rx, progress: Arc::clone(&progress), storage: storage.clone() };
    let recorder = Recorder::new(source, writer, Clock::Real, plan.sync_period, &run, link);
    let begun = Instant::now();
    outcome.begun = begun;
    let first = Clock::Real.now();
    outcome.first = UtcNs(first.0);
    let (home, mut looks) = (outcome.home(), Vec::new());
    thread::scope(|scope| {
        let cycle = scope.spawn(|| produce(plan, first, sink, &marks, &stop, &home, begun));
        let recording = scope.spawn(move || {
            let result = recorder.run(|| "test over".into());
            (result, Instant::now())
        });
        while !recording.is_finished() {
            let (problem, snapshot) = (storage.problem(), progress.get());
            // Measured after the snapshot, whose claims it must cover; all of one file.
            let file = std::fs::metadata(&snapshot.file).ok();
            let written_bytes = file.as_ref().map_or(0, Metadata::len);
            let synced_bytes = file.as_ref().map_or(0, |file| wall.synced_bytes(file.ino()));
            let at = begun.elapsed();
            // While it moves it is neither here nor there, and a file that was just removed is not missed yet. It is reported
            // lost before another one takes its name, so that this is looked at last.
            let places = |of: &Snapshot| {
                of.problems.iter().filter(|one| ["file_lost", "file_moved"].contains(&one.code())).count()
            };
            let is_steady = file.is_some() && places(&progress.get()) == places(&snapshot);
            looks.push(Look { snapshot, problem, synced_bytes, written_bytes, is_steady, at });
            thread::sleep(Duration::from_millis(5));
        }
        let last_cycle_at = cycle.join().unwrap();
        let (result, ended) = recording.join().unwrap();
        outcome.result = result;
        outcome.looks = looks;
        outcome.finishing = ended.saturating_duration_since(last_cycle_at);
    });
    outcome
}

/// The cycle: one record a period, come what may.
fn produce(
    plan: &Plan,
    first: MonoNs,
    mut sink: record::CycleSink,
    marks: &SyncSender<Mark>,
    stop: &Stop,
    home: &Path,
    begun: Instant,
) -> Instant {
    for cycle in 0..plan.cycles {
        let since = plan.period * cycle as u32;
        thread::sleep(since.saturating_sub(begun.elapsed()));
        let at = first.plus_ns(since.as_nanos() as i64);
        sink.push(&record_of(cycle, UtcNs(at.0)));
        sink.push_timing(CycleTiming { late_ns: 1000, round_trip_ns: Some(1), duration_ns: 1 });
        if plan.marks.contains(&cycle) {
            // In the middle of the cycle.
            let at = at.plus_ns(plan.period.as_nanos() as i64 / 2);
            marks.send(Mark { at, text: format!("cycle {cycle}") }).unwrap();
        }
        if let Some((after, interfere)) = plan.interfere
            && after == cycle
        {
            interfere(home);
        }
        if sink.is_abandoned() {
            break;
        }
    }
    // Before the ring is dropped, as the cycle does it: nobody misses a file that is being finished.
    stop.stop("test over");
    drop(sink);
    Instant::now()
}

/// Takes what is to be done from `cases`, so many at once; all of them, and what failed is named at the end.
pub fn in_parallel<T: Sync + Debug>(cases: &[T], at_once: usize, body: impl Fn(&T) + Sync) {
    let (next, failed) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = || {
        while let Some(case) = cases.get(next.fetch_add(1, Ordering::Relaxed)) {
            if catch_unwind(AssertUnwindSafe(|| body(case))).is_err() {
                failed.lock().unwrap().push(format!("{case:?}"));
            }
        }
    };
    thread::scope(|scope| {
        for _ in 0..at_once {
            scope.spawn(work);
        }
    });
    let failed = failed.into_inner().unwrap();
    assert!(failed.is_empty(), "{} of {} cases: {failed:#?}", failed.len(), cases.len());
}
