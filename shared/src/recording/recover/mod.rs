//! Writes the undamaged records of a damaged or interrupted recording into a new, finished recording.
//!
//! A record is *proven* if its checksum is correct (see `resync`). All proven records are kept, wherever they are in the
//! file. Missing cycles between them are written as lost. Cycle numbers thus stay consecutive, and no value is invented.
//! This module reads from any source and writes to any sink; `leftover` applies it to files. A cycle is called *whole*
//! if it is not lost.

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
    recover_leftovers_on, set_aside,
};
pub use resync::Damage;
use resync::{Refused, for_each_proven_record};

/// Smallest number of bytes that a cycle needs in a file. Each cycle has an entry of this length in the index of its chunk.
const CYCLE_BYTES_MIN: u64 = 16;
/// Code of the event that reports cycles lost by damage of the file.
const DAMAGED_CODE: &str = "file_damaged";
/// Largest number of cycles that may be missing although no byte is damaged. This happens if a write never reached the disk.
const UNTRACED_CYCLES_MAX: u64 = 100_000;
/// Tolerance for the sample time of the first cycle after a gap \[ns\]. The expected time follows from the number of cycles
/// in the gap and from the period. The tolerance also contains a fraction ([`TIME_SLACK_PARTS`]) of the time since the last
/// whole cycle. Cycles outside the tolerance may be from an old disk block of another run's file, and are rejected. An end
/// record that is earlier than the last whole cycle by more than 10 s is rejected for the same reason.
const TIME_SLACK_NS: i128 = 10 * NS_PER_S as i128;
/// Divisor of this fraction: the tolerance grows by 1 in 1000 of the time. The rates of two crystals differ by less.
const TIME_SLACK_PARTS: i128 = 1000;

/// Content of a recovered recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Salvaged {
    /// Names and settings of the run.
    pub run: RunMetadata,
    /// Number of cycles, including lost ones. They are numbered consecutively.
    pub cycles: u64,
    /// Number of cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Number of lost cycles. Of a lost cycle, only its number in the run is known.
    pub cycles_lost: u64,
    /// Sample time of the last whole cycle. `None` if no cycle is whole.
    pub last_good: Option<UtcNs>,
    /// Timing of the loop, if the file contains it. If the run was cut short, it covers only its beginning.
    pub timing: Option<TimingSummary>,
    /// How the run ended. `None` if the run was cut short.
    pub end: Option<RunEnd>,
    /// The damaged bytes. `None` if no byte is damaged, for example if the file was only cut off between two records.
    pub damage: Option<Damage>,
    /// CRC-32 over all encoded cycles and events.
    checksum: u32,
}

impl Salvaged {
    /// Text of the cause in the new end record. It contains the damage, the number of whole cycles, and the cause
    /// in the original end record.
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
    /// The file contains no undamaged copy of the run's metadata.
    #[error("nothing can be recovered: {0}")]
    NothingWhole(ReadErrorKind),
    /// The file could not be read.
    #[error("cannot be read: {0}; check the path and its permissions")]
    Io(#[from] io::Error),
    /// The finished recording cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The new file does not contain what was written to it.
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

/// Writes the undamaged records of `source` into `sink`, as a finished recording that is marked as recovered.
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

/// Finds the first undamaged copy of the run's metadata in `source`.
pub(super) fn find_run(source: impl Read + Seek) -> Result<(RunMetadata, CycleLayout), SalvageError> {
    /// Why the search ended: the metadata were found, or reading failed.
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

/// Reads a recovered recording and checks that it is finished and has exactly the content of `salvaged`.
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

/// Reads a whole file, but does not keep its cycles. Returns an error if the file is unfinished or damaged.
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
    /// Content of the new file so far. It determines which items are allowed next; other items are refused.
    seen: OrderedContent,
    run: RunMetadata,
    /// The last whole cycle that was written.
    last: Option<CycleRecord>,
    /// Number of damaged bytes before the cycle `last`.
    damaged_bytes: u64,
}

impl<W: Write + Seek> Rewriting<W> {
    fn take(&mut self, item: Item, damage: &Damage) -> Result<(), Refused<SalvageError>> {
        match &item {
            Item::Cycle(cycle) => {
                self.fill_hole_before(cycle, damage)?;
                (self.last, self.damaged_bytes) = (Some(*cycle), damage.bytes);
            }
            Item::End(end) if !self.is_plausible(end) => return Err(Refused::Damage),
            _ => {}
        }
        self.put(item)
    }

    /// Whether an end record fits the content so far. If it does not, it may be from an old disk block of another run's file.
    fn is_plausible(&self, end: &RunEnd) -> bool {
        let RunEnd { ended, cycles, .. } = *end;
        let is_after = |last: UtcNs| i128::from(ended.0) + TIME_SLACK_NS >= i128::from(last.0);
        cycles >= self.seen.cycles && ended >= self.run.started && self.seen.last_good.is_none_or(is_after)
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

    /// Writes the missing cycles before `next` as lost. Refuses `next` if its number or its time is not plausible.
    fn fill_hole_before(&mut self, next: &CycleRecord, damage: &Damage) -> Result<(), Refused<SalvageError>> {
        let first = self.seen.cycles;
        if next.cycle == first && damage.bytes == self.damaged_bytes {
            return Ok(());
        }
        // The number of the cycle does not fit. The cycle was written twice, or belongs to another run that
        // used these disk blocks before.
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
        // Sample times of lost cycles are interpolated. If there is no whole cycle before them, they
        // are computed from the period.
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

    /// Writes the missing cycles after the last whole cycle as lost, up to the number of cycles in the end record.
    fn fill_to_end(&mut self, damage: &Damage) -> Result<(), Refused<SalvageError>> {
        let (Some(last), Some(end)) = (self.last, &self.seen.end) else { return Ok(()) };
        let missing = self.seen.cycles..end.cycles;
        if missing.is_empty() || end.cycles - missing.start > self.hole_cycles_max(damage) {
            return Ok(());
        }
        let period_ns = self.cycles_ns(1);
        // `seen` accepts no cycle after the end record. The end record is therefore removed here, and put back afterwards.
        let end = self.seen.end.take();
        let filled = self.fill(missing, &last, |cycle| {
            i128::from(last.sample_time.0) + period_ns * i128::from(cycle - last.cycle)
        });
        self.seen.end = end;
        filled
    }

    /// Writes the cycles with the numbers `missing` as lost, and an event with their number. The joints and the origin of
    /// these cycles are copied from the cycle `near`. `time_ns` returns the sample time of a cycle \[ns since 1970\].
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

    /// Largest number of cycles that can be missing: the number that fits into the damaged bytes since the last whole cycle,
    /// but at least [`UNTRACED_CYCLES_MAX`].
    fn hole_cycles_max(&self, damage: &Damage) -> u64 {
        UNTRACED_CYCLES_MAX.max((damage.bytes - self.damaged_bytes) / CYCLE_BYTES_MIN)
    }

    fn cycles_ns(&self, cycles: u64) -> i128 {
        i128::from(cycles) * i128::from(self.run.cycle_period_ns)
    }

    fn finish(mut self, damage: Damage) -> Result<(Salvaged, W), SalvageError> {
        match self.fill_to_end(&damage) {
            Err(Refused::Stop(error)) => return Err(error),
            // If the number of missing cycles is not plausible, they are not added, and the recording ends earlier.
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

/// The content read so far. Checks the order of items.
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
    /// Stores an item and returns it. Returns an error if the item is not allowed at this position.
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
