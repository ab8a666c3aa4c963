//! Checks lengths inside an MCAP record before the MCAP library reads it.
//!
//! The library reserves memory for a text by its length field, and only then checks whether the bytes are there: one flipped bit
//! would request 4 GB, which ends a process whose memory is locked or limited. It does not check, either, whether the records of
//! an uncompressed chunk end with it.

use mcap::McapError;
use mcap::records::{ChunkHeader, Record, op};

/// Opcode and length before each record.
pub(in crate::recording) const PREFIX_BYTES: usize = 9;

/// Opcode and length of the record at the beginning of `bytes`, and what follows its prefix.
pub(in crate::recording) fn split_prefix(bytes: &[u8]) -> Option<(u8, usize, &[u8])> {
    let (&[opcode, ref length @ ..], behind) = bytes.split_first_chunk::<PREFIX_BYTES>()?;
    Some((opcode, usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX), behind))
}

/// Parts of a record, up to its last length.
enum Part {
    /// A fixed number of bytes.
    Fixed(usize),
    /// A length of 32 bits, and as many bytes: a text, or numbers.
    Block,
    /// A block of texts, each with its length.
    Texts,
}

/// A record whose lengths stay within it.
///
/// # Errors
/// [`McapError::UnexpectedEof`] if a length extends beyond the record, and errors of the library.
pub fn parse_record(opcode: u8, data: &[u8]) -> Result<Record<'_>, McapError> {
    after_parts(data, layout(opcode)).ok_or(McapError::UnexpectedEof)?;
    mcap::parse_record(opcode, data)
}

/// Whether a record ends with the bytes that its last length field counts: its own length is then right, too. False for records
/// with fixed parts after them.
pub(in crate::recording) fn ends_with_its_content(opcode: u8, data: &[u8]) -> bool {
    after_parts(data, layout(opcode)).is_some_and(<[u8]>::is_empty)
}

/// Whether the records of an uncompressed chunk end with it; the library would read on behind its end. It checks compressed ones
/// itself.
pub(super) fn chunk_is_whole(header: &ChunkHeader, records: &[u8]) -> bool {
    let mut rest = if header.compression.is_empty() { records } else { &[] };
    while let Some((_, length, behind)) = split_prefix(rest) {
        let Some(next) = behind.get(length..) else { return false };
        rest = next;
    }
    rest.is_empty()
}

/// An MCAP file up to the first chunk that it holds only in part, or whose records do not end with the chunk.
pub fn up_to_broken_chunk(file: &[u8]) -> &[u8] {
    const MAGIC_BYTES: usize = 8;
    let mut rest = file.get(MAGIC_BYTES..).unwrap_or_default();
    while let Some((opcode, length, behind)) = split_prefix(rest) {
        let content = behind.split_at_checked(length);
        let is_whole = |(chunk, _): (&[u8], &[u8])| match parse_record(op::CHUNK, chunk) {
            Ok(Record::Chunk { header, data }) => chunk_is_whole(&header, &data),
            _ => false,
        };
        if opcode == op::CHUNK && !content.is_some_and(is_whole) {
            return &file[..file.len() - rest.len()];
        }
        let Some((_, next)) = content else { break };
        rest = next;
    }
    file
}

/// The beginning of a record up to its last length (MCAP specification, "Records").
const fn layout(opcode: u8) -> &'static [Part] {
    match opcode {
        op::HEADER => &[Part::Block, Part::Block],
        op::SCHEMA => &[Part::Fixed(2), Part::Block, Part::Block],
        op::CHANNEL => &[Part::Fixed(4), Part::Block, Part::Block, Part::Texts],
        op::CHUNK => &[Part::Fixed(28), Part::Block],
        op::CHUNK_INDEX => &[Part::Fixed(32), Part::Block, Part::Fixed(8), Part::Block],
        // Behind its texts come a length and a checksum, which the library takes for granted.
        op::ATTACHMENT => &[Part::Fixed(16), Part::Block, Part::Block, Part::Fixed(8 + 4)],
        op::ATTACHMENT_INDEX => &[Part::Fixed(40), Part::Block, Part::Block],
        op::METADATA => &[Part::Block, Part::Texts],
        op::METADATA_INDEX => &[Part::Fixed(16), Part::Block],
        _ => &[],
    }
}

/// The bytes after these parts.
fn after_parts<'a>(mut data: &'a [u8], parts: &[Part]) -> Option<&'a [u8]> {
    for part in parts {
        match part {
            Part::Fixed(bytes) => data = data.get(*bytes..)?,
            Part::Block => data = split_block(data)?.1,
            Part::Texts => {
                let (mut texts, behind) = split_block(data)?;
                while !texts.is_empty() {
                    texts = split_block(texts)?.1;
                }
                data = behind;
            }
        }
    }
    Some(data)
}

/// A block, and what follows it.
fn split_block(data: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = data.split_first_chunk::<4>()?;
    rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)
}
