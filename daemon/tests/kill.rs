//! `kill -9` at random instants costs at most one second, and what is left becomes a finished recording.
//!
//! 200 kills as a rule; `BALLBARD_KILLS` sets another number. Each process records for up to 2.5 s at 100 Hz, several at
//! once; two independent readers open each eighth of what is left. What the process had produced is known from outside by
//! its clock: a cycle each 10 ms since its first.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use shared::recording::{Recording, Recovery, recover_file};
use shared::time::{NS_PER_S, UtcNs};

/// Processes that record at the same time.
const AT_ONCE: usize = 8;
/// A second, the drain period of the ring, and what a busy machine adds to noticing the kill \[ns\].
const LOST_NS_MAX: i64 = NS_PER_S;
const SLACK_NS: i64 = 250_000_000;

fn kills() -> usize {
    std::env::var("BALLBARD_KILLS").ok().and_then(|text| text.parse().ok()).unwrap_or(200)
}

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
}

fn record(directory: &Path, name: &str) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ballbard"));
    command.env("RUST_LOG", "off").args(["record", "--name", name, "--config"]).arg(config());
    command.arg("--out").arg(directory).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Records, is killed after `life` counted from its file's appearance, and tells when that was.
fn record_and_kill(directory: &Path, name: &str, life: Duration) -> UtcNs {
    let mut child = record(directory, name);
    let active = directory.join(format!("{name}.mcap.active"));
    let begun = Instant::now();
    while !active.exists() {
        // With this many at once on a small machine the bus may not come up in time: then it is tried again.
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

/// Recovers what was left; gives what was lost \[ns\].
fn recover(directory: &Path, name: &str, killed: UtcNs) -> i64 {
    let active = directory.join(format!("{name}.mcap.active"));
    let Ok(Recovery::Recovered { file, content, .. }) = recover_file(&active) else {
        // Killed between its name and its first synchronisation: nothing but the name was there.
        let bytes = std::fs::metadata(&active).unwrap().len();
        assert!(bytes < 8192, "{name}: {bytes} bytes and nothing recovered");
        return 0;
    };
    let recording = Recording::open(&file).unwrap();
    assert!(recording.end.recovered && !active.exists());
    assert_eq!(recording.cycles.len() as u64, content.cycles);
    for pair in recording.cycles.windows(2) {
        assert_eq!(pair[1].cycle, pair[0].cycle + 1);
        assert!(pair[1].sample_time > pair[0].sample_time, "{name}: time runs backwards");
    }
    // The first synchronisation that had a cycle is followed by another: what it said is there.
    assert!(
        recording.timing.is_some() || recording.cycles.len() < 200,
        "{name}: nobody knows how late it was"
    );
    if name.ends_with("-0") {
        read_by_others(&file, &recording);
    }
    let last = recording.cycles.last().map_or(recording.run.started, |last| last.sample_time);
    killed.ns_since(last)
}

/// Two readers that are not ours decode every message of a recovered file; skipped where they are missing, not in CI.
fn read_by_others(file: &Path, ours: &Recording) {
    let Some(python) = std::env::var_os("BALLBAR_PYTHON") else {
        assert!(std::env::var_os("CI").is_none(), "set BALLBAR_PYTHON; see tests/requirements.txt");
        println!("skipped: other readers, BALLBAR_PYTHON is not set");
        return;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/read_recording.py");
    for reader in ["mcap", "rosbags"] {
        let output = Command::new(&python).arg(&script).arg(reader).arg(file).output().unwrap();
        assert!(output.status.success(), "{reader}: {}", String::from_utf8_lossy(&output.stderr));
        let theirs: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(theirs["cycles"].as_array().unwrap().len(), ours.cycles.len(), "{reader}");
        if reader == "mcap" {
            assert_eq!(theirs["timing"], serde_json::to_value(&ours.timing).unwrap());
        }
    }
}

#[test]
fn a_kill_at_any_instant_costs_at_most_a_second_and_leaves_a_readable_recording() {
    let directory = tempfile::tempdir().unwrap();
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(11);
    let lives: Vec<Duration> =
        (0..kills()).map(|_| Duration::from_micros(random.random_range(0..2_500_000))).collect();
    let mut lost_ns: Vec<i64> = Vec::new();
    for (batch, lives) in lives.chunks(AT_ONCE).enumerate() {
        let killed: Vec<(String, UtcNs)> = std::thread::scope(|scope| {
            let processes: Vec<_> = lives
                .iter()
                .enumerate()
                .map(|(index, life)| {
                    let name = format!("kill-{batch}-{index}");
                    let path = directory.path();
                    scope.spawn(move || {
                        let killed = record_and_kill(path, &name, *life);
                        (name, killed)
                    })
                })
                .collect();
            processes.into_iter().map(|process| process.join().unwrap()).collect()
        });
        lost_ns.extend(killed.iter().map(|(name, killed)| recover(directory.path(), name, *killed)));
    }
    let worst = lost_ns.iter().max().unwrap();
    println!("{} kills, at most {:.3} s lost", lost_ns.len(), *worst as f64 * 1e-9);
    assert!(*worst <= LOST_NS_MAX + SLACK_NS, "{worst} ns lost");
}
