//! `kill -9` at a random instant loses at most one second of data. The file that remains can be
//! recovered to a finished recording.
//!
//! The tests kill several processes. Each process records at 100 Hz for up to 2.5 s. The number of cycles that were due is
//! known from the clock: since the first cycle, one cycle is due every 10 ms.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use shared::recording::{Recording, Recovery, recover_file};
use shared::time::{NS_PER_S, UtcNs};

use crate::support::ballbard;

/// Number of processes that record in parallel.
const AT_ONCE: usize = 6;
/// Longest time whose data a kill may lose, one second \[ns\]. [`SLACK_NS`] is added to this time. It covers the period in
/// which the ring is emptied, and the delay with which a busy machine carries out the kill.
const LOST_NS_MAX: i64 = NS_PER_S;
const SLACK_NS: i64 = 250_000_000;

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
}

fn record(directory: &Path, name: &str) -> Child {
    let mut command = ballbard();
    command
        .env("RUST_LOG", "off")
        .args(["record", "--bus", "simulated", "--name", name, "--config"])
        .arg(config());
    command.arg("--out").arg(directory).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Starts a recording, and kills the process when its file has existed for the time `life`. Returns the instant of the kill.
fn record_and_kill(directory: &Path, name: &str, life: Duration) -> UtcNs {
    let mut child = record(directory, name);
    let active = directory.join(format!("{name}.mcap.active"));
    let begun = Instant::now();
    while !active.exists() {
        // With this many processes, the bring-up on a small machine may time out. The recording is then started again.
        if child.try_wait().unwrap().is_some() {
            child = record(directory, name);
        }
        assert!(begun.elapsed() < Duration::from_secs(60), "{name} never began");
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(life);
    let killed = UtcNs::from_datetime(chrono::Utc::now());
    child.kill().unwrap();
    child.wait().unwrap();
    killed
}

/// Files that a killed process left.
struct Left {
    /// Time between the last recorded cycle and the kill \[ns\].
    lost_ns: i64,
    /// The recovered file and its content. `None` if the killed process left only an empty file.
    recovered: Option<(PathBuf, Recording)>,
}

/// Recovers the file of a killed process and checks its cycles. `killed` is the instant of the kill.
fn recover(directory: &Path, name: &str, killed: UtcNs) -> Left {
    let active = directory.join(format!("{name}.mcap.active"));
    let Ok(Recovery::Recovered { file, content, .. }) = recover_file(&active) else {
        // If the file is empty, the process was killed after it created the file and before the first synchronisation.
        let bytes = std::fs::metadata(&active).unwrap().len();
        assert!(bytes < 8192, "{name}: {bytes} bytes and nothing recovered");
        return Left { lost_ns: 0, recovered: None };
    };
    let recording = Recording::open(&file).unwrap();
    assert!(recording.end.recovered && !active.exists());
    assert_eq!(recording.cycles.len() as u64, content.cycles);
    for pair in recording.cycles.windows(2) {
        assert_eq!(pair[1].cycle, pair[0].cycle + 1);
        assert!(pair[1].sample_time > pair[0].sample_time, "{name}: time runs backwards");
    }
    // After 200 cycles, at least one more synchronisation has followed the first one, so the file must contain the timing.
    assert!(recording.timing.is_some() || recording.cycles.len() < 200, "{name}: the timing is missing");
    let last = recording.cycles.last().map_or(recording.run.started, |last| last.sample_time);
    Left { lost_ns: killed.ns_since(last), recovered: Some((file, recording)) }
}

/// Checks that two independent readers decode every message of the recovered files.
fn read_by_others(recovered: &[(PathBuf, Recording)]) {
    let python = std::env::var_os("BALLBAR_PYTHON").unwrap_or_else(|| "python3".into());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/read_recording.py");
    let read = |reader: &str| {
        let files = recovered.iter().map(|(file, _)| file);
        let output = Command::new(&python).arg(&script).arg(reader).args(files).output().unwrap();
        assert!(output.status.success(), "{reader}: {}", String::from_utf8_lossy(&output.stderr));
        let theirs = serde_json::Deserializer::from_slice(&output.stdout).into_iter::<serde_json::Value>();
        let theirs: Vec<_> = theirs.map(Result::unwrap).collect();
        assert_eq!(theirs.len(), recovered.len());
        for ((file, ours), theirs) in recovered.iter().zip(&theirs) {
            assert_eq!(theirs["cycles"].as_array().unwrap().len(), ours.cycles.len(), "{}", file.display());
            if reader == "mcap" {
                assert_eq!(theirs["timing"], serde_json::to_value(&ours.timing).unwrap());
            }
        }
    };
    std::thread::scope(|scope| {
        for reader in ["mcap", "rosbags"] {
            scope.spawn(move || read(reader));
        }
    });
}

/// Kills this number of processes. Returns the recovered runs of all processes that had recorded at least one cycle.
fn kill_at_random(directory: &Path, kills: usize) -> Vec<(PathBuf, Recording)> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(11);
    let lives: Vec<Duration> =
        (0..kills).map(|_| Duration::from_micros(random.random_range(0..2_500_000))).collect();
    let next = AtomicUsize::new(0);
    let one_after_the_other = || {
        let mut left: Vec<Left> = Vec::new();
        while let index = next.fetch_add(1, Ordering::Relaxed)
            && let Some(life) = lives.get(index)
        {
            let name = format!("kill-{index}");
            // A process recovers the unfinished files in its directory when it starts, so each process needs
            // a directory of its own.
            let own = directory.join(&name);
            std::fs::create_dir(&own).unwrap();
            let killed = record_and_kill(&own, &name, *life);
            left.push(recover(&own, &name, killed));
        }
        left
    };
    let left: Vec<Left> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..AT_ONCE).map(|_| scope.spawn(one_after_the_other)).collect();
        workers.into_iter().flat_map(|worker| worker.join().unwrap()).collect()
    });
    let worst = left.iter().map(|one| one.lost_ns).max().unwrap();
    let recovered: Vec<(PathBuf, Recording)> = left.into_iter().filter_map(|one| one.recovered).collect();
    println!("{kills} kills, at most {:.3} s lost, {} recovered", worst as f64 * 1e-9, recovered.len());
    assert!(worst <= LOST_NS_MAX + SLACK_NS, "{worst} ns lost");
    recovered
}

#[test]
fn a_kill_at_any_instant_costs_at_most_a_second_and_leaves_a_readable_recording() {
    let directory = tempfile::tempdir().unwrap();
    assert!(!kill_at_random(directory.path(), AT_ONCE).is_empty());
}

#[test]
#[ignore = "200 kills take two minutes, and two other readers need Python with tests/requirements.txt"]
fn after_200_kills_two_other_readers_open_all_that_is_left() {
    let directory = tempfile::tempdir().unwrap();
    read_by_others(&kill_at_random(directory.path(), 200));
}
