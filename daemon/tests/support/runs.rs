//! Helpers that create configurations and runs of one encoder, and execute many test cases in parallel.

use std::fmt::Debug;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use ballbard::control::service::Settings;
use ballbard::homing::MarksFile;
use ballbard::run::BusChoice;
use shared::config::{self, BallBarConfig, DaemonConfig, Kind};
use shared::encoder::EncoderScale;
use shared::recording::RecordingWriter;
use shared::recording::schema::{CycleRecord, EncoderInfo, EncoderSample, RunMetadata};
use shared::time::UtcNs;

/// The default configuration without a limit of free space. Recordings are written to `runs` and `spare` in this directory.
pub fn daemon_in(directory: &Path) -> DaemonConfig {
    DaemonConfig {
        directory: directory.join("runs"),
        spare_directory: directory.join("spare"),
        disk_floor_mb: 0,
        ..DaemonConfig::default()
    }
}

/// The shipped `ball_bar.toml`.
pub fn bar() -> BallBarConfig {
    config::parse(Kind::BallBar.built_in("ball_bar"), Path::new("ball_bar.toml")).unwrap()
}

/// Settings of a service on the simulated bus with these faults. The file with the reference marks is in
/// the directory of the recordings.
pub fn settings(daemon: DaemonConfig, faults: &[&str]) -> Settings {
    Settings {
        bus: BusChoice::Simulated,
        faults: faults.iter().map(|fault| fault.parse().unwrap()).collect(),
        marks_file: MarksFile::new(daemon.directory.clone(), None),
        daemon,
        bar: bar(),
        live_tap: None,
    }
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

pub fn record_of(cycle: u64, time: UtcNs) -> CycleRecord {
    let mut record = CycleRecord { cycle, sample_time: time, encoder_count: 1, ..CycleRecord::default() };
    record.encoders[0] =
        EncoderSample { joint: 1, count: cycle as u32, valid: true, ..EncoderSample::default() };
    record
}

/// Writes a run with this number of cycles to `directory`. The file is either finished, or as a crash leaves it.
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
    // The file is copied while its writer holds the lock. Like the file of a killed process, the copy is not locked.
    let (file, _writer) = if is_finished {
        (writer.finish("test over", UtcNs(0)).unwrap(), None)
    } else {
        (writer.sink().place().path().to_owned(), Some(writer))
    };
    std::fs::copy(&file, directory.join(file.file_name().unwrap())).unwrap();
}

/// Runs all `cases`, `at_once` of them in parallel. Panics at the end with a list of the cases that failed.
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
