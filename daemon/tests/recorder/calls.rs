//! Injects a fault into each disk call of a recorder. The call fails, hangs or transfers a single byte. Or the disk fails
//! from this call on.
//!
//! The method is that of SQLite's tests of I/O errors. A run without faults counts the calls. Then each fault is injected
//! into each call, in a separate run.

use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::Duration;

use shared::recording::Recording;
use shared::recording::schema::flags;

use super::rig::{Look, Outcome, Plan, record};
use crate::support::runs::in_parallel;
use crate::support::wall::{Call, Fault, Wall};

/// Duration of a hang that exceeds the time of a check of the disk.
const HANG: Duration = Duration::from_millis(1300);
/// Number of runs in parallel. A simulated run never waits, so it keeps one processor busy.
const AT_ONCE: usize = 4;

fn plan(cycles: u64) -> Plan {
    Plan {
        period: Duration::from_millis(5),
        cycles,
        sync_period: Duration::from_millis(100),
        ring_cycles: 4000,
        marks: Vec::new(),
        interfere: None,
    }
}

/// Removes the file of the run, so that the recorder must copy its data to a new file.
fn remove(home: &Path) {
    // If a fault has already moved the file, it does not exist here any more.
    let _ = std::fs::remove_file(home.join("run.mcap.active"));
}

#[derive(Debug, Clone, Copy)]
struct Case {
    call: Call,
    nth: usize,
    fault: Fault,
    is_removed: bool,
}

fn cases(cycles: u64) -> Vec<Case> {
    let mut cases = Vec::new();
    for is_removed in [false, true] {
        let clean = run_of(cycles, is_removed, None);
        clean.result.as_ref().unwrap();
        for (call, count) in clean.wall.calls() {
            for nth in 0..count {
                for fault in
                    [Fault::Fails, Fault::Dies, Fault::DiesEverywhere, Fault::Hangs(HANG), Fault::CutsShort]
                {
                    if fault != Fault::CutsShort || call.moves_bytes() {
                        cases.push(Case { call, nth, fault, is_removed });
                    }
                }
            }
        }
    }
    cases
}

fn run_of(cycles: u64, is_removed: bool, fault: Option<(Call, usize, Fault)>) -> Outcome {
    let interfere = is_removed.then_some((cycles / 2, remove as fn(&Path)));
    record(&Plan { interfere, ..plan(cycles) }, |home| Wall::new(home, fault))
}

/// Records a run with this fault. Data that were reported as safe must still exist, and every report must be true. The run
/// must either continue or end as it reports.
fn check(case: &Case, cycles: u64) {
    let Case { call, nth, fault, is_removed } = *case;
    // If a call hangs, the run must last long enough for a warning about the hang.
    let cycles = if matches!(fault, Fault::Hangs(_)) { cycles.max(320) } else { cycles };
    let outcome = run_of(cycles, is_removed, Some((call, nth, fault)));
    match &outcome.result {
        Ok(summary) => {
            let bytes = std::fs::read(&summary.path).unwrap();
            let inode = std::fs::metadata(&summary.path).unwrap().ino();
            assert_eq!(outcome.wall.synced_bytes(inode), bytes.len() as u64, "a power cut after the run");
            let recording = Recording::read(&bytes[..]).unwrap();
            assert_eq!((summary.cycles, summary.cycles_valid, summary.cycles_lost), (cycles, cycles, 0));
            assert!(recording.cycles.iter().all(|cycle| cycle.is_valid() && cycle.flags & flags::LOST == 0));
            assert_eq!(recording.cycles.len() as u64, cycles);
            assert!(!summary.path.with_extension("mcap.active").exists());
            // If the run has moved to another directory, the recorder must have reported the move and its reason.
            let is_elsewhere = |look: &Look| look.snapshot.file.starts_with(outcome.spare());
            assert!(!outcome.looks.iter().any(is_elsewhere) || outcome.was_told("the run continues in"));
            outcome.check_claims(&bytes);
        }
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains("run"), "no word of which file: {text}");
            if outcome.looks.is_empty() {
                // The run did not start. The recorder must have removed every file that it could remove.
                let left = std::fs::read_dir(outcome.home()).map_or(0, Iterator::count);
                assert!(left == 0 || fault != Fault::Fails || call == Call::Remove, "{left} files left");
            } else {
                assert_eq!(fault, Fault::DiesEverywhere, "the spare place was there: {text}");
                let left = [outcome.home(), outcome.spare()]
                    .iter()
                    .flat_map(|place| [place.join("run.mcap"), place.join("run.mcap.active")])
                    .find(|path| path.exists());
                // If the test itself has removed the file, there is nothing to check.
                if !is_removed {
                    outcome.check_claims(&std::fs::read(left.unwrap()).unwrap());
                }
            }
        }
    }
    if let (Fault::Hangs(_), Some(struck)) = (fault, outcome.struck) {
        let is_in_mid_run = struck + Duration::from_millis(500) < plan(1).period * cycles as u32;
        let word = match call {
            Call::Write | Call::Read => "wait to be written",
            Call::Sync => "a power failure now",
            _ => return,
        };
        assert!(!is_in_mid_run || outcome.was_told(word), "no report of {call:?}, which hung");
    }
}

fn check_all(cycles: u64) {
    let cases = cases(cycles);
    let calls = cases.iter().filter(|case| case.fault == Fault::Fails).count();
    in_parallel(&cases, AT_ONCE, |case| check(case, cycles));
    println!("{calls} calls, {} cases, 0 failures", cases.len());
}

#[test]
fn whichever_call_to_the_disk_goes_wrong_nothing_that_was_said_to_be_safe_is_lost() {
    check_all(60);
}

/// The lengths of the runs differ by more than the time between two calls of the recorder, so a run ends between the failure of
/// a synchronisation and the next call.
#[test]
fn a_run_is_safe_if_a_synchronisation_fails_just_before_its_end() {
    for cycles in 50..60 {
        let syncs = run_of(cycles, false, None).wall.calls()[&Call::Sync];
        for nth in 0..syncs {
            check(&Case { call: Call::Sync, nth, fault: Fault::Fails, is_removed: false }, cycles);
        }
    }
}

#[test]
#[ignore = "takes minutes: the same with a run ten times as long"]
fn whichever_call_of_a_long_run_goes_wrong_nothing_that_was_said_to_be_safe_is_lost() {
    check_all(600);
}
