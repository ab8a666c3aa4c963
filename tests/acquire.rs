//! A run in real time on the simulated bus is complete, in order and whole.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use ballbard::run::BusChoice;
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
    for (number, cycle) in cycles.iter().enumerate() {
        assert_eq!(cycle.cycle, number as u64);
        assert_eq!(
            (cycle.working_counter, cycle.working_counter_expected),
            (15, 15),
            "cycle {number}: {cycle:?}"
        );
    }
    for pair in cycles.windows(2) {
        let step_ns = pair[1].sample_time.ns_since(pair[0].sample_time);
        assert!((9_000_000..11_000_000).contains(&step_ns), "{step_ns} ns after cycle {}", pair[0].cycle);
        assert_eq!(pair[1].dc_time.ns_since(pair[0].dc_time), 10_000_000);
    }
    let valid = cycles.iter().filter(|cycle| cycle.is_valid()).count();
    assert!(valid + 1 >= cycles.len(), "{} of {} cycles valid", valid, cycles.len());
    // Sample times are UTC of this machine.
    let ended_ago_s = (chrono::Utc::now().timestamp_nanos_opt().unwrap() - recording.end.ended.0) / NS_PER_S;
    assert!((0..30).contains(&ended_ago_s), "ended {ended_ago_s} s ago");
}
