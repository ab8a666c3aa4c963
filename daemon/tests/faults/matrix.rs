//! The fault matrix. Each row contains faults, the flags that the records may have, and how long samples may be invalid.

use ballbard::problem::CODES;
use ballbard::segment::faults::Fault;
use shared::recording::schema::{EventKind, flags};

use super::rig::Rig;

/// Number of the cycle at which the faults begin.
const BEGIN: usize = 200;

struct Row {
    name: &'static str,
    /// Each fault, with its duration in cycles.
    faults: &'static [(Fault, usize)],
    /// Flags that are permitted in cycles without a valid sample.
    flags: u32,
    /// Largest number of cycles from the end of the last fault to the first valid cycle.
    recovered_within: usize,
    /// True if the counters have a new origin after the fault.
    origin_changed: bool,
    /// Texts that the events must contain.
    told: &'static [&'static str],
}

const LOST: Fault = Fault::FrameLost { share: 1.0 };
const TENTH_LOST: Fault = Fault::FrameLost { share: 0.1 };
const CORRUPTED: Fault = Fault::FrameCorrupted { share: 0.5 };
const DUPLICATED: Fault = Fault::FrameDuplicated { share: 1.0 };
const fn late(by_ms: i64) -> Fault {
    Fault::FrameLate { share: 1.0, by_ns: by_ms * 1_000_000 }
}
const fn short(by: u16) -> Fault {
    Fault::WorkingCounterShort { share: 1.0, by }
}
const fn gone(from: usize) -> Fault {
    Fault::DevicesGone { from }
}
const fn safe_op(position: usize) -> Fault {
    Fault::FallToSafeOp { position, code: 0x001a }
}
const fn step(by_ms: i64) -> Fault {
    Fault::ClockStep { by_ns: by_ms * 1_000_000 }
}
const ABORT: Fault = Fault::MailboxAbort { position: 2, code: 0x0800_0022 };
const SILENT: Fault = Fault::MailboxSilent { position: 3 };
const EMERGENCY: Fault = Fault::MailboxEmergency { position: 1, code: 0xff00 };

/// Number of cycles that a bring-up of the bus takes, about 0.7 s.
const BRING_UP: usize = 90;
const SILENCE: u32 = flags::NO_REPLY | flags::STALE_INPUT | flags::TERMINAL_ERROR;
const DOWN: u32 = flags::BUS_DOWN;
const GONE: u32 =
    flags::WORKING_COUNTER | flags::NOT_OPERATIONAL | flags::STALE_INPUT | flags::TERMINAL_ERROR;

const fn row(
    name: &'static str,
    faults: &'static [(Fault, usize)],
    flags: u32,
    recovered_within: usize,
    told: &'static [&'static str],
) -> Row {
    Row { name, faults, flags, recovered_within, origin_changed: false, told }
}

const fn powered_off(row: Row) -> Row {
    Row { origin_changed: true, ..row }
}

const UP: &str = "bus in operation again";

#[rustfmt::skip]
const ROWS: [Row; 30] = [
    row("one frame lost", &[(LOST, 1)], SILENCE, 2, &["no_reply"]),
    row("all frames lost for 0.3 s", &[(LOST, 30)], SILENCE, 2, &["no_reply"]),
    row("replies 6 ms late for 0.5 s", &[(late(6), 50)], SILENCE, 2, &["no_reply"]),
    row("replies 25 ms late for 0.5 s", &[(late(25), 50)], SILENCE, 2, &["no_reply"]),
    row("replies duplicated for 0.5 s", &[(DUPLICATED, 50)], 0, 0, &[]),
    row("half of the frames corrupted for 0.3 s", &[(CORRUPTED, 30)], SILENCE | GONE | DOWN, BRING_UP, &["no_reply"]),
    row("working counter 1 short, once", &[(short(1), 1)], GONE, 2, &["working_counter"]),
    row("working counter 3 short for 50 ms", &[(short(3), 5)], GONE, 2, &["working_counter"]),
    row("working counter 3 short for 2 s", &[(short(3), 200)], GONE | DOWN, 2 * BRING_UP, &["working_counter", UP]),
    row("terminal 3 falls to SAFE-OP", &[(safe_op(3), 1)], GONE, 3, &["terminal 3 fell to SAFE-OP, AL status code 0x001a"]),
    row("all terminals fall to SAFE-OP", &[(safe_op(1), 1), (safe_op(2), 1), (safe_op(3), 1), (safe_op(4), 1), (safe_op(5), 1)],
        GONE, 3, &["terminal 1 fell", "terminal 5 fell"]),
    row("every tenth frame lost for 3 s", &[(TENTH_LOST, 300)], SILENCE, 2, &["no_reply"]),
    row("signal of one encoder lost for 1 s", &[(Fault::SignalLost { position: 4 }, 100)], flags::TERMINAL_ERROR, 2, &["samples of joint 4: terminal_error"]),
    row("signal of one encoder too fast for 1 s", &[(Fault::SignalTooFast { position: 1 }, 100)], flags::TERMINAL_ERROR, 2, &["samples of joint 1: terminal_error"]),
    row("late, doubled and lost at once for 1 s", &[(late(6), 100), (DUPLICATED, 100), (TENTH_LOST, 100)], SILENCE, 2, &["no_reply"]),
    row("link down while a terminal falls to SAFE-OP", &[(Fault::LinkDown, 20), (safe_op(2), 20)], SILENCE | GONE, 5, &["no_reply"]),
    powered_off(row("terminals gone from 3 on for 1 s", &[(gone(3), 100)], GONE | DOWN, BRING_UP, &["lost its address", UP, "without power"])),
    powered_off(row("terminals gone from 3 on for 10 ms", &[(gone(3), 1)], GONE | DOWN, BRING_UP, &["lost its address", UP, "without power"])),
    powered_off(row("last terminal gone for 5 s", &[(gone(5), 500)], GONE | DOWN, BRING_UP, &["lost its address", UP, "without power"])),
    powered_off(row("coupler without power for 0.5 s", &[(gone(0), 50)], SILENCE | GONE | DOWN | flags::NO_DC, BRING_UP + 5, &[UP, "without power"])),
    powered_off(row("coupler without power for 5 s", &[(gone(0), 500)], SILENCE | DOWN, BRING_UP, &["no EtherCAT device answers on simulated", UP, "without power"])),
    row("link down for 0.5 s", &[(Fault::LinkDown, 50)], SILENCE, 2, &["no_reply"]),
    row("link down for 5 s", &[(Fault::LinkDown, 500)], SILENCE | DOWN, BRING_UP, &["no EtherCAT device answers on simulated", UP]),
    row("reference clock 50 us ahead", &[(Fault::ClockStep { by_ns: 50_000 }, 1)], SILENCE | DOWN, BRING_UP + 4, &["jumped by 0.050 ms", UP]),
    row("reference clock 3 ms ahead", &[(step(3), 1)], flags::NO_DC | SILENCE | DOWN, BRING_UP + 4, &["jumped by 3.000 ms", UP]),
    row("reference clock 3 ms back", &[(step(-3), 1)], flags::NO_DC | SILENCE | DOWN, BRING_UP + 4, &["jumped by -3.000 ms", UP]),
    row("reference clock an hour ahead", &[(step(3_600_000), 1)], flags::NO_DC | SILENCE | DOWN, BRING_UP + 4, &["the reference clock jumped by 36000", UP]),
    powered_off(row("mailbox aborts for 3 s after a power cycle", &[(gone(3), 20), (ABORT, 300)], GONE | DOWN, BRING_UP + 60, &["attempts", "without power"])),
    powered_off(row("mailbox silent for 3 s after a power cycle", &[(gone(3), 20), (SILENT, 300)], GONE | DOWN, 2 * BRING_UP + 100, &["attempts", "without power"])),
    powered_off(row("emergency after a power cycle", &[(gone(3), 20), (EMERGENCY, 20)], GONE | DOWN, 2 * BRING_UP + 60, &["attempts", "without power"])),
];

/// Result of a row: number of cycles without a valid sample, flags of these cycles, and number of cycles until recovery.
struct Outcome {
    flagged: usize,
    flags: u32,
    recovered: usize,
}

fn play(row: &Row) -> (Rig, Outcome) {
    let mut rig = Rig::new(8);
    rig.run_to(BEGIN);
    row.faults.iter().for_each(|(fault, _)| rig.faults.begin(*fault));
    let mut ends: Vec<(Fault, usize)> = row.faults.to_vec();
    ends.sort_by_key(|(_, cycles)| *cycles);
    let mut end = BEGIN;
    for (fault, cycles) in ends {
        rig.run_to(BEGIN + cycles);
        rig.faults.end(fault);
        end = rig.records.len();
    }
    rig.run_to(end + 400);
    let affected: Vec<_> = rig.records.iter().filter(|record| !record.is_valid()).collect();
    let recovered = affected.last().map_or(0, |last| (last.cycle as usize + 1).saturating_sub(end));
    let flags = affected.iter().fold(0, |flags, record| flags | record.flags);
    let outcome = Outcome { flagged: affected.len(), flags, recovered };
    (rig, outcome)
}

fn names(set: u32) -> String {
    let names: Vec<_> =
        flags::NAMES.iter().filter(|(bit, _)| set & bit != 0).map(|(_, name)| *name).collect();
    if names.is_empty() { "-".into() } else { names.join(" ") }
}

#[test]
fn every_fault_is_survived_flagged_and_over_when_it_is_over() {
    println!("{:44} {:>7} {:>9}  {:>6}  reasons", "fault", "flagged", "recovered", "origin");
    for row in &ROWS {
        let (rig, outcome) = play(row);
        let origins = rig.records.last().unwrap().origin;
        let origin = if origins > 0 { "new" } else { "same" };
        println!(
            "{:44} {:>7} {:>6} ms  {origin:>6}  {}",
            row.name,
            outcome.flagged,
            outcome.recovered * 10,
            names(outcome.flags)
        );
        rig.assert_complete();
        rig.assert_true();
        let name = row.name;
        assert_eq!(
            outcome.flags & !row.flags & !flags::DEADLINE_MISSED,
            0,
            "{name}: {}",
            names(outcome.flags)
        );
        assert!(outcome.recovered <= row.recovered_within, "{name}: {} cycles", outcome.recovered);
        assert_eq!(origins, u32::from(row.origin_changed), "{name}: {:?}", rig.events);
        assert!(rig.records.last().unwrap().is_valid(), "{name}");
        let events = rig.reported_events();
        for text in row.told {
            assert!(
                events.iter().any(|event| event.text.contains(text)),
                "{name}: {text} not in {events:#?}"
            );
        }
        assert!(events.iter().all(|event| CODES.contains(&event.code.as_str())), "{name}: {events:?}");
        assert_eq!(outcome.flagged > 0, events.iter().any(|event| event.kind == EventKind::Gap), "{name}");
    }
}

#[test]
fn terminals_before_missing_ones_stay_in_use_until_all_are_back() {
    let mut rig = Rig::new(8);
    rig.run_to(BEGIN);
    rig.faults.begin(gone(3));
    rig.run_to(BEGIN + 500);
    rig.faults.end(gone(3));
    rig.run_to(BEGIN + 1000);
    rig.assert_complete();
    rig.assert_true();
    for record in &rig.records[BEGIN + 1..BEGIN + 500] {
        let valid: Vec<bool> = record.encoders().iter().map(|encoder| encoder.valid).collect();
        assert_eq!(valid, [true, true, false, false, false], "cycle {}", record.cycle);
        assert_eq!(record.flags & !flags::STALE_INPUT, flags::WORKING_COUNTER | flags::NOT_OPERATIONAL);
    }
    let last = rig.records.iter().rposition(|record| !record.is_valid()).unwrap();
    assert!(last <= BEGIN + 500 + BRING_UP, "{last}");
    let told: Vec<_> = rig.reported_events().into_iter().map(|event| event.text).collect();
    assert!(told.iter().any(|text| text.contains("terminal 3 and all behind it do not answer")), "{told:?}");
}

#[test]
fn without_distributed_clocks_a_late_cycle_is_not_reported_as_a_step_of_the_clock() {
    let mut rig = Rig::with(8, 10_000_000, false);
    rig.run_to(BEGIN);
    rig.clock.sleep_until(rig.clock.now().plus_ns(35_000_000));
    rig.run_to(BEGIN + 100);
    let codes: Vec<_> = rig.reported_events().into_iter().map(|event| event.code).collect();
    let has = |code: &str| codes.iter().any(|other| other == code);
    assert!(has("cycles_late") && !has("bus_clock_jumped"), "{codes:?}");
}

#[test]
fn an_emergency_does_not_end_another_fault_of_the_same_mailbox() {
    let mut rig = Rig::new(8);
    rig.run_to(BEGIN);
    for fault in [gone(3), SILENT, Fault::MailboxEmergency { position: 3, code: 0xff00 }] {
        rig.faults.begin(fault);
    }
    rig.run_to(BEGIN + 20);
    rig.faults.end(gone(3));
    rig.run_to(BEGIN + 20 + 3 * BRING_UP);
    assert!(!rig.records.last().unwrap().is_valid());
}
