//! Takes what is whole out of a recording that was cut short and writes it as a finished one.
//!
//! Reading stops at the first thing that is not as it was written: what comes after cannot be placed, and a
//! doubtful sample is worth less than none. Works on any source and sink; files are in `leftover`.

use std::collections::BTreeMap;
use std::io::{Read, Seek, Write};

use crc32fast::Hasher;
use mcap::records::{Record, op};

use super::content::{Decoder, Item, RUN_METADATA};
use super::messages;
use super::reader::ReadErrorKind;
use super::records::{Ending, for_each_record};
use super::schema::{CycleRecord, Event, RunEnd, RunMetadata};
use super::timing::TimingSummary;
use super::writer::{RecordingWriter, WriteError};
use crate::time::UtcNs;

/// What was taken out of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Salvaged {
    /// Who, what, with which settings.
    pub run: RunMetadata,
    /// Whole cycles, from the first on without a hole.
    pub cycles: u64,
    /// Cycles among them in which every encoder is valid.
    pub cycles_valid: u64,
    /// When the last of them was sampled.
    pub last_good: Option<UtcNs>,
    /// How well the loop kept its time, as far as that is known: a run that was cut short says it of its beginning only.
    pub timing: Option<TimingSummary>,
    /// How the run ended, if it did.
    pub end: Option<RunEnd>,
    /// Why reading stopped before the end of the file; none if the file is whole up to its end.
    pub cut: Option<String>,
    /// CRC-32 over all cycles and events as they are encoded.
    checksum: u32,
}

impl Salvaged {
    /// The file is finished, whole, and says how the run ended.
    pub fn is_whole(&self) -> bool {
        self.cut.is_none() && self.end.as_ref().is_some_and(|end| end.cycles == self.cycles)
    }

    /// In words: that the run was cut short, what is there, how it would have ended.
    fn cause(&self) -> String {
        let kept = match self.last_good {
            Some(last) => format!("{} cycles are whole, the last of {last}", self.cycles),
            None => "no cycle is whole".to_owned(),
        };
        let end = match &self.end {
            Some(end) if end.cycles == self.cycles => format!("; the run had ended: {}", end.cause),
            Some(end) => format!("; the run had ended with {} cycles: {}", end.cycles, end.cause),
            None => String::new(),
        };
        format!("recovered: the run was cut short; {kept}{end}")
    }
}

/// Why nothing could be salvaged.
#[derive(Debug, thiserror::Error)]
pub enum SalvageError {
    /// Not even the run's metadata are whole.
    #[error("nothing can be recovered, the beginning is not whole: {0}")]
    NothingWhole(ReadErrorKind),
    /// The finished recording cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// What was written does not read back as it was.
    #[error("the recovered file does not read back as it was written ({0}); the disk may be failing")]
    Verification(String),
}

/// Writes what is whole in `source` into `sink` as a finished recording whose end says that it was recovered.
pub fn salvage<W: Write + Seek>(source: impl Read, sink: W) -> Result<(Salvaged, W), SalvageError> {
    let mut writing = Writing { sink: Some(sink), writer: None };
    let salvaged = scan(source, Ending::AnyRecord, &mut |part| writing.take(part))?;
    let Some(writer) = writing.writer else {
        return Err(SalvageError::NothingWhole(no_metadata()));
    };
    let ended = salvaged.last_good.unwrap_or(salvaged.run.started);
    let end = RunEnd { recovered: true, ..writer.end_record(&salvaged.cause(), ended) };
    Ok((salvaged, writer.end_with(&end)?))
}

/// Reads a recovered recording back: it must be finished, and hold what `salvaged` says, bit for bit.
pub fn verify(source: impl Read, salvaged: &Salvaged) -> Result<(), SalvageError> {
    let differs = |what: &str| Err(SalvageError::Verification(what.to_owned()));
    let written = check(source)?;
    match written.end {
        Some(end) if end.recovered && end.cycles == salvaged.cycles => {}
        _ => return differs("its end is not what was written"),
    }
    if let Some(damage) = written.cut {
        return Err(SalvageError::Verification(damage));
    }
    if written.checksum != salvaged.checksum || written.cycles != salvaged.cycles {
        return differs("cycles or events differ");
    }
    if written.run != salvaged.run || written.timing != salvaged.timing {
        return differs("the run's metadata differ");
    }
    Ok(())
}

/// Reads a file through without keeping it, to know whether it is whole.
pub(super) fn check(source: impl Read) -> Result<Salvaged, SalvageError> {
    scan(source, Ending::Whole, &mut |_| Ok(()))
}

/// Begins the output as soon as it is known what it is about.
struct Writing<W: Write + Seek> {
    sink: Option<W>,
    writer: Option<RecordingWriter<W>>,
}

/// What a scan hands out.
enum Part<'a> {
    Run(&'a RunMetadata),
    Cycle(&'a CycleRecord),
    Event(&'a Event),
    Timing(&'a TimingSummary),
}

impl<W: Write + Seek> Writing<W> {
    fn take(&mut self, part: Part<'_>) -> Result<(), WriteError> {
        match (part, &mut self.writer) {
            (Part::Run(run), writer) => {
                if let Some(sink) = self.sink.take() {
                    *writer = Some(RecordingWriter::begin(sink, run)?);
                }
                Ok(())
            }
            (Part::Cycle(cycle), Some(writer)) => writer.write_cycle(cycle),
            (Part::Event(event), Some(writer)) => writer.write_event(event),
            (Part::Timing(timing), Some(writer)) => writer.write_timing(timing),
            // A scan hands out nothing before the metadata.
            (_, None) => Ok(()),
        }
    }
}

/// Why a scan stops.
enum Halt {
    Damage(ReadErrorKind),
    Write(WriteError),
}

impl From<ReadErrorKind> for Halt {
    fn from(damage: ReadErrorKind) -> Self {
        Self::Damage(damage)
    }
}

/// Hands out what is whole, in order, and says what that was.
fn scan(
    source: impl Read,
    ending: Ending,
    sink: &mut dyn FnMut(Part<'_>) -> Result<(), WriteError>,
) -> Result<Salvaged, SalvageError> {
    let (mut decoder, mut scan) = (Decoder::default(), Scan::default());
    let outcome = for_each_record(source, ending, &mut |record| {
        if ending == Ending::AnyRecord {
            scan.expect(&record)?;
        }
        match decoder.decode(record)? {
            Some(item) => scan.take(item, sink),
            None => Ok(()),
        }
    });
    match outcome {
        Err(Halt::Write(error)) => Err(error.into()),
        Err(Halt::Damage(damage)) => scan.finish(Some(damage)),
        Ok(()) => scan.finish(None),
    }
}

/// What a scan has seen.
#[derive(Default)]
struct Scan {
    run: Option<Box<RunMetadata>>,
    end: Option<RunEnd>,
    timing: Option<TimingSummary>,
    cycles: u64,
    cycles_valid: u64,
    last_good: Option<UtcNs>,
    hasher: Hasher,
    in_summary: bool,
    /// Messages of each channel that no index has listed yet.
    unlisted: BTreeMap<u16, usize>,
}

impl Scan {
    /// A flipped bit can make a chunk pass for a record that readers skip. Where no checksum over the file says
    /// otherwise, only what the writer puts there is believed.
    fn expect(&mut self, record: &Record<'_>) -> Result<(), ReadErrorKind> {
        let opcode = record.opcode();
        let expected = match opcode {
            op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA => true,
            // One bit away from a chunk: it must list just what lies before it.
            op::MESSAGE_INDEX => self.is_listed(record),
            op::DATA_END => !std::mem::replace(&mut self.in_summary, true),
            op::STATISTICS | op::CHUNK_INDEX | op::METADATA_INDEX | op::SUMMARY_OFFSET | op::FOOTER => {
                self.in_summary
            }
            _ => false,
        };
        if let Record::Message { header, .. } = record {
            *self.unlisted.entry(header.channel_id).or_default() += 1;
        }
        if expected { Ok(()) } else { Err(ReadErrorKind::UnexpectedRecord { opcode }) }
    }

    fn is_listed(&mut self, index: &Record<'_>) -> bool {
        matches!(index, Record::MessageIndex(index)
            if self.unlisted.remove(&index.channel_id) == Some(index.records.len()))
    }

    fn take(
        &mut self,
        item: Item,
        sink: &mut dyn FnMut(Part<'_>) -> Result<(), WriteError>,
    ) -> Result<(), Halt> {
        let misplaced = |what: &str| Halt::Damage(ReadErrorKind::Misplaced(what.to_owned()));
        match (&item, self.run.is_some(), self.end.is_some()) {
            (Item::Run(_), true, _) => return Err(misplaced("a second beginning")),
            (Item::Run(_), false, _) | (_, true, false) => {}
            (_, false, _) => return Err(misplaced("a record before the run's metadata")),
            (_, true, true) => return Err(misplaced("a record after the run's end")),
        }
        match item {
            Item::Run(run) => {
                sink(Part::Run(&run)).map_err(Halt::Write)?;
                self.run = Some(run);
            }
            Item::Cycle(cycle) => {
                self.hasher
                    .update(&messages::encode_cycle(&cycle).map_err(|error| Halt::Write(error.into()))?);
                sink(Part::Cycle(&cycle)).map_err(Halt::Write)?;
                self.cycles += 1;
                self.cycles_valid += u64::from(cycle.is_valid());
                self.last_good = Some(cycle.sample_time);
            }
            Item::Event(event) => {
                self.hasher
                    .update(&messages::encode_event(&event).map_err(|error| Halt::Write(error.into()))?);
                sink(Part::Event(&event)).map_err(Halt::Write)?;
            }
            Item::Timing(timing) => {
                sink(Part::Timing(&timing)).map_err(Halt::Write)?;
                self.timing = Some(*timing);
            }
            Item::End(end) => self.end = Some(end),
        }
        Ok(())
    }

    fn finish(self, damage: Option<ReadErrorKind>) -> Result<Salvaged, SalvageError> {
        let cut = damage.as_ref().map(ToString::to_string);
        let Some(run) = self.run else {
            return Err(SalvageError::NothingWhole(damage.unwrap_or_else(no_metadata)));
        };
        Ok(Salvaged {
            run: *run,
            cycles: self.cycles,
            cycles_valid: self.cycles_valid,
            last_good: self.last_good,
            timing: self.timing,
            end: self.end,
            cut,
            checksum: self.hasher.finalize(),
        })
    }
}

fn no_metadata() -> ReadErrorKind {
    ReadErrorKind::Metadata { name: RUN_METADATA, problem: "missing".into() }
}
