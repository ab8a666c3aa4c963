//! Converts MCAP records to the content of a recording ([`Item`]): metadata, cycles and events. The reader and the recovery
//! use the [`Decoder`] for this purpose. The writer builds its metadata records here, and adds a checksum to each of them.
//!
//! Counts of an encoder are relative to an *origin*, which changes when the counter restarts. In new files, each cycle
//! contains the number of its origin. Files of older programs only mark the first cycle after a change ([`CycleLayout`]).

use std::collections::{BTreeMap, HashMap};

use mcap::records::{Channel, Metadata, Record, SchemaHeader};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::messages::{self, CycleLayout};
use super::reader::ReadErrorKind;
use super::schema::{CycleRecord, EncoderInfo, Event, MAX_ENCODERS, RunEnd, RunMetadata, flags};
use super::timing::TimingSummary;
use crate::encoder::{EncoderScale, INTERPOLATION_BITS};

/// Name of the library in the MCAP header of a recording. The version follows it.
pub(super) const LIBRARY_NAME: &str = "ballbard ";

/// Channel numbers of the cycles and of the events. The writer adds these two channels first.
pub(super) const USUAL_CHANNELS: [u16; 2] = [1, 2];

/// Names of the metadata records at the beginning and at the end of a run.
pub(super) const RUN_METADATA: &str = "ballbard.run";
pub(super) const END_METADATA: &str = "ballbard.end";
/// Name of the metadata records with the loop's timing. Each record replaces the records before it.
pub(super) const TIMING_METADATA: &str = "ballbard.timing";

/// Names of all metadata records that have a checksum of their own.
pub(super) const OUR_METADATA: [&str; 3] = [RUN_METADATA, END_METADATA, TIMING_METADATA];

/// Key of the content (JSON) in the metadata records that have a checksum.
const CONTENT_KEY: &str = "json";
/// Key of the checksum: CRC-32 of the JSON text, in hexadecimal. MCAP protects metadata only by a checksum at the end of the
/// file, which the file of an interrupted run does not have.
const CHECKSUM_KEY: &str = "crc32";

/// Builds a metadata record from `content`, with its checksum.
pub(super) fn metadata_of(name: &str, content: &impl Serialize) -> Result<Metadata, serde_json::Error> {
    let json = serde_json::to_string(content)?;
    let checksum = checksum_of(&json);
    let metadata = BTreeMap::from([(CONTENT_KEY.to_owned(), json), (CHECKSUM_KEY.to_owned(), checksum)]);
    Ok(Metadata { name: name.to_owned(), metadata })
}

/// The metadata of a run as stored in the file.
#[derive(Serialize, Deserialize)]
struct StoredRun<Run> {
    #[serde(flatten)]
    run: Run,
    /// Whether each cycle contains the number of its origin. The schema contains the same information, but the schema may be
    /// lost if the file is damaged.
    #[serde(default)]
    origin_numbers: bool,
    /// The value of [`RunMetadata::is_simulated`], for other programs that read the file.
    #[serde(default)]
    simulated: bool,
}

/// Builds the metadata record of a run.
pub(super) fn metadata_of_run(run: &RunMetadata) -> Result<Metadata, serde_json::Error> {
    metadata_of(RUN_METADATA, &StoredRun { run, origin_numbers: true, simulated: run.is_simulated() })
}

/// Parses the metadata record of a run. Returns the run and the layout of its cycles.
pub(super) fn run_of(metadata: &Metadata) -> Result<(RunMetadata, CycleLayout), ReadErrorKind> {
    let StoredRun { run, origin_numbers, simulated: _ } = content_of(RUN_METADATA, metadata)?;
    check_encoders(&run)?;
    Ok((run, if origin_numbers { CycleLayout::OriginNumber } else { CycleLayout::OriginFlag }))
}

/// Parses the content of a metadata record. Fails if the checksum is wrong or missing.
pub(super) fn content_of<T: DeserializeOwned>(
    name: &'static str,
    metadata: &Metadata,
) -> Result<T, ReadErrorKind> {
    let problem = |problem: String| ReadErrorKind::Metadata { name, problem };
    let json = metadata.metadata.get(CONTENT_KEY);
    let json = json.ok_or_else(|| problem(format!("no `{CONTENT_KEY}`")))?;
    if !is_proven(metadata) {
        return Err(problem("its checksum differs".into()));
    }
    serde_json::from_str(json).map_err(|error| problem(error.to_string()))
}

/// Whether a metadata record has a checksum of its own and the checksum is correct.
pub(super) fn is_proven(metadata: &Metadata) -> bool {
    let value = |key| metadata.metadata.get(key);
    value(CONTENT_KEY).zip(value(CHECKSUM_KEY)).is_some_and(|(json, checksum)| *checksum == checksum_of(json))
}

/// Refuses encoder settings that no configuration allows.
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

/// Decoded content of one of our records.
#[derive(Debug)]
pub(super) enum Item {
    Run(Box<RunMetadata>),
    Cycle(CycleRecord),
    Event(Event),
    Timing(Box<TimingSummary>),
    End(RunEnd),
}

/// A channel whose messages are decoded. Our other channels only repeat these messages in the formats of other programs.
#[derive(Debug, Clone, Copy)]
enum OurChannel {
    Cycles(CycleLayout),
    Events,
}

/// Decodes the records of one recording. They must be passed in the order of the file.
#[derive(Default)]
pub(super) struct Decoder {
    /// For each schema, by its number: the name of the schema, and how cycles mark a new origin.
    schemas: HashMap<u16, (String, CycleLayout)>,
    /// All declared channels, by number. The value is `None` for channels whose messages are not decoded.
    channels: HashMap<u16, Option<OurChannel>>,
    /// Whether messages are accepted on undeclared channels, because the declaration may be lost.
    beginning_may_be_lost: bool,
    origins: FlaggedOrigins,
}

impl Decoder {
    /// A decoder for files whose beginning may be lost. Channel numbers that are not declared are assumed to
    /// be those that [`RecordingWriter`](super::RecordingWriter) assigns.
    pub fn with_usual_channels(layout: CycleLayout) -> Self {
        let [cycles, events] = USUAL_CHANNELS;
        let channels =
            HashMap::from([(cycles, Some(OurChannel::Cycles(layout))), (events, Some(OurChannel::Events))]);
        Self { channels, beginning_may_be_lost: true, ..Self::default() }
    }

    /// Decodes a record. `None` if another program wrote the record, or if the record only declares a schema or channel.
    pub fn decode(&mut self, record: Record<'_>) -> Result<Option<Item>, ReadErrorKind> {
        Ok(match record {
            Record::Metadata(metadata) if metadata.name == RUN_METADATA => {
                Some(Item::Run(Box::new(run_of(&metadata)?.0)))
            }
            Record::Metadata(metadata) if metadata.name == END_METADATA => {
                Some(Item::End(content_of(END_METADATA, &metadata)?))
            }
            Record::Metadata(metadata) if metadata.name == TIMING_METADATA => {
                Some(Item::Timing(Box::new(content_of(TIMING_METADATA, &metadata)?)))
            }
            Record::Schema { header: SchemaHeader { id, name, .. }, data } => {
                self.schemas.insert(id, (name, CycleLayout::of_schema(&data)));
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

    /// Stores a channel, and whether its messages must be decoded.
    fn take_channel(&mut self, channel: &Channel) {
        let ours = self.schemas.get(&channel.schema_id).and_then(|(name, layout)| {
            let is = |topic: &messages::Topic| channel.topic == topic.topic && name == topic.schema_name;
            let cycles = is(&messages::CYCLE).then_some(OurChannel::Cycles(*layout));
            cycles.or_else(|| is(&messages::EVENT).then_some(OurChannel::Events))
        });
        self.channels.insert(channel.id, ours);
    }

    fn decode_message(
        &mut self,
        channel_id: u16,
        sequence: u32,
        data: &[u8],
    ) -> Result<Option<Item>, ReadErrorKind> {
        let ours = match self.channels.get(&channel_id) {
            Some(Some(ours)) => *ours,
            None if !self.beginning_may_be_lost => {
                let problem = format!("a message on channel {channel_id}, which is not declared");
                return Err(ReadErrorKind::Misplaced(problem));
            }
            Some(None) | None => return Ok(None),
        };
        let error = |topic, source| ReadErrorKind::Message { topic, sequence, source };
        Ok(Some(match ours {
            OurChannel::Events => {
                let event = messages::decode_event(data);
                Item::Event(event.map_err(|source| error(messages::EVENT.topic, source))?)
            }
            OurChannel::Cycles(layout) => {
                let decoded = messages::decode_cycle(data, layout);
                let record = decoded.map_err(|source| error(messages::CYCLE.topic, source))?;
                Item::Cycle(match layout {
                    CycleLayout::OriginNumber => record,
                    CycleLayout::OriginFlag => self.origins.number(record),
                })
            }
        }))
    }
}

/// Numbers the origins in files of older programs, in which only the first record of each origin has a flag. If records were
/// lost, one of them may have had the flag, so the records after the loss get a new origin. An unnecessary origin adds a few
/// parameters to the calibration, but a missed origin would corrupt it.
#[derive(Default)]
struct FlaggedOrigins {
    origin: u32,
    next_cycle: u64,
    /// Whether a record was lost since the last record that is whole.
    is_after_loss: bool,
}

impl FlaggedOrigins {
    fn number(&mut self, record: CycleRecord) -> CycleRecord {
        self.is_after_loss |= record.cycle != self.next_cycle;
        self.next_cycle = record.cycle.wrapping_add(1);
        if record.flags & flags::LOST != 0 {
            self.is_after_loss = true;
        } else if std::mem::take(&mut self.is_after_loss) || record.flags & flags::ORIGIN_CHANGED != 0 {
            self.origin = self.origin.wrapping_add(1);
        }
        CycleRecord { origin: self.origin, flags: record.flags & !flags::ORIGIN_CHANGED, ..record }
    }
}
