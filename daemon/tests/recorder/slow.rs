//! Effects of slow disks on a recording. The tests check which effects occur, when they occur, and how they are reported.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ballbard::clock::Clock;
use ballbard::problem::Problem;
use ballbard::record::{self, Limits, Recorder, RunProgress, Snapshot};
use nix::fcntl::{AT_FDCWD, RenameFlags, renameat2};
use shared::recording::schema::{EventKind, flags};
use shared::recording::{Recording, RecordingWriter};

use super::rig::{Outcome, Plan, Way, record};
use crate::support::runs::{in_parallel, metadata};
use crate::support::wall::{Call, Fault, Wall};

/// Time between two calls of the recorder, which empty the ring \[s\].
const SLACK_S: f64 = Recorder::PERIOD.as_millis() as f64 * 1e-3;

fn plan(rate_hz: u32, seconds: f64) -> Plan {
    Plan {
        period: Duration::from_secs(1) / rate_hz,
        cycles: (seconds * f64::from(rate_hz)) as u64,
        sync_period: Duration::from_secs(1),
        ring_cycles: 60 * rate_hz as usize,
        marks: Vec::new(),
        interfere: None,
    }
}

fn recording_of(outcome: &Outcome) -> Recording {
    Recording::open(&outcome.result.as_ref().unwrap().path).unwrap()
}

/// Checks that each marker contains the instant at which it was set, and the number of the cycle at that instant.
fn check_marks(plan: &Plan, outcome: &Outcome, recording: &Recording) {
    let found: Vec<_> = recording.events.iter().filter(|event| event.kind == EventKind::Marker).collect();
    assert_eq!(found.len(), plan.marks.len());
    let period_ns = plan.period.as_nanos() as i64;
    for (mark, cycle) in found.iter().zip(&plan.marks) {
        let time = outcome.first.plus_ns(*cycle as i64 * period_ns + period_ns / 2);
        assert_eq!((mark.cycle, mark.time), (*cycle, time), "{mark:?}");
    }
}

fn check_slow_sync(rate_hz: u32, sync: Duration) {
    let sync_s = sync.as_secs_f64();
    let mut plan = plan(rate_hz, 4.0 + 2.0 * sync_s);
    plan.marks = vec![0, plan.cycles / 3, plan.cycles / 2, plan.cycles / 2 + 1];
    let outcome = record(&plan, |home| Wall::slow(home, sync));
    let recording = recording_of(&outcome);
    let lost = recording.cycles.iter().filter(|cycle| cycle.flags & flags::LOST != 0).count();
    assert_eq!((recording.cycles.len() as u64, lost), (plan.cycles, 0));
    outcome.check_claims(&std::fs::read(&outcome.result.as_ref().unwrap().path).unwrap());
    check_marks(&plan, &outcome, &recording);
    // The real disk also takes time for each synchronisation. The recording states the total time.
    let disk = recording.timing.unwrap().disk;
    let [longest_s, write_s] = [disk.sync_longest_ns, disk.write_longest_ns].map(|ns| ns as f64 * 1e-9);
    assert!(longest_s >= sync_s, "the file says {longest_s} s");
    let period_s = plan.sync_period.as_secs_f64();
    // The data that a kill would lose do not depend on how long a synchronisation takes. The data that a
    // power cut would lose do.
    let (kill_s, cut_s) = (outcome.worst(|seen| seen.backlog_s), outcome.worst(|seen| seen.unsynced_s));
    assert!(kill_s <= period_s + write_s + SLACK_S, "a kill costs {kill_s} s, a write {write_s} s");
    assert!(
        cut_s <= period_s + 2.0 * longest_s + SLACK_S,
        "a power cut costs {cut_s} s, a sync {longest_s} s"
    );
    let is_reported = outcome.was_told("a power failure now would cost");
    assert_eq!(is_reported, cut_s > 2.0 * period_s, "{sync_s} s, a power cut costs {cut_s} s");
    assert!(is_reported || sync_s < 1.0, "{sync_s} s");
    // Finishing the file waits for the synchronisation in progress, and then for the last one.
    let finishing_s = outcome.finishing.as_secs_f64();
    assert!(finishing_s < 2.0 * longest_s + 2.0, "finished {finishing_s} s after the end");
    println!(
        "{rate_hz:4} Hz, sync {sync_s:.1} s: {} cycles, {lost} lost; a kill costs {kill_s:.2} s, a power cut {cut_s:.2} s; \
         longest sync in the file {longest_s:.2} s; finished after {finishing_s:.2} s",
        plan.cycles
    );
}

#[test]
fn however_long_synchronisations_take_no_cycle_is_lost_and_what_is_said_to_be_safe_is() {
    let cases: Vec<_> = [0, 600, 1000, 3000]
        .into_iter()
        .flat_map(|sync_ms| [100, 1000].map(|rate_hz| (rate_hz, Duration::from_millis(sync_ms))))
        .collect();
    in_parallel(&cases, cases.len(), |(rate_hz, sync)| check_slow_sync(*rate_hz, *sync));
}

#[test]
#[ignore = "takes a minute"]
fn synchronisations_of_up_to_five_seconds() {
    let cases: Vec<_> = (0..=10).map(|halves| (1000, Duration::from_millis(500 * halves))).collect();
    in_parallel(&cases, 6, |(rate_hz, sync)| check_slow_sync(*rate_hz, *sync));
}

#[test]
fn while_a_write_hangs_cycles_and_markers_wait_and_that_is_reported() {
    let mut plan = plan(100, 5.0);
    // Markers are set before, during and after the hang.
    plan.marks = vec![50, 150, 250, 251, 450];
    let hang = Fault::Hangs(Duration::from_secs(3));
    let outcome = record(&plan, |home| Wall::new(home, Some((Call::Write, 3, hang))));
    let recording = recording_of(&outcome);
    assert!(recording.cycles.iter().all(|cycle| cycle.is_valid()) && recording.cycles.len() == 500);
    check_marks(&plan, &outcome, &recording);
    // While no data are lost yet, a warning must be reported that contains the true duration.
    assert!(outcome.was_told("wait to be written; above 60 s cycles are lost"));
    let backlog_s = outcome.worst(|seen| seen.backlog_s);
    assert!((2.9..3.5 + SLACK_S).contains(&backlog_s), "{backlog_s} s");
    let told = recording.timing.unwrap().disk;
    assert!(told.write_longest_ns >= 3_000_000_000 && told.backlog_longest_ns > 2_500_000_000, "{told:?}");
}

#[test]
fn cycles_that_a_full_ring_refuses_are_counted_at_once() {
    let plan = Plan { ring_cycles: 64, ..plan(100, 4.0) };
    let hang = Fault::Hangs(Duration::from_secs(2));
    let outcome = record(&plan, |home| Wall::new(home, Some((Call::Write, 3, hang))));
    let summary = outcome.result.as_ref().unwrap();
    assert!(summary.cycles_lost > 50, "{summary:?}");
    let struck = outcome.struck.unwrap();
    let while_it_hung = |at: Duration| at > struck && at < struck + Duration::from_secs(2);
    let mut told: Vec<u64> =
        outcome.looks.iter().filter(|look| while_it_hung(look.at)).map(|look| look.snapshot.lost).collect();
    // While the disk hangs, each report contains the number of lost cycles so far. The file contains the final number.
    told.dedup();
    assert!(told.len() > 20 && told.is_sorted(), "{told:?}");
    assert_eq!(outcome.looks.last().unwrap().snapshot.lost, summary.cycles_lost);
    assert!(outcome.was_told("cycles are lost"));
    let recording = recording_of(&outcome);
    let lost = recording.cycles.iter().filter(|cycle| cycle.flags & flags::LOST != 0).count() as u64;
    assert_eq!((recording.cycles.len() as u64, lost), (400, summary.cycles_lost));
}

#[test]
fn a_file_or_directory_that_vanishes_is_reported_within_a_second_and_the_run_goes_on() {
    let file = |home: &Path| std::fs::remove_file(home.join("run.mcap.active")).unwrap();
    // The directory is renamed before it is removed, because the run could otherwise add files during the removal.
    let directory = |home: &Path| {
        let gone = home.with_file_name("gone");
        std::fs::rename(home, &gone).unwrap();
        std::fs::remove_dir_all(gone).unwrap();
    };
    let moved = |home: &Path| std::fs::rename(home, home.with_file_name("elsewhere")).unwrap();
    let replaced = |home: &Path| {
        let in_the_way = home.with_file_name("in the way");
        // A path that is not a directory accepts no files. The run can therefore continue only in the spare directory.
        std::fs::write(&in_the_way, "in the way").unwrap();
        renameat2(AT_FDCWD, &in_the_way, AT_FDCWD, home, RenameFlags::RENAME_EXCHANGE).unwrap();
        std::fs::remove_dir_all(in_the_way).unwrap();
    };
    let ways: [(Way, &str); 4] = [(file, "runs"), (directory, "runs"), (moved, "runs"), (replaced, "spare")];
    in_parallel(&ways, ways.len(), |(way, place)| {
        let plan = Plan { interfere: Some((200, *way)), ..plan(100, 4.0) };
        let outcome = record(&plan, |home| Wall::new(home, None));
        let summary = outcome.result.as_ref().unwrap();
        assert_eq!(summary.path, outcome.directory.path().join(place).join("run.mcap"));
        let recording = recording_of(&outcome);
        assert!(recording.cycles.iter().all(|cycle| cycle.is_valid()) && recording.cycles.len() == 400);
        assert!(recording.events.iter().any(|event| event.kind == EventKind::Disk));
        let told = |snapshot: &Snapshot| Problem::line(&snapshot.problems).contains("not there any more");
        let first = outcome.looks.iter().find(|look| told(&look.snapshot)).unwrap();
        assert!(first.at < Duration::from_secs(3), "reported at {:?}", first.at);
    });
}

/// A check of a file takes as long as the disk needs. During this time, the run may move, and its new file may get the path
/// of the old one. The result of the check must not be applied to the new file.
#[test]
fn a_look_that_began_before_a_run_moved_reports_nothing_about_its_new_file() {
    let (directory, period) = (tempfile::tempdir().unwrap(), Duration::from_millis(10));
    let mut writer = RecordingWriter::create(directory.path(), &metadata(period)).unwrap();
    let (_sink, source) = record::ring(10, record::FullRing::Drops);
    let limits = Limits { cycle_period: period, sync_period: period, ring_cycles: 10, cycle_waits: false };
    let progress = RunProgress::new(Arc::clone(source.handed()), limits, Clock::Real);
    let before = writer.sink().place().clone();
    progress.opened(before.clone());
    std::fs::remove_file(before.path()).unwrap();
    progress.set_lost(&before, "it is gone".into());
    assert!(progress.lost().is_some());
    writer.sink_mut().move_to(directory.path()).unwrap();
    let after = writer.sink().place().clone();
    assert_eq!(after.path(), before.path());
    progress.moved(after, "it is gone".into());
    progress.set_lost(&before, "it is gone".into());
    assert_eq!(progress.lost(), None);
}
