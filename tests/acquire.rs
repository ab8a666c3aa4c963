//! A run in real time on the simulated bus is complete, in order and whole.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use ballbard::run::BusChoice;
use shared::recording::schema::{CycleRecord, flags};
use shared::time::NS_PER_S;
use system_tests::{ball_bar, record, request};

#[test]
fn sixty_seconds_in_real_time_give_6000_whole_cycles() {
    let directory = tempfile::tempdir().unwrap();
    let minute = Some(Duration::from_secs(60));
    let (_, recording) =
        record(directory.path(), &request("minute", BusChoice::Simulated, minute, false), &ball_bar());
    let cycles = &recording.cycles;
    assert!((5999..=6001).contains(&cycles.len()), "{} cycles", cycles.len());
    // A machine that stalls for more than half a cycle (a busy host under this one) misses deadlines: then the file says
    // so, and for these cycles alone.
    let on_time = |cycle: &&CycleRecord| cycle.flags & flags::DEADLINE_MISSED == 0;
    for (number, cycle) in cycles.iter().enumerate() {
        assert_eq!(cycle.cycle, number as u64);
        assert_eq!(cycle.working_counter_expected, 15);
    }
    for cycle in cycles.iter().filter(on_time) {
        assert_eq!(cycle.working_counter, 15, "{cycle:?}");
        assert!(cycle.is_valid() && cycle.flags == 0, "{cycle:?}");
    }
    let missed = cycles.len() - cycles.iter().filter(on_time).count();
    println!("{} cycles, {missed} missed their deadline", cycles.len());
    assert!(missed < 60, "{missed} of {} cycles missed their deadline", cycles.len());
    for pair in cycles.windows(2) {
        let step_ns = pair[1].sample_time.ns_since(pair[0].sample_time);
        assert!((9_000_000..11_000_000).contains(&step_ns), "{step_ns} ns after cycle {}", pair[0].cycle);
        assert_eq!(pair[1].dc_time.ns_since(pair[0].dc_time), 10_000_000);
    }
    // Sample times are UTC of this machine.
    let ended_ago_s = (chrono::Utc::now().timestamp_nanos_opt().unwrap() - recording.end.ended.0) / NS_PER_S;
    assert!((0..30).contains(&ended_ago_s), "ended {ended_ago_s} s ago");
}
