//! Injects a fault into each write of the log. The write fails, hangs or transfers a single byte. Or the disk
//! fails from this write on. A thread that logs must never wait. If lines are missing, the log must state
//! their number at this position.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ballbard::log::Lines;

use crate::support::runs::in_parallel;
use crate::support::wall::{Call, Fault, Wall};

const LINES: usize = 20;
/// Duration of a hang. It is longer than the shutdown of the program may take, even on a busy machine.
const HANG: Duration = Duration::from_secs(10);

fn check(nth: usize, fault: Fault) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("log");
    let wall = Arc::new(Wall::new(Path::new("/"), Some((Call::Append, nth, fault))));
    let lines = Lines::start(wall.clone(), File::create(&path).unwrap().into()).unwrap();
    let begun = Instant::now();
    (0..LINES).for_each(|number| lines.line(&format!("line {number}")));
    assert!(begun.elapsed() < HANG / 2, "it waited {:?}", begun.elapsed());
    lines.flush();
    assert!(begun.elapsed() < HANG, "its end waited {:?}", begun.elapsed());
    // Only the test itself waits here: for the end of the write that hangs, or for a busy machine.
    wall.release();
    while !lines.flush() {}
    let text = std::fs::read_to_string(path).unwrap();
    let is_there = |number: &usize| text.lines().any(|line| line == format!("line {number}"));
    let missing = (0..LINES).filter(|number| !is_there(number)).count();
    assert_eq!(lines.lost(), missing as u64, "{text}");
    let expected = match fault {
        Fault::Hangs(_) | Fault::CutsShort => 0,
        Fault::Fails => 1,
        Fault::Dies | Fault::DiesEverywhere => LINES - nth,
    };
    assert_eq!(missing, expected, "{text}");
    let is_told = text.contains(&format!("({missing} lines of the log are missing here)"));
    assert_eq!(is_told, fault == Fault::Fails && nth + 1 < LINES, "{text}");
}

#[test]
fn whichever_write_of_the_log_goes_wrong_nobody_waits_and_what_is_missing_is_said() {
    let faults = [Fault::Fails, Fault::DiesEverywhere, Fault::Hangs(HANG), Fault::CutsShort];
    let cases: Vec<_> = (0..LINES).flat_map(|nth| faults.map(|fault| (nth, fault))).collect();
    in_parallel(&cases, LINES, |(nth, fault)| check(*nth, *fault));
    println!("{LINES} calls, {} cases, 0 failures", cases.len());
}
