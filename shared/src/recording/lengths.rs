//! Lengths inside an MCAP record are looked at before the MCAP library is.
//!
//! The library reserves memory for a text as its length field says, and only then looks whether the bytes are there: one
//! flipped bit would ask for 4 GB, which ends a process whose memory is locked or limited.

use mcap::McapError;
use mcap::records::{Record, op};

/// What a record is made of, as far as it has lengths.
enum Part {
    /// As many bytes.
    Fixed(usize),
    /// A length of 32 bits, and as many bytes: a text, or numbers.
    Block,
    /// A block of texts, each with its length.
    Texts,
}

/// A record whose lengths stay within it.
///
/// # Errors
/// [`McapError::UnexpectedEof`] where a length reaches beyond the record, and what the library says.
pub fn parse_record(opcode: u8, data: &[u8]) -> Result<Record<'_>, McapError> {
    pass(data, layout(opcode)).ok_or(McapError::UnexpectedEof)?;
    mcap::parse_record(opcode, data)
}

/// The beginning of a record up to its last length (MCAP specification, "Records").
const fn layout(opcode: u8) -> &'static [Part] {
    match opcode {
        op::HEADER => &[Part::Block, Part::Block],
        op::SCHEMA => &[Part::Fixed(2), Part::Block, Part::Block],
        op::CHANNEL => &[Part::Fixed(4), Part::Block, Part::Block, Part::Texts],
        op::CHUNK => &[Part::Fixed(28), Part::Block],
        op::CHUNK_INDEX => &[Part::Fixed(32), Part::Block, Part::Fixed(8), Part::Block],
        op::ATTACHMENT => &[Part::Fixed(16), Part::Block, Part::Block],
        op::ATTACHMENT_INDEX => &[Part::Fixed(40), Part::Block, Part::Block],
        op::METADATA => &[Part::Block, Part::Texts],
        op::METADATA_INDEX => &[Part::Fixed(16), Part::Block],
        _ => &[],
    }
}

fn pass(mut data: &[u8], parts: &[Part]) -> Option<()> {
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
    Some(())
}

/// A block, and what follows it.
fn split_block(data: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = data.split_first_chunk::<4>()?;
    rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)
}
