//! The MCAP layer: reads a file and passes each of its records to a function. Stops at the first error.
//!
//! Chunks are unpacked here and not by the MCAP library, because the library accepts a chunk whose checksum field is zero. A
//! power cut can leave zeros in a file.

pub(super) mod lengths;

use std::io::Read;

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::reader::ReadErrorKind;
use lengths::{PREFIX_BYTES, chunk_is_whole, parse_record};

/// Longest record that is accepted. It is far longer than one second of cycles at 1 kHz, and far smaller than the memory.
pub(super) const RECORD_LENGTH_BYTES_MAX: usize = 64 << 20;

/// Passes every record of the file to `sink`. For a chunk, the records in the chunk are passed on, and not the chunk itself.
pub(super) fn for_each_record<E: From<ReadErrorKind>>(
    source: impl Read,
    sink: &mut dyn FnMut(Record<'_>) -> Result<(), E>,
) -> Result<(), E> {
    let reader = LinearReader::new_with_options(
        options()
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true),
    );
    drive(reader, source, &mut |opcode, data| {
        if opcode == op::CHUNK { open_chunk(data, sink) } else { sink(parse(opcode, data)?) }
    })
}

fn options() -> LinearReaderOptions {
    LinearReaderOptions::default().with_record_length_limit(RECORD_LENGTH_BYTES_MAX)
}

/// Checks a complete chunk, then passes its records to `sink`.
pub(super) fn open_chunk<E: From<ReadErrorKind>>(
    chunk: &[u8],
    sink: &mut dyn FnMut(Record<'_>) -> Result<(), E>,
) -> Result<(), E> {
    if let Record::Chunk { header, data } = parse(op::CHUNK, chunk)? {
        if header.uncompressed_crc == 0 {
            return Err(ReadErrorKind::NoChecksum.into());
        }
        if !chunk_is_whole(&header, &data) {
            return Err(ReadErrorKind::from(McapError::UnexpectedEoc).into());
        }
    }
    let reader = LinearReader::new_with_options(
        options().with_skip_start_magic(true).with_skip_end_magic(true).with_prevalidate_chunk_crcs(true),
    );
    // The reader expects the prefix (opcode and length) before the content of the chunk, as in a file.
    let mut prefix = [0; PREFIX_BYTES];
    prefix[0] = op::CHUNK;
    prefix[1..].copy_from_slice(&(chunk.len() as u64).to_le_bytes());
    drive(reader, prefix.chain(chunk), &mut |opcode, data| sink(parse(opcode, data)?))
}

fn parse(opcode: u8, data: &[u8]) -> Result<Record<'_>, ReadErrorKind> {
    Ok(parse_record(opcode, data)?)
}

/// Receives the opcode and the content of a record.
type RawSink<'a, E> = dyn FnMut(u8, &[u8]) -> Result<(), E> + 'a;

/// Reads from `source`, lets `reader` split the bytes into records, and passes each record to `sink`.
fn drive<E: From<ReadErrorKind>>(
    mut reader: LinearReader,
    mut source: impl Read,
    sink: &mut RawSink<'_, E>,
) -> Result<(), E> {
    let container = |error: McapError| E::from(ReadErrorKind::from(error));
    while let Some(event) = reader.next_event() {
        match event.map_err(container)? {
            LinearReadEvent::ReadRequest(wanted) => {
                let buffer = reader.insert(wanted.min(RECORD_LENGTH_BYTES_MAX));
                let count = source.read(buffer).map_err(ReadErrorKind::from)?;
                reader.notify_read(count);
            }
            LinearReadEvent::Record { data, opcode } => sink(opcode, data)?,
        }
    }
    Ok(())
}
