//! The table of a recording.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use ballbard::control::recordings::table::{Layout, write_csv};
use shared::recording::schema::{Event, EventKind};
use shared::recording::{RecordingWriter, SystemDisk};
use shared::time::UtcNs;

use crate::support::runs::{metadata, record_of};

#[test]
fn an_event_is_in_the_row_of_its_cycle_although_it_follows_an_event_of_a_later_cycle() {
    let directory = tempfile::tempdir().unwrap();
    let run = metadata(Duration::from_millis(10));
    let mut writer = RecordingWriter::create(directory.path(), &run).unwrap();
    let time = |cycle: u64| UtcNs(cycle as i64 * 10_000_000);
    for cycle in 0..10 {
        writer.write_cycle(&record_of(cycle, time(cycle))).unwrap();
    }
    for (cycle, text) in [(6, "A"), (3, "B")] {
        let (kind, text, code) = (EventKind::Marker, text.into(), String::new());
        writer.write_event(&Event { time: time(cycle), cycle, kind, text, code }).unwrap();
    }
    let path = writer.finish("stopped", time(9)).unwrap();
    let mut table = Vec::new();
    assert_eq!(write_csv(&SystemDisk, &path, Layout::default(), &mut table).unwrap(), 10);
    let rows: Vec<_> = csv::Reader::from_reader(&table[..]).records().map(Result::unwrap).collect();
    // The last three columns are cycle, flags and event.
    let marks = rows.iter().filter(|row| row[6].starts_with("mark: "));
    let marks: Vec<_> = marks.map(|row| (&row[4], &row[6])).collect();
    assert_eq!(marks, [("3", "mark: B"), ("6", "mark: A")]);
}
