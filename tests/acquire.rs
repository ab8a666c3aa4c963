//! A run that is recorded in real time on the simulated bus contains every cycle, in order, and the samples are valid.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use ballbard::run::BusChoice;
use shared::config::DaemonConfig;
use shared::recording::Recording;
use shared::recording::schema::{CycleRecord, flags};
use shared::time::NS_PER_S;
use system_tests::{ball_bar, daemon, record, record_run, request};

#[test]
#[ignore = "a minute of real time"]
fn sixty_seconds_in_real_time_give_6000_whole_cycles() {
    let directory = tempfile::tempdir().unwrap();
    let minute = Some(Duration::from_secs(60));
    let (_, recording) =
        record(directory.path(), &request("minute", BusChoice::Simulated, minute, false), &ball_bar());
    let cycles = &recording.cycles;
    assert!((5999..=6001).contains(&cycles.len()), "{} cycles", cycles.len());
    // A machine may stall for half a cycle, for example a busy host of virtual machines. It then misses deadlines or
    // replies. The recording flags these cycles, and also the cycle whose sample was fetched by a late frame.
    let missed = |cycle: &CycleRecord| cycle.flags & (flags::DEADLINE_MISSED | flags::NO_REPLY) != 0;
    for (number, cycle) in cycles.iter().enumerate() {
        assert_eq!(cycle.cycle, number as u64);
        assert_eq!(cycle.working_counter_expected, 15);
        let was_late = number > 0 && missed(&cycles[number - 1]);
        if !missed(cycle) {
            assert_eq!(cycle.working_counter, 15, "{cycle:?}");
            assert!(was_late || cycle.is_valid() && cycle.flags == 0, "{cycle:?}");
        }
    }
    let missed = cycles.iter().filter(|cycle| missed(cycle)).count();
    println!("{} cycles, {missed} missed by a stall", cycles.len());
    assert!(missed < cycles.len() / 2, "{missed} of {} cycles missed by a stall", cycles.len());
    for pair in cycles.windows(2) {
        let step_ns = pair[1].sample_time.ns_since(pair[0].sample_time);
        assert!((9_000_000..11_000_000).contains(&step_ns), "{step_ns} ns after cycle {}", pair[0].cycle);
        assert_eq!(pair[1].dc_time.ns_since(pair[0].dc_time), 10_000_000);
    }
    // Sample times are in UTC, and UTC is derived from this machine's clock. The run must therefore
    // have ended only seconds ago.
    let ended_ago_s = (chrono::Utc::now().timestamp_nanos_opt().unwrap() - recording.end.ended.0) / NS_PER_S;
    assert!((0..30).contains(&ended_ago_s), "ended {ended_ago_s} s ago");
}

#[test]
fn at_any_configured_rate_every_cycle_that_was_due_is_in_the_file() {
    let record_at = |rate_hz: u32| {
        let directory = tempfile::tempdir().unwrap();
        let daemon = DaemonConfig { rate_hz, ..daemon(directory.path()) };
        let request = request("rate", BusChoice::Simulated, Some(Duration::from_secs(5)), false);
        let summary = record_run(&request, &daemon, &ball_bar()).unwrap();
        let recording = Recording::open(&summary.path).unwrap();
        let due = 5 * rate_hz as usize;
        assert_eq!((recording.cycles.len(), summary.cycles_lost), (due, 0), "{rate_hz} Hz");
        // While the machine stalls, all cycles that are due are invalid. The cycle that then runs late is also invalid.
        let flagged = recording.cycles.iter().filter(|cycle| !cycle.is_valid()).count();
        assert!(flagged < due / 2, "{rate_hz} Hz: {flagged} flagged");
        for pair in recording.cycles.windows(2) {
            assert_eq!(pair[1].dc_time.ns_since(pair[0].dc_time), 1_000_000_000 / i64::from(rate_hz));
        }
        let timing = recording.timing.unwrap();
        println!("{rate_hz} Hz: {flagged} of {due} flagged\n{timing}");
        assert_eq!(Some(timing), summary.timing);
    };
    std::thread::scope(|scope| {
        for rate_hz in [250, 1000] {
            scope.spawn(move || record_at(rate_hz));
        }
    });
}
