//! A recording is read back exactly as written, or refused with a reason.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::io::Cursor;

use shared::recording::schema::{CycleRecord, Event, EventKind, RunMetadata, flags};
use shared::recording::{ReadErrorKind, Recording, RecordingWriter, WriteError, salvage};

use crate::support::run::{START, cycle, run, timing};

fn marker(number: u64) -> Event {
    let (text, code) = ("second half".into(), String::new());
    Event { time: cycle(number).sample_time, cycle: number, kind: EventKind::Marker, text, code }
}

fn small_recording(cycles: u64) -> Vec<u8> {
    let mut writer = RecordingWriter::begin(Cursor::new(Vec::new()), &run("small")).unwrap();
    for number in 0..cycles {
        writer.write_cycle(&cycle(number)).unwrap();
        if number % 20 == 19 {
            writer.sync().unwrap();
        }
    }
    writer.write_event(&marker(cycles / 2)).unwrap();
    writer.write_timing(&timing()).unwrap();
    writer.end("stopped", START).unwrap().into_inner()
}

#[test]
fn what_is_written_is_read_back() {
    let recording = Recording::read(&small_recording(100)[..]).unwrap();
    assert_eq!(recording.run, run("small"));
    assert_eq!(recording.cycles, (0..100).map(cycle).collect::<Vec<_>>());
    assert_eq!(recording.events, [marker(50)]);
    assert_eq!((recording.end.cycles, recording.end.cycles_valid, recording.end.cycles_lost), (100, 94, 0));
    assert_eq!(recording.end.cause, "stopped");
    assert_eq!(recording.timing, Some(timing()));
}

#[test]
fn a_file_of_an_older_program_is_simulated_by_its_bus() {
    let mut older = serde_json::to_value(run("older")).unwrap();
    assert!(older.get("replay_of").is_none(), "an older program reads a run that is no replay");
    for (bus, is_simulated) in [("simulated", true), ("eth1", false)] {
        older["bus"] = bus.into();
        let run: RunMetadata = serde_json::from_value(older.clone()).unwrap();
        assert_eq!(run.is_simulated(), is_simulated, "{bus}");
    }
}

#[test]
fn the_end_of_a_recording_repeats_its_markers_and_counts_cycles_that_are_not_valid() {
    let recording = Recording::read(&small_recording(60)[..]).unwrap();
    let [mark] = &recording.end.marks[..] else { panic!("{:?}", recording.end.marks) };
    let at_s = marker(30).time.seconds_since(START);
    assert_eq!((mark.text.as_str(), mark.at_s), ("second half", at_s));
    let invalid = recording.cycles.iter().filter(|cycle| !cycle.is_valid()).count() as u64;
    let counted: u64 = recording.end.flagged.iter().map(|flagged| flagged.cycles).sum();
    assert!(counted >= invalid, "{invalid}: {:?}", recording.end.flagged);
}

#[test]
fn a_run_has_its_final_name_only_when_it_is_finished() {
    let directory = tempfile::tempdir().unwrap();
    let mut writer = RecordingWriter::create(directory.path(), &run("trial-1")).unwrap();
    writer.write_cycle(&cycle(0)).unwrap();
    writer.sync().unwrap();
    let (active, finished) =
        (directory.path().join("trial-1.mcap.active"), directory.path().join("trial-1.mcap"));
    assert!(active.exists() && !finished.exists());
    let unfinished = Recording::open(&active).unwrap_err();
    assert!(unfinished.to_string().contains("recover"), "{unfinished}");
    assert_eq!(writer.finish("stopped", START).unwrap(), finished);
    assert!(!active.exists());
    assert_eq!(Recording::open(&finished).unwrap().cycles.len(), 1);
}

#[test]
fn an_older_recording_is_never_overwritten() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("taken.mcap"), "precious").unwrap();
    assert!(matches!(RecordingWriter::create(directory.path(), &run("taken")), Err(WriteError::Exists(_))));
    let writer = RecordingWriter::create(directory.path(), &run("late")).unwrap();
    std::fs::write(directory.path().join("late.mcap"), "precious").unwrap();
    assert!(matches!(writer.finish("stopped", START), Err(WriteError::Exists(_))));
    assert_eq!(std::fs::read(directory.path().join("late.mcap")).unwrap(), b"precious");
}

#[test]
fn names_that_leave_the_directory_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    for name in ["", "../up", "a/b", ".hidden", "nul\0", "-x", "a.mcap", "a.mcap.active", "a.torn"] {
        assert!(
            matches!(RecordingWriter::create(directory.path(), &run(name)), Err(WriteError::Name(_))),
            "{name}"
        );
    }
}

#[test]
fn every_prefix_is_refused() {
    let whole = small_recording(60);
    for length in 0..whole.len() {
        assert!(
            Recording::read(&whole[..length]).is_err(),
            "a prefix of {length} bytes passed as a whole file"
        );
    }
}

#[test]
fn a_zero_filled_tail_is_refused() {
    let whole = small_recording(60);
    let mut torn = whole[..whole.len() / 2].to_vec();
    torn.resize(whole.len(), 0);
    assert!(Recording::read(&torn[..]).is_err());
}

#[test]
fn a_hole_in_the_cycle_numbers_is_refused() {
    let mut writer = RecordingWriter::begin(Cursor::new(Vec::new()), &run("hole")).unwrap();
    for number in [0, 1, 3] {
        writer.write_cycle(&cycle(number)).unwrap();
    }
    let bytes = writer.end("stopped", START).unwrap().into_inner();
    assert!(matches!(Recording::read(&bytes[..]), Err(ReadErrorKind::Hole { expected: 2, found: 3 })));
}

#[test]
fn encoders_that_no_configuration_allows_are_refused() {
    for (lines, interpolation_bits) in [(0, 12), (3600, 0), (3600, 200)] {
        let mut run = run("encoder");
        run.encoders[0].scale.lines = lines;
        run.encoders[0].scale.interpolation_bits = interpolation_bits;
        let writer = RecordingWriter::begin(Cursor::new(Vec::new()), &run).unwrap();
        let bytes = writer.end("stopped", START).unwrap().into_inner();
        let refused = Recording::read(&bytes[..]).unwrap_err().to_string();
        assert!(refused.contains("joint 1") && refused.contains(&lines.to_string()), "{refused}");
    }
}

/// A file of an earlier version, in which records did not have the number of their origin. Cycle 6 is flagged as having a
/// new origin, and cycles 12 to 14 are lost.
const FLAGGED_ORIGINS: &[u8] = include_bytes!("data/flagged_origins.mcap");

#[test]
fn in_a_file_that_only_flags_new_origins_lost_records_may_have_been_one() {
    let recording = Recording::read(FLAGGED_ORIGINS).unwrap();
    let origins: Vec<u32> = recording.cycles.iter().map(|cycle| cycle.origin).collect();
    assert_eq!(origins[..15], [[0; 6].as_slice(), &[1; 9]].concat());
    assert_eq!(origins[15..], [2; 9]);
    assert_eq!(recording.events.len(), 1);
    for record in recording.cycles.iter().filter(|record| record.flags & flags::LOST == 0) {
        let CycleRecord { origin, .. } = *record;
        assert_eq!(*record, CycleRecord { origin, ..cycle(record.cycle) });
    }
}

#[test]
fn such_a_file_is_recovered_with_what_its_cycles_said() {
    // Damages a byte in the first chunk, which contains the schemas.
    let mut damaged = FLAGGED_ORIGINS.to_vec();
    let at = damaged.windows(4).position(|window| window == b"zstd").unwrap();
    damaged[at + 40] ^= 1;
    let (_, recovered) = salvage(Cursor::new(&damaged), Cursor::new(Vec::new())).unwrap();
    let (before, after) = (Recording::read(FLAGGED_ORIGINS).unwrap(), recovered.into_inner());
    assert_eq!(Recording::read(&after[..]).unwrap().cycles, before.cycles);
}
