//! What a finished recording is about, from its ends alone: a directory of many is listed at once.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use mcap::Summary;
use mcap::records::{MetadataIndex, Record, op};
use mcap::sans_io::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use serde::de::DeserializeOwned;

use super::content::{END_METADATA, RUN_METADATA, content_of};
use super::reader::{ReadError, ReadErrorKind};
use super::records::RECORD_LENGTH_BYTES_MAX;
use super::schema::{RunEnd, RunMetadata};

/// Opcode and length before each record.
const PREFIX_BYTES: usize = 9;

/// Beginning and end of a finished recording. Says nothing of whether what lies between is whole.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOverview {
    /// Who, what, with which settings.
    pub run: RunMetadata,
    /// How the run ended.
    pub end: RunEnd,
}

impl RunOverview {
    /// Reads the two metadata records that the file's summary points at.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let error = |kind| ReadError { path: path.to_owned(), kind };
        let mut file = File::open(path).map_err(|source| error(source.into()))?;
        Self::read(&mut file).map_err(error)
    }

    fn read(file: &mut File) -> Result<Self, ReadErrorKind> {
        let summary = summary_of(file)?.ok_or(ReadErrorKind::Unfinished)?;
        let run = metadata(file, &summary, RUN_METADATA)?;
        Ok(Self { run, end: metadata(file, &summary, END_METADATA)? })
    }
}

fn summary_of(file: &mut File) -> Result<Option<Summary>, ReadErrorKind> {
    let options = SummaryReaderOptions::default()
        .with_file_size(file.metadata()?.len())
        .with_record_length_limit(RECORD_LENGTH_BYTES_MAX);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event? {
            SummaryReadEvent::ReadRequest(wanted) => {
                let count = file.read(reader.insert(wanted.min(RECORD_LENGTH_BYTES_MAX)))?;
                reader.notify_read(count);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to)?),
        }
    }
    Ok(reader.finish())
}

fn metadata<T: DeserializeOwned>(
    file: &mut File,
    summary: &Summary,
    name: &'static str,
) -> Result<T, ReadErrorKind> {
    let broken = |problem: &str| ReadErrorKind::Metadata { name, problem: problem.into() };
    let index = summary.metadata_indexes.iter().find(|index| index.name == name);
    let MetadataIndex { offset, length, .. } = index.ok_or_else(|| broken("missing"))?;
    let length = usize::try_from(*length).unwrap_or(usize::MAX);
    if !(PREFIX_BYTES..=RECORD_LENGTH_BYTES_MAX).contains(&length) {
        return Err(broken("impossible length"));
    }
    file.seek(SeekFrom::Start(*offset))?;
    let mut bytes = vec![0; length];
    file.read_exact(&mut bytes)?;
    match mcap::parse_record(op::METADATA, &bytes[PREFIX_BYTES..])? {
        Record::Metadata(record) if record.name == name => content_of(name, &record),
        _ => Err(broken("not where the summary says")),
    }
}
