//! Reads a complete recording, or returns an error that states why the file cannot be read.
//!
//! A damaged file must never yield a wrong number. The reader therefore makes three checks:
//! - The checksum of a chunk is checked before the chunk is unpacked.
//! - Record lengths are limited, because a flipped bit in a length could otherwise request the whole address space.
//! - The checksum over the data section and the consecutive cycle numbers prove that no data are missing.

use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};

use mcap::McapError;

use super::content::{Decoder, Item, LIBRARY_NAME, RUN_METADATA};
use super::disk::{Disk, OpenFile, SystemDisk};
use super::messages::MessageError;
use super::records::for_each_record;
use super::schema::{CycleRecord, Event, RunEnd, RunMetadata};
use super::timing::TimingSummary;

/// Why a file cannot be read as a recording.
#[derive(Debug, thiserror::Error)]
#[error("{}: {kind}", path.display())]
pub struct ReadError {
    /// Path of the file concerned.
    pub path: PathBuf,
    /// What is wrong with the file.
    pub kind: ReadErrorKind,
}

/// What is wrong with a recording.
#[derive(Debug, thiserror::Error)]
pub enum ReadErrorKind {
    /// The file could not be read.
    #[error("cannot be read: {0}; check the path and its permissions")]
    Io(#[from] io::Error),
    /// The MCAP structure is broken.
    #[error("damaged or not an MCAP file: {0}; if a run was cut short, run `ballbard recover` on the file")]
    Container(#[from] McapError),
    /// A chunk has no checksum, so that its content cannot be verified.
    #[error(
        "damaged: a chunk without a checksum; if a run was cut short, run `ballbard recover` on the file"
    )]
    NoChecksum,
    /// A record is at a position in the file at which the format does not allow it.
    #[error("damaged: {0}; if a run was cut short, run `ballbard recover` on the file")]
    Misplaced(String),
    /// A message cannot be decoded although the checksum of its chunk is correct.
    #[error(
        "message {sequence} on {topic}: {source}; the file was not written by this software or is damaged"
    )]
    Message {
        /// Topic of the message.
        topic: &'static str,
        /// Number of the broken message.
        sequence: u32,
        /// Why the message cannot be decoded.
        source: MessageError,
    },
    /// A metadata record is missing or damaged, or the MCAP file is from another program.
    #[error("no valid `{name}` record ({problem}); give a recording of `ballbard`")]
    Metadata {
        /// Name of the record.
        name: &'static str,
        /// What is wrong with the record.
        problem: String,
    },
    /// The run has no end record.
    #[error("the run was never finished (its end is missing); run `ballbard recover` on the file")]
    Unfinished,
    /// The cycle numbers are not consecutive.
    #[error("cycle {expected} is missing, cycle {found} follows instead; run `ballbard recover` on the file")]
    Hole {
        /// Number of the next cycle.
        expected: u64,
        /// The number that the file contains instead.
        found: u64,
    },
    /// The number of cycles in the end record differs from the number of cycles in the file.
    #[error("{read} cycles, but the run's end counts {counted}; run `ballbard recover` on the file")]
    CycleCount {
        /// Number of cycles in the file.
        read: u64,
        /// Number in the end record.
        counted: u64,
    },
}

/// A complete recording, whose run has ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Names and settings of the run.
    pub run: RunMetadata,
    /// Every bus cycle, numbered consecutively.
    pub cycles: Vec<CycleRecord>,
    /// Events of the run, in order.
    pub events: Vec<Event>,
    /// Timing of the loop; `None` in virtual time. In a recovered recording it may include only some of the cycles, see
    /// [`TimingSummary::cycles`].
    pub timing: Option<TimingSummary>,
    /// How the run ended.
    pub end: RunEnd,
}

impl Recording {
    /// Whether the first bytes of a file are those of a recording. The recording may be damaged, cut short or still being
    /// written. Other MCAP files, such as ROS 2 bags, are not recordings.
    pub fn is_begun_by(beginning: &[u8]) -> bool {
        // The name of the library and the metadata of the run are both near the beginning. If one of them is damaged, the
        // other still identifies the recording.
        let has = |name: &[u8]| beginning.windows(name.len()).any(|window| window == name);
        beginning.starts_with(mcap::MAGIC) && (has(LIBRARY_NAME.as_bytes()) || has(RUN_METADATA.as_bytes()))
    }

    /// Reads a finished recording from a file.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::open_on(&SystemDisk, path)
    }

    /// [`open`](Self::open) on another disk.
    pub fn open_on(disk: &dyn Disk, path: &Path) -> Result<Self, ReadError> {
        let error = |kind| ReadError { path: path.to_owned(), kind };
        let file = disk.open(path).map_err(|source| error(source.into()))?;
        Self::read(BufReader::new(OpenFile::new(disk, &file))).map_err(error)
    }

    /// Reads a finished recording from any source of bytes.
    pub fn read(source: impl Read) -> Result<Self, ReadErrorKind> {
        let mut cycles = Vec::new();
        let outline = Outline::read(source, &mut |cycle| {
            cycles.push(cycle);
            Ok::<_, ReadErrorKind>(())
        })?;
        let Outline { run, events, timing, end } = outline;
        Ok(Self { run, cycles, events, timing, end })
    }
}

/// A complete recording without its cycles. The cycles are passed on one by one while the file is read. Memory therefore
/// does not grow with the length of the run.
#[derive(Debug, Clone, PartialEq)]
pub struct Outline {
    /// As in [`Recording`].
    pub run: RunMetadata,
    /// As in [`Recording`].
    pub events: Vec<Event>,
    /// As in [`Recording`].
    pub timing: Option<TimingSummary>,
    /// As in [`Recording`].
    pub end: RunEnd,
}

impl Outline {
    /// Reads a finished recording from any source of bytes, and passes each cycle to `take`, in order. Until this function
    /// returns `Ok`, the caller must not rely on these cycles, because the recording may turn out to be incomplete.
    pub fn read<E: From<ReadErrorKind>>(
        source: impl Read,
        take: &mut dyn FnMut(CycleRecord) -> Result<(), E>,
    ) -> Result<Self, E> {
        let (mut decoder, mut content) = (Decoder::default(), Content::default());
        for_each_record(source, &mut |record| {
            let Some(item) = decoder.decode(record)? else { return Ok(()) };
            content.take(item)?.map_or(Ok(()), &mut *take)
        })?;
        Ok(content.finish()?)
    }
}

/// Checks that the end record contains the number of cycles that were read.
pub(super) fn check_count(end: &RunEnd, read: u64) -> Result<(), ReadErrorKind> {
    let counted = end.cycles;
    if counted == read { Ok(()) } else { Err(ReadErrorKind::CycleCount { read, counted }) }
}

/// Stores the metadata of the run. A file contains two copies of them, and both must be equal.
pub(super) fn take_run(known: &mut Option<RunMetadata>, run: RunMetadata) -> Result<(), ReadErrorKind> {
    match known {
        Some(known) if *known != run => {
            Err(ReadErrorKind::Misplaced("it contains the metadata of a second run".into()))
        }
        Some(_) => Ok(()),
        None => {
            *known = Some(run);
            Ok(())
        }
    }
}

/// The content that has been read so far.
#[derive(Default)]
struct Content {
    run: Option<RunMetadata>,
    end: Option<RunEnd>,
    timing: Option<TimingSummary>,
    cycles: u64,
    events: Vec<Event>,
}

impl Content {
    /// Stores an item. A cycle is not stored. It is counted and returned if its number is the next one.
    fn take(&mut self, item: Item) -> Result<Option<CycleRecord>, ReadErrorKind> {
        match item {
            Item::Run(run) => take_run(&mut self.run, *run)?,
            Item::Cycle(cycle) => {
                if cycle.cycle != self.cycles {
                    return Err(ReadErrorKind::Hole { expected: self.cycles, found: cycle.cycle });
                }
                self.cycles += 1;
                return Ok(Some(cycle));
            }
            Item::Event(event) => self.events.push(event),
            Item::Timing(timing) => self.timing = Some(*timing),
            Item::End(end) => self.end = Some(end),
        }
        Ok(None)
    }

    fn finish(self) -> Result<Outline, ReadErrorKind> {
        let missing = |name| ReadErrorKind::Metadata { name, problem: "missing".into() };
        let run = self.run.ok_or_else(|| missing(RUN_METADATA))?;
        let end = self.end.ok_or(ReadErrorKind::Unfinished)?;
        check_count(&end, self.cycles)?;
        Ok(Outline { run, events: self.events, timing: self.timing, end })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_record_with_another_number_of_cycles_is_refused_with_both_numbers() {
        let end = serde_json::json!({
            "cause": "stopped", "ended": 0, "cycles": 50, "cycles_valid": 50, "cycles_lost": 0
        });
        let end: RunEnd = serde_json::from_value(end).unwrap();
        assert!(check_count(&end, 50).is_ok());
        let refused = check_count(&end, 100).unwrap_err().to_string();
        assert!(refused.starts_with("100 cycles, but the run's end counts 50;"), "{refused}");
    }
}
