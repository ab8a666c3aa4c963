//! The bytes of a log, in a file or in memory. The first bytes can be examined without reading the rest, so that the format
//! is recognised before the log is read.

use std::borrow::Cow;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use crate::logs::LogError;

/// Number of bytes that are read to recognise the format. The header of a table, after comments, must begin within them.
const BEGINNING_BYTES: u64 = 1 << 16;

/// Bytes from which a log is read.
pub(in crate::logs) struct LogSource<'a> {
    /// Path of the file, for error messages. Its extension may determine the format.
    pub path: &'a Path,
    /// The first [`BEGINNING_BYTES`] of a file, or all bytes in memory.
    beginning: Cow<'a, [u8]>,
    /// The open file, positioned after `beginning`; `None` for bytes in memory.
    rest: Option<File>,
}

impl<'a> LogSource<'a> {
    /// A source of bytes in memory.
    pub fn in_memory(bytes: &'a [u8], path: &'a Path) -> Self {
        Self { path, beginning: bytes.into(), rest: None }
    }

    /// Opens the file at `path` and reads its beginning.
    pub fn open(path: &'a Path) -> Result<Self, LogError> {
        let mut beginning = Vec::new();
        let mut open = || {
            let mut file = File::open(path)?;
            file.by_ref().take(BEGINNING_BYTES).read_to_end(&mut beginning)?;
            Ok(file)
        };
        let rest = open().map_err(|source| LogError::Unreadable { path: path.to_owned(), source })?;
        Ok(Self { path, beginning: beginning.into(), rest: Some(rest) })
    }

    /// The first bytes (at most [`BEGINNING_BYTES`]), enough to recognise the format.
    pub fn beginning(&self) -> &[u8] {
        let count = self.beginning.len().min(BEGINNING_BYTES as usize);
        &self.beginning[..count]
    }

    /// Reads all bytes at once.
    pub fn whole(self) -> Result<Cow<'a, [u8]>, LogError> {
        let Self { path, mut beginning, rest } = self;
        if let Some(mut rest) = rest {
            let read = rest.read_to_end(beginning.to_mut());
            read.map_err(|source| LogError::Unreadable { path: path.to_owned(), source })?;
        }
        Ok(beginning)
    }

    /// A reader of all bytes, which loads the file as it is read.
    pub fn reader(self) -> Box<dyn Read + 'a> {
        let beginning = Cursor::new(self.beginning);
        match self.rest {
            Some(rest) => Box::new(beginning.chain(rest)),
            None => Box::new(beginning),
        }
    }
}
