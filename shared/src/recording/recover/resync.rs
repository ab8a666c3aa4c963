//! Finds the undamaged records of an MCAP file, for [`salvage`](super::salvage).
//!
//! Chunks, attachments and our metadata records have their own checksums. Such a record is *proven* if its checksum is
//! correct, wherever in the file it is. All other records, such as indexes, have no checksum and contain nothing that is
//! needed. They are skipped if they look exactly as our writer writes them.
//!
//! All other content is damage. After damage, the file is searched byte by byte for the next record with a checksum. Memory
//! is limited by the longest allowed record.

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read, Seek, SeekFrom};

use mcap::MAGIC;
use mcap::records::{Record, op};

use crate::recording::content::{OUR_METADATA, is_proven};
use crate::recording::reader::ReadErrorKind;
use crate::recording::records::lengths::{PREFIX_BYTES, ends_with_its_content, parse_record, split_prefix};
use crate::recording::records::{RECORD_LENGTH_BYTES_MAX, open_chunk};

/// Opcodes at which the search after damage stops. Records with a checksum, or the end of the data section, begin with them.
const BEGINNINGS: [u8; 4] = [op::CHUNK, op::METADATA, op::ATTACHMENT, op::DATA_END];
/// Number of bytes that are enough to compare the lengths at the beginning of a record with each other.
const HEAD_BYTES: usize = 64;
/// Number of bytes that are read from the source at a time.
const READ_BYTES: usize = 256 << 10;
/// Length of a disk sector \[bytes\]. If the disk cannot read a sector, all of its bytes are lost.
const SECTOR_BYTES: u64 = 4096;
/// Length of the fields of a chunk before the name of its compression: times, size and checksum \[bytes\].
const CHUNK_FIXED_BYTES: usize = 28;
/// Longest name of a compression method \[bytes\].
const COMPRESSION_NAME_BYTES_MAX: usize = 4;

/// The bytes of a file that could not be used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Damage {
    /// Number of all damaged bytes.
    pub bytes: u64,
    /// Number of separate damaged segments in the file.
    pub places: u64,
    /// Offset of the first damaged byte in the file.
    pub first_at: u64,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { bytes, places, first_at } = self;
        let places = if *places == 1 { "1 place".to_owned() } else { format!("{places} places") };
        write!(f, "{bytes} bytes in {places} could not be read, the first at byte {first_at}")
    }
}

/// Why the content of a chunk or a metadata record was not used.
pub(super) enum Refused<E> {
    /// The content is not possible at this position. It counts as damage.
    Damage,
    /// Reading must stop with this error.
    Stop(E),
}

impl<E> From<ReadErrorKind> for Refused<E> {
    fn from(_: ReadErrorKind) -> Self {
        Self::Damage
    }
}

/// Receives a record, and the damage that was found before it.
type RecordSink<'a, E> = dyn FnMut(Record<'_>, &Damage) -> Result<(), Refused<E>> + 'a;

/// Passes every proven record of the data section to `sink`, and returns the damage. Chunks are unpacked: `sink` receives
/// the records in the chunk.
pub(super) fn for_each_proven_record<E: From<io::Error>>(
    source: impl Read + Seek,
    sink: &mut RecordSink<'_, E>,
) -> Result<Damage, E> {
    let mut file = Window::new(source)?;
    let mut around = Surroundings::default();
    let mut damage = Damage::default();
    let mut damaged_until = None;
    while !file.peek(1)?.is_empty() {
        // A proven record is passed to `sink`. A record without a checksum is skipped if our writer can have written it.
        let proven = match proven_length(file.peek(HEAD_BYTES)?) {
            Some(length) => take_proven(file.peek(length)?, length, &mut around, &damage, sink)?,
            None => None,
        };
        let length = match proven {
            Some(length) => Some(length),
            None => around.unproven_length(&mut file)?,
        };
        if let Some(length) = length {
            file.skip(length);
            continue;
        }
        // All other bytes are damage. The damage extends to the next byte that may begin a record with a checksum.
        if damaged_until != Some(file.at) {
            damage.first_at = if damage.places == 0 { file.at } else { damage.first_at };
            damage.places += 1;
        }
        let rest = file.peek(READ_BYTES)?;
        let next = rest.iter().skip(1).position(|byte| BEGINNINGS.contains(byte));
        let bytes = next.map_or(rest.len(), |skipped| skipped + 1);
        damage.bytes += bytes as u64;
        file.skip(bytes);
        damaged_until = Some(file.at);
    }
    Ok(damage)
}

/// Length of a record including its prefix. `None` unless the bytes look like the beginning of a record with a checksum.
fn proven_length(head: &[u8]) -> Option<usize> {
    let (opcode, length, content) = split_prefix(head)?;
    let seems = length <= RECORD_LENGTH_BYTES_MAX
        && match opcode {
            op::CHUNK => chunk_length(content) == Some(length as u64),
            op::METADATA => leading_text(content)
                .is_some_and(|name| OUR_METADATA.iter().any(|ours| ours.as_bytes() == name)),
            op::ATTACHMENT => true,
            _ => false,
        };
    seems.then(|| PREFIX_BYTES + length)
}

/// Length of a chunk's content, computed from the length fields inside it.
fn chunk_length(content: &[u8]) -> Option<u64> {
    let compression = leading_text(content.get(CHUNK_FIXED_BYTES..)?)?;
    let before = CHUNK_FIXED_BYTES + size_of::<u32>() + compression.len();
    let records_length = content.get(before..)?.first_chunk::<8>()?;
    let length = u64::from_le_bytes(*records_length).checked_add((before + 8) as u64);
    length.filter(|_| compression.len() <= COMPRESSION_NAME_BYTES_MAX)
}

/// The text at the beginning of a record's content.
fn leading_text(bytes: &[u8]) -> Option<&[u8]> {
    let (length, rest) = bytes.split_first_chunk::<4>()?;
    rest.get(..usize::try_from(u32::from_le_bytes(*length)).ok()?)
}

/// Passes a record to `sink` if it is complete and its checksum is correct. Returns its length in this case.
fn take_proven<E>(
    bytes: &[u8],
    length: usize,
    around: &mut Surroundings,
    damage: &Damage,
    sink: &mut RecordSink<'_, E>,
) -> Result<Option<usize>, E> {
    let Some((opcode, _, content)) = split_prefix(bytes) else { return Ok(None) };
    if bytes.len() != length {
        return Ok(None);
    }
    let mut messages = BTreeMap::new();
    let outcome = match opcode {
        op::CHUNK => open_chunk(content, &mut |record| {
            if let Record::Message { header, .. } = &record {
                *messages.entry(header.channel_id).or_default() += 1;
            }
            sink(record, damage)
        }),
        op::METADATA => match parse_record(opcode, content) {
            Ok(Record::Metadata(metadata))
                if ends_with_its_content(opcode, content) && is_proven(&metadata) =>
            {
                sink(Record::Metadata(metadata), damage)
            }
            _ => Err(Refused::Damage),
        },
        _ => attachment(content),
    };
    match outcome {
        Ok(()) => {
            around.unlisted = messages;
            Ok(Some(length))
        }
        Err(Refused::Damage) => Ok(None),
        Err(Refused::Stop(error)) => Err(error),
    }
}

/// Checks that an attachment is complete. Its content is not needed, because the metadata contain it, too.
fn attachment<E>(content: &[u8]) -> Result<(), Refused<E>> {
    let whole = matches!(parse_record(op::ATTACHMENT, content), Ok(Record::Attachment { crc, .. })
        if content.split_last_chunk::<4>().is_some_and(|(before, _)| crc32fast::hash(before) == crc));
    if whole { Ok(()) } else { Err(Refused::Damage) }
}

/// State of the search. It determines which records without a checksum may be at the current position.
#[derive(Default)]
struct Surroundings {
    /// For each channel, number of messages in the last chunk that no index record has listed yet. The index records of a
    /// chunk follow the chunk; each removes its channel from this map.
    unlisted: BTreeMap<u16, usize>,
    in_summary: bool,
    after_footer: bool,
}

impl Surroundings {
    /// Length of a record without a checksum. `None` unless such a record is possible here and looks exactly
    /// as our writer writes it.
    fn unproven_length<R: Read + Seek>(&mut self, file: &mut Window<R>) -> io::Result<Option<usize>> {
        if (file.at == 0 || self.after_footer) && file.peek(MAGIC.len())? == MAGIC {
            return Ok(Some(MAGIC.len()));
        }
        let follows_magic = file.at == MAGIC.len() as u64;
        let Some((opcode, length, _)) = split_prefix(file.peek(PREFIX_BYTES)?) else { return Ok(None) };
        if !self.may_have(opcode, follows_magic) || length > RECORD_LENGTH_BYTES_MAX {
            return Ok(None);
        }
        let bytes = file.peek(PREFIX_BYTES + length)?;
        if bytes.len() != PREFIX_BYTES + length {
            return Ok(None);
        }
        let Ok(record) = parse_record(opcode, &bytes[PREFIX_BYTES..]) else { return Ok(None) };
        Ok(self.expects(&record, &bytes[PREFIX_BYTES..]).then_some(bytes.len()))
    }

    fn may_have(&self, opcode: u8, follows_magic: bool) -> bool {
        match opcode {
            op::HEADER => follows_magic,
            op::MESSAGE_INDEX => !self.unlisted.is_empty(),
            op::DATA_END => !self.in_summary,
            op::SCHEMA | op::CHANNEL | op::STATISTICS | op::CHUNK_INDEX | op::METADATA_INDEX => {
                self.in_summary
            }
            op::ATTACHMENT_INDEX | op::SUMMARY_OFFSET | op::FOOTER => self.in_summary,
            _ => false,
        }
    }

    /// Whether a record is possible at this position. In the data section, the length in its prefix must equal the length of
    /// its content. Otherwise one wrong bit in the length could hide the records after this one.
    fn expects(&mut self, record: &Record<'_>, content: &[u8]) -> bool {
        match record {
            Record::Header(_) => ends_with_its_content(op::HEADER, content),
            // One flipped bit turns the opcode of a chunk into the opcode of a message index. The index is therefore
            // accepted only if it matches the last chunk.
            Record::MessageIndex(index) => {
                let listed = index.records.len();
                content.len() == size_of::<u16>() + size_of::<u32>() + listed * 2 * size_of::<u64>()
                    && self.unlisted.remove(&index.channel_id) == Some(listed)
            }
            Record::DataEnd(_) => {
                self.in_summary = content.len() == size_of::<u32>();
                self.in_summary
            }
            Record::Footer(_) => {
                self.after_footer = true;
                true
            }
            _ => true,
        }
    }
}

/// A window of the source. Bytes remain in memory as long as they may be read again. `start` in the buffer and `at` in the
/// source are the same position.
struct Window<R> {
    source: R,
    /// Length of the source.
    source_bytes: u64,
    buffer: Vec<u8>,
    /// Beginning of the window, as an offset in `buffer`.
    start: usize,
    /// Beginning of the window, as an offset in the source \[bytes\].
    at: u64,
    /// Offset in the source at which the last read error occurred \[bytes\].
    refused_at: Option<u64>,
}

impl<R: Read + Seek> Window<R> {
    fn new(mut source: R) -> io::Result<Self> {
        let source_bytes = source.seek(SeekFrom::End(0))?;
        source.rewind()?;
        Ok(Self { source, source_bytes, buffer: Vec::new(), start: 0, at: 0, refused_at: None })
    }

    /// The next `bytes` bytes of the source, or fewer at its end. The position does not change.
    fn peek(&mut self, bytes: usize) -> io::Result<&[u8]> {
        while self.buffer.len() - self.start < bytes {
            if self.start > READ_BYTES {
                self.buffer.drain(..self.start);
                self.start = 0;
            }
            let missing = bytes - (self.buffer.len() - self.start);
            let length = self.buffer.len();
            match (&mut self.source).take(missing.max(READ_BYTES) as u64).read_to_end(&mut self.buffer) {
                Ok(0) => break,
                Err(error) if error.raw_os_error() == Some(nix::libc::EIO) => {
                    let read = self.buffer.len() > length;
                    if !read && !self.pass_bad_sector()? {
                        break;
                    }
                }
                Ok(_) => {}
                Err(error) => return Err(error),
            }
        }
        let end = self.buffer.len().min(self.start + bytes);
        Ok(&self.buffer[self.start..end])
    }

    /// Handles a read error of the disk. After the first error at a position, the read is only repeated, because a disk may
    /// fail once and then succeed. After the second error, the rest of the sector is replaced by zeros. Returns false at the
    /// end of the source.
    fn pass_bad_sector(&mut self) -> io::Result<bool> {
        let at = self.at + (self.buffer.len() - self.start) as u64;
        if self.refused_at.replace(at) != Some(at) {
            self.source.seek(SeekFrom::Start(at))?;
            return Ok(true);
        }
        let next = (at / SECTOR_BYTES + 1) * SECTOR_BYTES;
        let end = next.min(self.source_bytes);
        self.source.seek(SeekFrom::Start(end))?;
        self.buffer.resize(self.buffer.len() + end.saturating_sub(at) as usize, 0);
        Ok(end > at)
    }

    fn skip(&mut self, bytes: usize) {
        self.start += bytes;
        self.at += bytes as u64;
    }
}
