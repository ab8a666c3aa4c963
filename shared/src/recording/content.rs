//! From MCAP records to what a recording says: metadata, cycles without a hole, events.

use std::collections::{BTreeMap, HashMap};

use mcap::records::{Channel, Metadata, Record, SchemaHeader};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::messages::{self, Topic};
use super::reader::ReadErrorKind;
use super::schema::{CycleRecord, EncoderInfo, Event, MAX_ENCODERS, RunEnd, RunMetadata};
use super::timing::TimingSummary;
use crate::encoder::{EncoderScale, INTERPOLATION_BITS};

/// What a recording calls the library that wrote it, before its version.
pub(super) const LIBRARY_NAME: &str = "ballbard ";

/// Names of the metadata records at the beginning and the end of a run.
pub(super) const RUN_METADATA: &str = "ballbard.run";
pub(super) const END_METADATA: &str = "ballbard.end";
/// Name of the metadata records of the loop's timing; each replaces those before it.
pub(super) const TIMING_METADATA: &str = "ballbard.timing";

/// Key under which those records hold their content as JSON.
const CONTENT_KEY: &str = "json";
/// Key of the CRC-32 of that JSON, in hexadecimal. MCAP protects metadata only by the checksum at the end of
/// the file, which a run that was cut short does not have.
const CHECKSUM_KEY: &str = "crc32";

/// A metadata record with `content` and its checksum.
pub(super) fn metadata_of(name: &str, content: &impl Serialize) -> Result<Metadata, serde_json::Error> {
    let json = serde_json::to_string(content)?;
    let checksum = checksum_of(&json);
    let metadata = BTreeMap::from([(CONTENT_KEY.to_owned(), json), (CHECKSUM_KEY.to_owned(), checksum)]);
    Ok(Metadata { name: name.to_owned(), metadata })
}

/// The content of a metadata record, if it is what was written.
pub(super) fn content_of<T: DeserializeOwned>(
    name: &'static str,
    metadata: &Metadata,
) -> Result<T, ReadErrorKind> {
    let problem = |problem: String| ReadErrorKind::Metadata { name, problem };
    let value = |key| metadata.metadata.get(key).ok_or_else(|| problem(format!("no `{key}`")));
    let json = value(CONTENT_KEY)?;
    if *value(CHECKSUM_KEY)? != checksum_of(json) {
        return Err(problem("its checksum differs".into()));
    }
    serde_json::from_str(json).map_err(|error| problem(error.to_string()))
}

/// Encoders as no configuration allows them would make nonsense of every count.
fn check_encoders(run: &RunMetadata) -> Result<(), ReadErrorKind> {
    let possible = |encoder: &EncoderInfo| {
        encoder.scale.lines > 0 && INTERPOLATION_BITS.contains(&encoder.scale.interpolation_bits)
    };
    let problem = match run.encoders.iter().find(|encoder| !possible(encoder)) {
        Some(EncoderInfo { joint, scale: EncoderScale { lines, interpolation_bits, .. } }) => {
            format!("the encoder of joint {joint} has {lines} lines and {interpolation_bits} bits")
        }
        None if run.encoders.len() > MAX_ENCODERS => format!("{} encoders", run.encoders.len()),
        None => return Ok(()),
    };
    Err(ReadErrorKind::Metadata { name: RUN_METADATA, problem })
}

fn checksum_of(json: &str) -> String {
    format!("{:08x}", crc32fast::hash(json.as_bytes()))
}

/// One thing that a recording says.
#[derive(Debug)]
pub(super) enum Item {
    Run(Box<RunMetadata>),
    Cycle(CycleRecord),
    Event(Event),
    Timing(Box<TimingSummary>),
    End(RunEnd),
}

/// Understands the records of one recording, in the order in which they come.
#[derive(Default)]
pub(super) struct Decoder {
    schemas: HashMap<u16, String>,
    /// Every channel that is declared; none for those that are not ours (added by another tool).
    channels: HashMap<u16, Option<&'static Topic>>,
    next_cycle: u64,
}

impl Decoder {
    /// What the record says; none where it is not ours or only prepares others.
    pub fn decode(&mut self, record: Record<'_>) -> Result<Option<Item>, ReadErrorKind> {
        Ok(match record {
            Record::Metadata(metadata) if metadata.name == RUN_METADATA => {
                let run: RunMetadata = content_of(RUN_METADATA, &metadata)?;
                check_encoders(&run)?;
                Some(Item::Run(Box::new(run)))
            }
            Record::Metadata(metadata) if metadata.name == END_METADATA => {
                Some(Item::End(content_of(END_METADATA, &metadata)?))
            }
            Record::Metadata(metadata) if metadata.name == TIMING_METADATA => {
                Some(Item::Timing(Box::new(content_of(TIMING_METADATA, &metadata)?)))
            }
            Record::Schema { header: SchemaHeader { id, name, .. }, .. } => {
                self.schemas.insert(id, name);
                None
            }
            Record::Channel(channel) => {
                self.take_channel(&channel);
                None
            }
            Record::Message { header, data } => {
                self.decode_message(header.channel_id, header.sequence, &data)?
            }
            _ => None,
        })
    }

    /// Remembers a channel, and which of ours it is.
    fn take_channel(&mut self, channel: &Channel) {
        let schema = self.schemas.get(&channel.schema_id);
        let ours = [&messages::CYCLE, &messages::EVENT].into_iter().find(|topic| {
            channel.topic == topic.topic && schema.is_some_and(|name| name == topic.schema_name)
        });
        self.channels.insert(channel.id, ours);
    }

    fn decode_message(
        &mut self,
        channel_id: u16,
        sequence: u32,
        data: &[u8],
    ) -> Result<Option<Item>, ReadErrorKind> {
        let undeclared =
            || ReadErrorKind::Misplaced(format!("a message on channel {channel_id}, which is not declared"));
        let Some(topic) = self.channels.get(&channel_id).ok_or_else(undeclared)? else { return Ok(None) };
        let error = |source| ReadErrorKind::Message { topic: topic.topic, sequence, source };
        if topic.topic == messages::EVENT.topic {
            return Ok(Some(Item::Event(messages::decode_event(data).map_err(error)?)));
        }
        let record = messages::decode_cycle(data).map_err(error)?;
        if record.cycle != self.next_cycle {
            return Err(ReadErrorKind::Hole { expected: self.next_cycle, found: record.cycle });
        }
        self.next_cycle += 1;
        Ok(Some(Item::Cycle(record)))
    }
}
