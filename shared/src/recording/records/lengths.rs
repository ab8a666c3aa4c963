//! Checks the length fields inside an MCAP record before the MCAP library parses the record.
//!
//! The library allocates memory for a text according to the text's length field. Only then does it check whether the record
//! contains that many bytes. One flipped bit could therefore request 4 GB, which ends a process whose memory is locked or
//! limited. The library also does not check whether the records of an uncompressed chunk fill the chunk exactly.
//!
//! A record consists of a prefix (opcode and length) and its content. This module describes the content as a sequence of
//! `Part`s. Example, a chunk, in bytes:
//!
//! ```text
//! bytes:     1        8        28          4 + n         8                   n
//! content:   opcode | length | fields    | length + name | length of records | records
//! part:      (prefix)        | Fixed(28) | Block         | (not described)
//! ```

use mcap::McapError;
use mcap::records::{ChunkHeader, Record, op};

/// Length of the prefix of a record: opcode and length of the content.
pub(in crate::recording) const PREFIX_BYTES: usize = 9;

/// Splits `bytes`, which begin with a record. Returns the opcode, the length of the record's content, and
/// the bytes after the prefix.
pub(in crate::recording) fn split_prefix(bytes: &[u8]) -> Option<(u8, usize, &[u8])> {
    let (&[opcode, ref length @ ..], behind) = bytes.split_first_chunk::<PREFIX_BYTES>()?;
    Some((opcode, usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX), behind))
}

/// A part of a record's content. Parts after the last length field are not described.
enum Part {
    /// This number of bytes.
    Fixed(usize),
    /// A length field of 32 bits, followed by that many bytes, which are text or numbers.
    Block,
    /// A block that consists of texts, each with its own length field.
    Texts,
}

/// Parses a record after checking that its length fields do not exceed the record.
///
/// # Errors
/// [`McapError::UnexpectedEof`] if a length field exceeds the record; otherwise the errors of the library.
pub fn parse_record(opcode: u8, data: &[u8]) -> Result<Record<'_>, McapError> {
    after_parts(data, layout(opcode)).ok_or(McapError::UnexpectedEof)?;
    mcap::parse_record(opcode, data)
}

/// Whether the content of a record ends exactly where its described parts end. If so, the length in the record's prefix is
/// correct, too. False for records with more content after the described parts.
pub(in crate::recording) fn ends_with_its_content(opcode: u8, data: &[u8]) -> bool {
    after_parts(data, layout(opcode)).is_some_and(<[u8]>::is_empty)
}

/// Whether the records of an uncompressed chunk fill the chunk exactly. If they did not, the library would read beyond the
/// chunk. True for a compressed chunk, because the library checks these chunks.
pub(super) fn chunk_is_whole(header: &ChunkHeader, records: &[u8]) -> bool {
    let mut rest = if header.compression.is_empty() { records } else { &[] };
    while let Some((_, length, behind)) = split_prefix(rest) {
        let Some(next) = behind.get(length..) else { return false };
        rest = next;
    }
    rest.is_empty()
}

/// The beginning of an MCAP file, up to the first broken chunk. A chunk is broken if it is incomplete, or if its records do
/// not fill it exactly. Without a broken chunk, the whole file is returned.
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

/// The parts of a record's content up to its last length field, as the MCAP specification defines them ("Records").
const fn layout(opcode: u8) -> &'static [Part] {
    match opcode {
        op::HEADER => &[Part::Block, Part::Block],
        op::SCHEMA => &[Part::Fixed(2), Part::Block, Part::Block],
        op::CHANNEL => &[Part::Fixed(4), Part::Block, Part::Block, Part::Texts],
        op::CHUNK => &[Part::Fixed(28), Part::Block],
        op::CHUNK_INDEX => &[Part::Fixed(32), Part::Block, Part::Fixed(8), Part::Block],
        // The texts of an attachment are followed by a length (8 bytes) and a checksum (4 bytes). The
        // library assumes that both exist.
        op::ATTACHMENT => &[Part::Fixed(16), Part::Block, Part::Block, Part::Fixed(8 + 4)],
        op::ATTACHMENT_INDEX => &[Part::Fixed(40), Part::Block, Part::Block],
        op::METADATA => &[Part::Block, Part::Texts],
        op::METADATA_INDEX => &[Part::Fixed(16), Part::Block],
        _ => &[],
    }
}

/// Skips these parts and returns the bytes after them. `None` if `data` are too short.
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

/// Splits `data` into its first block and the bytes after that block.
fn split_block(data: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = data.split_first_chunk::<4>()?;
    rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)
}
