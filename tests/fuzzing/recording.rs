//! Fuzz targets: recordings are read from arbitrary bytes, or from arbitrary content with correct checksums.

use std::collections::BTreeMap;
use std::io::{Cursor, Read};

use mcap::records::{MessageHeader, Metadata, Record};
use mcap::sans_io::{LinearReadEvent, LinearReader};
use shared::encoder::EncoderScale;
use shared::recording::schema::{CycleRecord, EncoderInfo, EncoderSample, Event, EventKind, RunMetadata};
use shared::recording::{Recording, RecordingWriter, SalvageError, salvage, verify};
use shared::time::{DcNs, MonoNs, UtcNs};

use super::{UnusedBytes, explained};

const START: UtcNs = UtcNs(1_790_000_000_000_000_000);
const RUN: &str = "ballbard.run";
const END: &str = "ballbard.end";

/// Reads and recovers a file of arbitrary bytes. If the file is refused, the error must contain a reason. If a recovery
/// succeeds, the result must be a valid recording.
pub fn any_bytes(bytes: &[u8]) {
    let read = Recording::read(bytes);
    match &read {
        Ok(recording) => check(recording),
        Err(error) => explained(error),
    }
    match salvage(Cursor::new(bytes), Cursor::new(Vec::new())) {
        Ok((salvaged, file)) => {
            verify(&file.get_ref()[..], &salvaged).expect("the recovered file is as it was written");
            let recovered = Recording::read(&file.get_ref()[..]).expect("a recovered file reads");
            check(&recovered);
            assert_eq!((recovered.end.recovered, recovered.cycles.len() as u64), (true, salvaged.cycles));
            if let Ok(read) = &read {
                assert_eq!(
                    (&read.run, &read.cycles, &read.events),
                    (&recovered.run, &recovered.cycles, &recovered.events)
                );
            }
        }
        Err(error @ SalvageError::NothingWhole(_)) => explained(&error),
        Err(error) => panic!("{error}"),
    }
}

fn check(recording: &Recording) {
    assert!(recording.cycles.iter().zip(0..).all(|(record, number)| record.cycle == number));
    assert_eq!(recording.cycles.len() as u64, recording.end.cycles);
}

/// Reads a file with correct checksums, whose messages and metadata are from the fuzzer. The bytes of the fuzzer are a
/// sequence of pieces. Each piece consists of kind, length and content.
pub fn any_content(bytes: &[u8]) {
    let mut writer = mcap::WriteOptions::new()
        .profile("ros2")
        .disable_seeking(true)
        .compression(None)
        .create(Cursor::new(Vec::new()))
        .expect("a sink in memory");
    let channels = [
        ("/ballbard/cycle", "ballbard_msgs/msg/BusCycle"),
        ("/ballbard/event", "ballbard_msgs/msg/Event"),
        ("/other", "other_msgs/msg/Other"),
    ]
    .map(|(topic, schema)| {
        let schema = writer.add_schema(schema, "ros2msg", b"").expect("schema");
        writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).expect("channel")
    });
    let mut input = UnusedBytes(bytes);
    let mut sequence = 0;
    while !input.is_empty() {
        let kind = input.byte();
        let length = usize::from(input.word());
        let content = input.take(length);
        match kind % 6 {
            index @ 0..=2 => {
                let header = MessageHeader {
                    channel_id: channels[usize::from(index)],
                    sequence,
                    log_time: 0,
                    publish_time: 0,
                };
                writer.write_to_known_channel(&header, content).expect("message");
                sequence += 1;
            }
            3 => writer.write_metadata(&metadata(RUN, content)).expect("metadata"),
            4 => writer.write_metadata(&metadata(END, content)).expect("metadata"),
            _ => writer.flush().expect("flush"),
        }
    }
    writer.finish().expect("summary");
    any_bytes(&writer.into_inner().into_inner());
}

fn metadata(name: &str, content: &[u8]) -> Metadata {
    let json = String::from_utf8_lossy(content).into_owned();
    let checksum = format!("{:08x}", crc32fast::hash(json.as_bytes()));
    let metadata = BTreeMap::from([("json".to_owned(), json), ("crc32".to_owned(), checksum)]);
    Metadata { name: name.to_owned(), metadata }
}

/// Seeds: a finished, an unfinished and a recovered recording.
pub fn whole_and_cut() -> Vec<Vec<u8>> {
    let finished = recording(12);
    let unfinished = finished[..finished.len() * 2 / 3].to_vec();
    let (_, recovered) = salvage(Cursor::new(&unfinished), Cursor::new(Vec::new())).expect("recovers");
    vec![finished, unfinished, recovered.into_inner(), recording(0)]
}

/// Seeds: the recordings of [`whole_and_cut`], split into pieces.
pub fn contents() -> Vec<Vec<u8>> {
    whole_and_cut().iter().map(|file| pieces(file)).collect()
}

fn recording(cycles: u64) -> Vec<u8> {
    let mut writer = RecordingWriter::begin(Cursor::new(Vec::new()), &run()).expect("begins");
    for number in 0..cycles {
        writer.write_cycle(&cycle(number)).expect("cycle");
        if number % 4 == 3 {
            let (kind, text, code) = (EventKind::Marker, "m".into(), String::new());
            let event = Event { time: START, cycle: number, kind, text, code };
            writer.write_event(&event).expect("event");
            writer.sync().expect("sync");
        }
    }
    writer.end("stopped", START).expect("ends").into_inner()
}

fn run() -> RunMetadata {
    let encoder = EncoderInfo { joint: 1, scale: EncoderScale::default() };
    RunMetadata {
        name: "seed".into(),
        operator: String::new(),
        robot: String::new(),
        bar: String::new(),
        payload: String::new(),
        note: "ü".into(),
        started: START,
        software: "test".into(),
        bus: "simulated".into(),
        replay_of: None,
        cycle_period_ns: 10_000_000,
        distributed_clocks: true,
        utc_minus_monotonic_ns: 42,
        encoders: vec![encoder],
        devices: Vec::new(),
        daemon_config: String::new(),
        ball_bar_config: String::new(),
    }
}

fn cycle(number: u64) -> CycleRecord {
    let time_ns = number as i64 * 10_000_000;
    let mut encoders = [EncoderSample::default(); shared::recording::schema::MAX_ENCODERS];
    encoders[0] = EncoderSample { joint: 1, count: number as u32 * 1000, latch: 7, status: 0, valid: true };
    CycleRecord {
        cycle: number,
        sample_time: START.plus_ns(time_ns),
        sample_time_uncertainty_ns: 1500,
        dc_time: DcNs(1_000 + time_ns),
        send_time: MonoNs(5_000 + time_ns),
        receive_time: MonoNs(65_000 + time_ns),
        working_counter: 3,
        working_counter_expected: 3,
        flags: 0,
        origin: 0,
        encoder_count: 1,
        encoders,
    }
}

/// Splits a recording into pieces of messages and metadata, in the form that [`any_content`] takes.
fn pieces(file: &[u8]) -> Vec<u8> {
    let mut reader = LinearReader::new();
    let (mut source, mut pieces, mut topics) = (file, Vec::new(), BTreeMap::new());
    while let Some(Ok(event)) = reader.next_event() {
        match event {
            LinearReadEvent::ReadRequest(wanted) => {
                let count = source.read(reader.insert(wanted)).expect("memory");
                reader.notify_read(count);
            }
            LinearReadEvent::Record { data, opcode } => match mcap::parse_record(opcode, data) {
                Ok(Record::Channel(channel)) => {
                    topics.insert(channel.id, u8::from(channel.topic == "/ballbard/event"));
                }
                Ok(Record::Message { header, data }) if header.log_time > 0 => {
                    piece(&mut pieces, topics[&header.channel_id], &data);
                }
                Ok(Record::Metadata(record)) => {
                    piece(
                        &mut pieces,
                        if record.name == RUN { 3 } else { 4 },
                        record.metadata["json"].as_bytes(),
                    );
                }
                _ => {}
            },
        }
    }
    pieces
}

fn piece(pieces: &mut Vec<u8>, kind: u8, content: &[u8]) {
    pieces.push(kind);
    pieces.extend((content.len() as u16).to_le_bytes());
    pieces.extend(content);
}
