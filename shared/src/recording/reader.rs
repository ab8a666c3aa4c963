//! Reads a recording whole, or says why not.
//!
//! A damaged file must never give a wrong number: CRCs are checked before a chunk is unpacked, record lengths
//! are bounded (a flipped bit in a length would otherwise ask for the whole address space), the CRC over the
//! data section and cycle numbers without a hole prove that nothing was skipped.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::{Channel, Metadata, Record, SchemaHeader};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde::de::DeserializeOwned;

use super::messages::{self, MessageError, Topic};
use super::schema::{CycleRecord, Event, RunEnd, RunMetadata};
use super::{CONTENT_KEY, END_METADATA, RUN_METADATA};

/// Longest record that a recording has: far above a second of 1 kHz cycles, far below memory.
const RECORD_LENGTH_BYTES_MAX: usize = 64 << 20;

/// Why a file cannot be read as a recording.
#[derive(Debug, thiserror::Error)]
#[error("{}: {kind}", path.display())]
pub struct ReadError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub kind: ReadErrorKind,
}

/// What is wrong with a recording.
#[derive(Debug, thiserror::Error)]
pub enum ReadErrorKind {
    /// The system could not read it.
    #[error("cannot be read: {0}; check the path and its permissions")]
    Io(#[from] io::Error),
    /// The MCAP structure is broken.
    #[error("damaged or not an MCAP file: {0}; if a run was cut short, run `ballbard recover` on it")]
    Container(#[from] McapError),
    /// A message is broken though its chunk's checksum is right.
    #[error(
        "message {sequence} on {topic}: {source}; the file was not written by this software or is damaged"
    )]
    Message {
        /// Topic of the message.
        topic: &'static str,
        /// Its number.
        sequence: u32,
        /// What is wrong.
        source: MessageError,
    },
    /// It is an MCAP file, but not one of ours, or the metadata record is broken.
    #[error("no valid `{name}` record ({problem}); is it a ball-bar recording?")]
    Metadata {
        /// Name of the record.
        name: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// The run has no end record.
    #[error("the run was never finished (its end is missing); run `ballbard recover` on it")]
    Unfinished,
    /// Cycle numbers have a hole, or their count differs from what the end record says.
    #[error("cycle {found} follows where {expected} should be; a part of the file is missing or damaged")]
    Hole {
        /// Cycle number that should come.
        expected: u64,
        /// Cycle number that comes, or the count that the end record gives.
        found: u64,
    },
}

/// A whole, finished recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Who, what, with which settings.
    pub run: RunMetadata,
    /// Every bus cycle, numbered without a hole.
    pub cycles: Vec<CycleRecord>,
    /// What happened meanwhile.
    pub events: Vec<Event>,
    /// How the run ended.
    pub end: RunEnd,
}

impl Recording {
    /// Reads a finished recording from a file.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let error = |kind| ReadError { path: path.to_owned(), kind };
        let file = File::open(path).map_err(|source| error(source.into()))?;
        Self::read(BufReader::new(file)).map_err(error)
    }

    /// Reads a finished recording from any source of bytes.
    pub fn read(source: impl Read) -> Result<Self, ReadErrorKind> {
        let mut content = Content::default();
        for_each_record(source, &mut |record| content.take(record))?;
        content.finish()
    }
}

/// Hands every record of the file, chunks unpacked, to `sink`.
fn for_each_record(
    mut source: impl Read,
    sink: &mut dyn FnMut(Record<'_>) -> Result<(), ReadErrorKind>,
) -> Result<(), ReadErrorKind> {
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_validate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true)
        .with_check_finishes_after_end_magic(true)
        .with_record_length_limit(RECORD_LENGTH_BYTES_MAX);
    let mut reader = LinearReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let buffer = reader.insert(wanted.min(RECORD_LENGTH_BYTES_MAX));
                let count = source.read(buffer)?;
                reader.notify_read(count);
            }
            LinearReadEvent::Record { data, opcode } => sink(mcap::parse_record(opcode, data)?)?,
        }
    }
    Ok(())
}

/// What has been read so far.
#[derive(Default)]
struct Content {
    run: Option<RunMetadata>,
    end: Option<RunEnd>,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, &'static Topic>,
    cycles: Vec<CycleRecord>,
    events: Vec<Event>,
}

impl Content {
    fn take(&mut self, record: Record<'_>) -> Result<(), ReadErrorKind> {
        match record {
            Record::Metadata(metadata) if metadata.name == RUN_METADATA => {
                self.run = Some(content_of(RUN_METADATA, &metadata)?);
            }
            Record::Metadata(metadata) if metadata.name == END_METADATA => {
                self.end = Some(content_of(END_METADATA, &metadata)?);
            }
            Record::Schema { header: SchemaHeader { id, name, .. }, .. } => {
                self.schemas.insert(id, name);
            }
            Record::Channel(channel) => self.take_channel(&channel),
            Record::Message { header, data } => {
                self.take_message(header.channel_id, header.sequence, &data)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Remembers the channels that are ours; others (added by another tool) are passed over.
    fn take_channel(&mut self, channel: &Channel) {
        let schema = self.schemas.get(&channel.schema_id);
        let ours = [&messages::CYCLE, &messages::EVENT].into_iter().find(|topic| {
            channel.topic == topic.topic && schema.is_some_and(|name| name == topic.schema_name)
        });
        if let Some(topic) = ours {
            self.channels.insert(channel.id, topic);
        }
    }

    fn take_message(&mut self, channel_id: u16, sequence: u32, data: &[u8]) -> Result<(), ReadErrorKind> {
        let Some(&topic) = self.channels.get(&channel_id) else { return Ok(()) };
        let error = |source| ReadErrorKind::Message { topic: topic.topic, sequence, source };
        if topic.topic == messages::EVENT.topic {
            self.events.push(messages::decode_event(data).map_err(error)?);
            return Ok(());
        }
        let record = messages::decode_cycle(data).map_err(error)?;
        let expected = self.cycles.last().map_or(0, |last| last.cycle + 1);
        if record.cycle != expected {
            return Err(ReadErrorKind::Hole { expected, found: record.cycle });
        }
        self.cycles.push(record);
        Ok(())
    }

    fn finish(self) -> Result<Recording, ReadErrorKind> {
        let missing = |name| ReadErrorKind::Metadata { name, problem: "missing".into() };
        let run = self.run.ok_or_else(|| missing(RUN_METADATA))?;
        let end = self.end.ok_or(ReadErrorKind::Unfinished)?;
        if end.cycles != self.cycles.len() as u64 {
            return Err(ReadErrorKind::Hole { expected: self.cycles.len() as u64, found: end.cycles });
        }
        Ok(Recording { run, cycles: self.cycles, events: self.events, end })
    }
}

fn content_of<T: DeserializeOwned>(name: &'static str, metadata: &Metadata) -> Result<T, ReadErrorKind> {
    let problem = |problem: String| ReadErrorKind::Metadata { name, problem };
    let json = metadata.metadata.get(CONTENT_KEY).ok_or_else(|| problem(format!("no `{CONTENT_KEY}`")))?;
    serde_json::from_str(json).map_err(|error| problem(error.to_string()))
}
