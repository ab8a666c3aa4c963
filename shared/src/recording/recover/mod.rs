//! Writes the undamaged parts of a recording that was cut short or damaged as a finished one.
//!
//! All records with a valid checksum (*proven* records, see `resync`) are kept, wherever they are in the file. Cycles between
//! them are marked as lost, so that numbers have no hole and no value is invented. Works on any source and sink; `leftover`
//! applies it to files.

mod leftover;
mod resync;

use std::io::{self, Read, Seek, Write};

use crc32fast::Hasher;
use mcap::records::Record;

use super::content::{Decoder, Item, RUN_METADATA, run_of};
use super::messages::{self, CycleLayout, MessageError};
use super::reader::{ReadErrorKind, check_count, take_run};
use super::records::for_each_record;
use super::schema::{CycleRecord, Event, EventKind, RunEnd, RunMetadata, flags};
use super::timing::TimingSummary;
use super::writer::{RecordingWriter, WriteError};
use crate::time::{NS_PER_S, UtcNs};

pub use leftover::{
    Leftover, RecoverError, Recovery, is_in_use, recover_file, recover_file_on, recover_leftovers,
    recover_leftovers_on,
};
pub use resync::Damage;
use resync::{Refused, for_each_proven_record};

/// Bytes that a cycle takes in a file at least: its entry in the index of its chunk.
const CYCLE_BYTES_MIN: u64 = 16;
/// Code of the event that states which cycles were in a damaged part of the file.
const DAMAGED_CODE: &str = "file_damaged";
/// Most cycles that may be missing though no byte is damaged: a write that never reached the disk left no trace.
const UNTRACED_CYCLES_MAX: u64 = 100_000;
/// A cycle behind a hole was sampled when its number and the period predict, within this \[ns\] plus a part of the time since
/// the last whole cycle. Old blocks of another run's file do not pass.
const TIME_SLACK_NS: i128 = 10 * NS_PER_S as i128;
/// That part is one in this number: rates of crystals differ by less.
const TIME_SLACK_PARTS: i128 = 1000;

/// Content of a recovered recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Salvaged {
    /// Who, what, with which settings.
    pub run: RunMetadata,
    /// Cycles, numbered without a hole, the lost ones among them.
    pub cycles: u64,
    /// Cycles among them in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles among them of which only the number is known.
    pub cycles_lost: u64,
    /// When the last cycle that is whole was sampled.
    pub last_good: Option<UtcNs>,
    /// Timing of the loop, if it is known: of a run that was cut short only of its beginning.
    pub timing: Option<TimingSummary>,
    /// How the run ended, if it did.
    pub end: Option<RunEnd>,
    /// What could not be read; none of a file that was only cut short between two records.
    pub damage: Option<Damage>,
    /// CRC-32 over all cycles and events as they are encoded.
    checksum: u32,
}

impl Salvaged {
    /// The cause of the end, in words: damage, number of whole cycles, and the end that the run had.
    fn cause(&self) -> String {
        let cut = if self.end.is_none() { ": the run was cut short" } else { "" };
        let damage = self.damage.map_or(String::new(), |damage| format!("; {damage}"));
        let lost = match self.cycles_lost {
            0 => String::new(),
            lost => format!("; {lost} cycles are lost"),
        };
        let kept = match self.last_good {
            Some(last) => format!("{} cycles are whole, the last of {last}", self.cycles - self.cycles_lost),
            None => "no cycle is whole".to_owned(),
        };
        let end =
            self.end.as_ref().map_or(String::new(), |end| format!("; the run had ended: {}", end.cause));
        format!("recovered{cut}{damage}{lost}; {kept}{end}")
    }
}

/// Why nothing could be salvaged.
#[derive(Debug, thiserror::Error)]
pub enum SalvageError {
    /// The run's metadata are whole nowhere in the file.
    #[error("nothing can be recovered: {0}")]
    NothingWhole(ReadErrorKind),
    /// The system could not read it.
    #[error("cannot be read: {0}; check the path and its permissions")]
    Io(#[from] io::Error),
    /// The finished recording cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The written file does not read back as it was written.
    #[error(
        "the recovered file does not read back as it was written ({0}); check the disk, then recover again"
    )]
    Verification(String),
}

impl From<MessageError> for SalvageError {
    fn from(error: MessageError) -> Self {
        WriteError::from(error).into()
    }
}

/// Writes the undamaged parts of `source` into `sink` as a finished recording that is marked as recovered.
pub fn salvage<W: Write + Seek>(
    mut source: impl Read + Seek,
    sink: W,
) -> Result<(Salvaged, W), SalvageError> {
    let (run, layout) = find_run(&mut source)?;
    let mut decoder = Decoder::with_usual_channels(layout);
    let mut rewriting = Rewriting {
        writer: RecordingWriter::begin(sink, &run)?,
        seen: OrderedContent { run: Some(run.clone()), ..OrderedContent::default() },
        run,
        last: None,
        damaged_bytes: 0,
    };
    let damage = for_each_proven_record(source, &mut |record, damage| {
        decoder.decode(record)?.map_or(Ok(()), |item| rewriting.take(item, damage))
    })?;
    rewriting.finish(damage)
}

/// Metadata of the run that `source` is about: the first that are whole.
pub(super) fn find_run(source: impl Read + Seek) -> Result<(RunMetadata, CycleLayout), SalvageError> {
    /// What ends the search.
    enum Found {
        Run(Box<(RunMetadata, CycleLayout)>),
        Io(io::Error),
    }
    impl From<io::Error> for Found {
        fn from(error: io::Error) -> Self {
            Self::Io(error)
        }
    }
    let outcome = for_each_proven_record(source, &mut |record, _| match record {
        Record::Metadata(metadata) if metadata.name == RUN_METADATA => {
            Err(Refused::Stop(Found::Run(Box::new(run_of(&metadata)?))))
        }
        _ => Ok(()),
    });
    match outcome {
        Err(Found::Run(run)) => Ok(*run),
        Err(Found::Io(error)) => Err(error.into()),
        Ok(_) => Err(SalvageError::NothingWhole(no_metadata())),
    }
}

/// Reads a recovered recording back: it must be finished, and contain what `salvaged` has, bit for bit.
pub fn verify(source: impl Read, salvaged: &Salvaged) -> Result<(), SalvageError> {
    let differs = |what: &str| Err(SalvageError::Verification(what.to_owned()));
    let written = check(source).map_err(|damage| SalvageError::Verification(damage.to_string()))?;
    match written.end {
        Some(end) if end.recovered && end.cycles == salvaged.cycles => {}
        _ => return differs("its end is not what was written"),
    }
    if written.checksum != salvaged.checksum || written.cycles != salvaged.cycles {
        return differs("cycles or events differ");
    }
    if written.run != salvaged.run || written.timing != salvaged.timing {
        return differs("the run's metadata differ");
    }
    Ok(())
}

/// Reads a file through without keeping it: it is finished and whole, or the error has the reason.
pub(super) fn check(source: impl Read) -> Result<Salvaged, ReadErrorKind> {
    let (mut decoder, mut seen) = (Decoder::default(), OrderedContent::default());
    for_each_record(source, &mut |record| {
        decoder.decode(record)?.map_or(Ok(()), |item| seen.take(item).map(drop))
    })?;
    check_count(seen.end.as_ref().ok_or(ReadErrorKind::Unfinished)?, seen.cycles)?;
    seen.finish(None)
}

/// Writes undamaged items into the new file.
struct Rewriting<W: Write + Seek> {
    writer: RecordingWriter<W>,
    seen: OrderedContent,
    run: RunMetadata,
    /// The last cycle that is whole.
    last: Option<CycleRecord>,
    /// Number of damaged bytes before that cycle.
    damaged_bytes: u64,
}

impl<W: Write + Seek> Rewriting<W> {
    fn take(&mut self, item: Item, damage: &Damage) -> Result<(), Refused<SalvageError>> {
        if let Item::Cycle(cycle) = &item {
            self.fill_hole_before(cycle, damage)?;
            (self.last, self.damaged_bytes) = (Some(*cycle), damage.bytes);
        }
        self.put(item)
    }

    fn put(&mut self, item: Item) -> Result<(), Refused<SalvageError>> {
        let item = self.seen.take(item)?;
        let written = match &item {
            Item::Run(_) | Item::End(_) => Ok(()),
            Item::Cycle(cycle) => self.writer.write_cycle(cycle),
            Item::Event(event) => self.writer.write_event(event),
            Item::Timing(timing) => self.writer.write_timing(timing),
        };
        written.map_err(|error| Refused::Stop(error.into()))
    }

    /// Writes the cycles between the last whole one and `next` as lost. Refuses a `next` whose number or time does not fit.
    fn fill_hole_before(&mut self, next: &CycleRecord, damage: &Damage) -> Result<(), Refused<SalvageError>> {
        let first = self.seen.cycles;
        if next.cycle == first && damage.bytes == self.damaged_bytes {
            return Ok(());
        }
        // Out of place: written twice, or by another run that had these blocks of the disk before.
        if next.cycle < first || next.cycle - first > self.hole_cycles_max(damage) {
            return Err(Refused::Damage);
        }
        let last = self.last;
        let (last_cycle, last_ns) =
            last.map_or((0, self.run.started.0), |last| (last.cycle, last.sample_time.0));
        let (last_ns, next_ns) = (i128::from(last_ns), i128::from(next.sample_time.0));
        let since_ns = self.cycles_ns(next.cycle - last_cycle);
        let off_ns = (next_ns - (last_ns + since_ns)).abs();
        if off_ns > TIME_SLACK_NS + since_ns / TIME_SLACK_PARTS {
            return Err(Refused::Damage);
        }
        if next.cycle == first {
            return Ok(());
        }
        // Times of lost cycles are interpolated; before the first whole cycle they follow from the period.
        let period_ns = self.cycles_ns(1);
        let time_ns = |cycle: u64| match last {
            Some(_) => {
                let (passed, all) = (i128::from(cycle - last_cycle), i128::from(next.cycle - last_cycle));
                last_ns + (next_ns - last_ns) * passed / all
            }
            None => next_ns - period_ns * i128::from(next.cycle - cycle),
        };
        self.fill(first..next.cycle, last.as_ref().unwrap_or(next), time_ns)
    }

    /// Writes cycles behind the last whole one as lost, up to the number in the end record.
    fn fill_to_end(&mut self, damage: &Damage) -> Result<(), Refused<SalvageError>> {
        let (Some(last), Some(end)) = (self.last, &self.seen.end) else { return Ok(()) };
        let missing = self.seen.cycles..end.cycles;
        if missing.is_empty() || end.cycles - missing.start > self.hole_cycles_max(damage) {
            return Ok(());
        }
        let period_ns = self.cycles_ns(1);
        // Nothing may follow the end record: it is put back afterwards.
        let end = self.seen.end.take();
        let filled = self.fill(missing, &last, |cycle| {
            i128::from(last.sample_time.0) + period_ns * i128::from(cycle - last.cycle)
        });
        self.seen.end = end;
        filled
    }

    /// Writes `missing` cycles as lost, with encoders as in `near`, and an event that states their number.
    fn fill(
        &mut self,
        missing: std::ops::Range<u64>,
        near: &CycleRecord,
        time_ns: impl Fn(u64) -> i128,
    ) -> Result<(), Refused<SalvageError>> {
        let time_of = |cycle| UtcNs(i64::try_from(time_ns(cycle)).unwrap_or(near.sample_time.0));
        let text = format!("{} cycles lost: their part of the file was damaged", missing.end - missing.start);
        let (time, cycle) = (time_of(missing.start), missing.start);
        for cycle in missing {
            self.put(Item::Cycle(CycleRecord::lost(cycle, time_of(cycle), near)))?;
        }
        let code = DAMAGED_CODE.into();
        self.put(Item::Event(Event { time, cycle, kind: EventKind::Gap, text, code }))
    }

    /// Most cycles that can have been in the damaged bytes since the last whole cycle.
    fn hole_cycles_max(&self, damage: &Damage) -> u64 {
        UNTRACED_CYCLES_MAX.max((damage.bytes - self.damaged_bytes) / CYCLE_BYTES_MIN)
    }

    fn cycles_ns(&self, cycles: u64) -> i128 {
        i128::from(cycles) * i128::from(self.run.cycle_period_ns)
    }

    fn finish(mut self, damage: Damage) -> Result<(Salvaged, W), SalvageError> {
        match self.fill_to_end(&damage) {
            Err(Refused::Stop(error)) => return Err(error),
            // Cycles that cannot be filled in are missing at the end.
            Err(Refused::Damage) | Ok(()) => {}
        }
        let Self { writer, seen, run, .. } = self;
        let salvaged =
            seen.finish((damage.bytes > 0).then_some(damage)).map_err(SalvageError::NothingWhole)?;
        let ended = salvaged.last_good.unwrap_or(run.started);
        let end = RunEnd { recovered: true, ..writer.end_record(&salvaged.cause(), ended) };
        Ok((salvaged, writer.end_with(&end)?))
    }
}

/// Content read so far, in order.
#[derive(Default)]
struct OrderedContent {
    run: Option<RunMetadata>,
    end: Option<RunEnd>,
    timing: Option<TimingSummary>,
    cycles: u64,
    cycles_valid: u64,
    cycles_lost: u64,
    last_good: Option<UtcNs>,
    hasher: Hasher,
}

impl OrderedContent {
    /// Records an item and returns it, or why it cannot be there.
    fn take(&mut self, item: Item) -> Result<Item, ReadErrorKind> {
        let misplaced = |what: &str| Err(ReadErrorKind::Misplaced(what.to_owned()));
        match (&item, &self.run, &self.end) {
            (Item::Run(_), _, _) | (_, Some(_), None) => {}
            (_, None, _) => return misplaced("a record before the run's metadata"),
            (_, Some(_), Some(_)) => return misplaced("a record after the run's end"),
        }
        match &item {
            Item::Run(run) => take_run(&mut self.run, (**run).clone())?,
            Item::Cycle(cycle) => {
                if cycle.cycle != self.cycles {
                    return Err(ReadErrorKind::Hole { expected: self.cycles, found: cycle.cycle });
                }
                self.hasher.update(&messages::encode_cycle(cycle).map_err(undecodable)?);
                self.cycles += 1;
                self.cycles_valid += u64::from(cycle.is_valid());
                if cycle.flags & flags::LOST == 0 {
                    self.last_good = Some(cycle.sample_time);
                } else {
                    self.cycles_lost += 1;
                }
            }
            Item::Event(event) => self.hasher.update(&messages::encode_event(event).map_err(undecodable)?),
            Item::Timing(timing) => self.timing = Some((**timing).clone()),
            Item::End(end) => self.end = Some(end.clone()),
        }
        Ok(item)
    }

    fn finish(self, damage: Option<Damage>) -> Result<Salvaged, ReadErrorKind> {
        Ok(Salvaged {
            run: self.run.ok_or_else(no_metadata)?,
            cycles: self.cycles,
            cycles_valid: self.cycles_valid,
            cycles_lost: self.cycles_lost,
            last_good: self.last_good,
            timing: self.timing,
            end: self.end,
            damage,
            checksum: self.hasher.finalize(),
        })
    }
}

fn undecodable(error: MessageError) -> ReadErrorKind {
    ReadErrorKind::Misplaced(error.to_string())
}

fn no_metadata() -> ReadErrorKind {
    ReadErrorKind::Metadata { name: RUN_METADATA, problem: "missing".into() }
}
