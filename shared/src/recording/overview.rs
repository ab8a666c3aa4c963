//! Reads the overview of a finished recording. Only the beginning and the end of the file are read, so that a list of many
//! recordings is built quickly.
//!
//! The end of an MCAP file is a summary, followed by a footer. The footer contains the offset of the summary. The summary
//! contains the offsets of the metadata records.

use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use crc32fast::Hasher;
use mcap::records::{Footer, Metadata, MetadataIndex, Record, op};
use mcap::{MAGIC, McapError};

use super::content::{END_METADATA, RUN_METADATA, content_of, run_of};
use super::disk::{Disk, OpenFile, SystemDisk};
use super::reader::{ReadError, ReadErrorKind};
use super::records::RECORD_LENGTH_BYTES_MAX;
use super::records::lengths::{PREFIX_BYTES, parse_record, split_prefix};
use super::schema::{RunEnd, RunMetadata};

/// Length of the footer: its prefix, two offsets and a checksum \[bytes\].
const FOOTER_BYTES: usize = PREFIX_BYTES + 20;
/// Length of the checksum at the end of the footer \[bytes\].
const CHECKSUM_BYTES: usize = 4;

/// Metadata from the beginning and the end of a finished recording. The data between them are not checked.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOverview {
    /// Names and settings of the run.
    pub run: RunMetadata,
    /// How the run ended.
    pub end: RunEnd,
}

impl RunOverview {
    /// Reads the metadata records of the run and of its end, at the offsets in the file's summary.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::open_on(&SystemDisk, path)
    }

    /// [`open`](Self::open) on another disk.
    pub fn open_on(disk: &dyn Disk, path: &Path) -> Result<Self, ReadError> {
        let error = |kind| ReadError { path: path.to_owned(), kind };
        let file = disk.open(path).map_err(|source| error(source.into()))?;
        Self::read(&mut OpenFile::new(disk, &file)).map_err(error)
    }

    fn read(file: &mut OpenFile<'_>) -> Result<Self, ReadErrorKind> {
        let indexes = metadata_indexes(file)?;
        let run = run_of(&metadata(file, &indexes, RUN_METADATA)?)?.0;
        let end = content_of(END_METADATA, &metadata(file, &indexes, END_METADATA)?)?;
        Ok(Self { run, end })
    }
}

/// Offsets and lengths of the metadata records, from the summary, whose checksum is checked. The summary is read record by
/// record, because it contains a record for each chunk: the summary of a run of days is longer than any record may be.
/// Records are parsed here and not by the MCAP library, because the library checks lengths only after it has allocated
/// memory (see [`parse_record`]).
fn metadata_indexes(file: &mut OpenFile<'_>) -> Result<Vec<MetadataIndex>, ReadErrorKind> {
    let (footer_at, footer) = read_footer(file)?;
    let Record::Footer(Footer { summary_start, summary_crc, .. }) =
        parse_record(footer[0], &footer[PREFIX_BYTES..])?
    else {
        return Err(McapError::BadFooter.into());
    };
    if summary_start == 0 {
        return Err(ReadErrorKind::Unfinished);
    }
    let mut unread = footer_at.checked_sub(summary_start).ok_or(McapError::BadFooter)?;
    file.seek(SeekFrom::Start(summary_start))?;
    let mut summary = BufReader::new(file.take(unread));
    let (mut hasher, mut indexes, mut record) = (Hasher::new(), Vec::new(), Vec::new());
    while unread > 0 {
        record.resize(PREFIX_BYTES, 0);
        summary.read_exact(&mut record)?;
        let (opcode, length, _) = split_prefix(&record).ok_or(McapError::UnexpectedEof)?;
        let bytes = PREFIX_BYTES.saturating_add(length);
        unread = unread.checked_sub(bytes as u64).ok_or(McapError::UnexpectedEof)?;
        if length > RECORD_LENGTH_BYTES_MAX {
            return Err(McapError::BadFooter.into());
        }
        record.resize(bytes, 0);
        summary.read_exact(&mut record[PREFIX_BYTES..])?;
        hasher.update(&record);
        if let Record::MetadataIndex(index) = parse_record(opcode, &record[PREFIX_BYTES..])? {
            indexes.push(index);
        }
    }
    hasher.update(&footer[..FOOTER_BYTES - CHECKSUM_BYTES]);
    let calculated = hasher.finalize();
    if calculated != summary_crc {
        return Err(McapError::BadSummaryCrc { saved: summary_crc, calculated }.into());
    }
    Ok(indexes)
}

/// Reads the footer. Returns its offset in the file and its bytes.
fn read_footer(file: &mut OpenFile<'_>) -> Result<(u64, [u8; FOOTER_BYTES]), ReadErrorKind> {
    let end = file.seek(SeekFrom::End(0))?;
    let footer_at = end.checked_sub((FOOTER_BYTES + MAGIC.len()) as u64).ok_or(McapError::UnexpectedEof)?;
    file.seek(SeekFrom::Start(footer_at))?;
    let mut footer = [0; FOOTER_BYTES];
    file.read_exact(&mut footer)?;
    let mut magic = [0; MAGIC.len()];
    file.read_exact(&mut magic)?;
    if magic == *MAGIC { Ok((footer_at, footer)) } else { Err(McapError::BadMagic.into()) }
}

/// Reads the metadata record with this name. The summary contains its offset.
fn metadata(
    file: &mut OpenFile<'_>,
    indexes: &[MetadataIndex],
    name: &'static str,
) -> Result<Metadata, ReadErrorKind> {
    let broken = |problem: &str| ReadErrorKind::Metadata { name, problem: problem.into() };
    let index = indexes.iter().find(|index| index.name == name);
    let MetadataIndex { offset, length, .. } = index.ok_or_else(|| broken("missing"))?;
    let length = usize::try_from(*length).unwrap_or(usize::MAX);
    if !(PREFIX_BYTES..=RECORD_LENGTH_BYTES_MAX).contains(&length) {
        return Err(broken("impossible length"));
    }
    file.seek(SeekFrom::Start(*offset))?;
    let mut bytes = vec![0; length];
    file.read_exact(&mut bytes)?;
    match parse_record(op::METADATA, &bytes[PREFIX_BYTES..])? {
        Record::Metadata(record) if record.name == name => Ok(record),
        _ => Err(broken("not where the summary says")),
    }
}
