//! Decodes the text of a table from the bytes of its file, which are UTF-8, UTF-16, Windows-1252 (Latin-1) or a workbook.
//!
//! [`Text`] decodes the file block by block, empties lines of white space, collects the comments `# key: value`, and counts
//! lines for error messages. The `csv` crate reads its output. [`RowsAsText`] is used to guess the layout of a table.

use std::borrow::Cow;
use std::io::{self, Cursor, Read};
use std::path::Path;

use encoding_rs::{Decoder, Encoding, WINDOWS_1252};

use super::csv_text::CsvTable;
use super::workbook::{is_workbook, sheets, text_of_sheet};
use crate::logs::source::LogSource;
use crate::logs::{CsvLayout, LogError};

/// The first character of a comment line.
pub(super) const COMMENT: u8 = b'#';
/// Size of the blocks in which a file is read and decoded.
const BLOCK_BYTES: u64 = 1 << 18;

/// The text of a file, without its byte order mark. It is decoded block by block while it is read, because ten hours of a
/// robot's log are a gigabyte. The text of a workbook is that of one sheet: the sheet with a given name, or the only sheet.
/// It has a line for each row, and tabs between the cells.
///
/// In a file without a byte order mark, a line that is not valid UTF-8 is decoded as Windows-1252. Some instruments export
/// micro and degree signs in this encoding. Numbers are not affected, because digits have the same bytes in both encodings.
pub(in crate::logs) struct Text<'a> {
    /// Path of the file, for errors.
    pub path: &'a Path,
    source: Box<dyn Read + 'a>,
    /// Decoder for the encoding of the byte order mark; `None` without such a mark.
    decoder: Option<Decoder>,
    /// Beginning of a line whose end was not read yet, in UTF-8 or Windows-1252.
    partial_line: Vec<u8>,
    /// Decoded whole lines. Lines that were both read and counted are removed.
    lines: String,
    /// Offset of `lines` in the whole decoded text. The offsets below also refer to the whole text.
    lines_start: usize,
    /// Offset up to which the text was read by the `csv` crate.
    read_to: usize,
    /// Offset at which the table begins, after the skipped lines.
    table_start: usize,
    /// Offset up to which lines were counted.
    counted_to: usize,
    /// Number of the line at `counted_to`, from 1.
    line: u64,
    comments: Vec<(String, String)>,
    is_at_end: bool,
}

impl<'a> Text<'a> {
    /// Opens the text of a file. `sheet` is the name of the sheet if the file is a workbook.
    ///
    /// # Errors
    /// [`LogError::NotText`] for binary data, for a workbook with several sheets if `sheet` is `None`, and for a file that is
    /// not a workbook if a `sheet` is given. Binary data after the first block cause this error only when they are reached.
    pub fn new(source: LogSource<'a>, sheet: Option<&str>) -> Result<Self, LogError> {
        let path = source.path;
        let mut text = Self {
            path,
            source: Box::new(io::empty()),
            decoder: None,
            partial_line: Vec::new(),
            lines: String::new(),
            lines_start: 0,
            read_to: 0,
            table_start: 0,
            counted_to: 0,
            line: 1,
            comments: Vec::new(),
            is_at_end: false,
        };
        if is_workbook(source.beginning()) {
            let sheet = text_of_sheet(&source.whole()?, sheet).map_err(|problem| text.bad(problem))?;
            text.source = Box::new(Cursor::new(sheet));
        } else if let Some(sheet) = sheet {
            let problem =
                format!("not a workbook, but the mapping names the sheet `{sheet}`: remove `sheet`");
            return Err(text.bad(problem));
        } else {
            // The decoder removes the byte order mark.
            text.decoder = Encoding::for_bom(source.beginning()).map(|(encoding, _)| encoding.new_decoder());
            text.source = source.reader();
        }
        text.decode_more()?;
        Ok(text)
    }

    /// The whole text as a string.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn whole(mut self) -> Result<String, LogError> {
        while self.decode_more()? {}
        Ok(self.lines)
    }

    /// Skips this number of lines, which are before the table.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn skip_lines(&mut self, count: usize) -> Result<(), LogError> {
        for _ in 0..count {
            let line_length = |unread: &str| unread.find('\n').map(|end| end + 1);
            while line_length(self.unread()).is_none() && self.decode_more()? {}
            if self.unread().is_empty() {
                break;
            }
            self.read_to += line_length(self.unread()).unwrap_or(self.unread().len());
        }
        self.table_start = self.read_to;
        Ok(())
    }

    /// The first line that is neither blank nor a comment.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn header_line(&mut self) -> Result<&str, LogError> {
        while header_line(self.unread()).is_empty() && self.decode_more()? {}
        Ok(header_line(self.unread()))
    }

    /// The comment lines `# key: value` that were decoded so far, with keys in lower case.
    pub fn comments(&self) -> &[(String, String)] {
        &self.comments
    }

    /// Line number of a record. Records must be passed in the order of the text. `byte` is the position of the record
    /// according to the `csv` crate. This position is before the comments and blank lines that precede the record. For the
    /// same reason the line numbers of that crate are too small.
    pub fn line_of_record(&mut self, byte: u64) -> u64 {
        self.count_lines(self.table_start + byte as usize);
        while let Some(length) = self.length_of_skipped_line() {
            self.count_lines(self.counted_to + length);
        }
        self.line
    }

    /// Counts the lines that end before `until`.
    fn count_lines(&mut self, until: usize) {
        let passed = self
            .lines
            .as_bytes()
            .get(self.counted_to - self.lines_start..until.saturating_sub(self.lines_start));
        self.line += line_ends(passed);
        self.counted_to = self.counted_to.max(until);
    }

    /// Length of the next line with its line end, if it is a comment or blank; `None` otherwise.
    fn length_of_skipped_line(&self) -> Option<usize> {
        let rest = self.lines.as_bytes().get(self.counted_to - self.lines_start..)?;
        if !matches!(*rest.first()?, COMMENT | b'\r' | b'\n') {
            return None;
        }
        let end = rest.iter().position(|&byte| byte == b'\n').map_or(rest.len(), |end| end + 1);
        let line = rest.get(..end)?;
        let skipped = is_comment(line) || line.iter().all(|byte| matches!(byte, b'\r' | b'\n'));
        skipped.then_some(end)
    }

    /// The text that was decoded, but not read yet.
    fn unread(&self) -> &str {
        self.lines.get(self.read_to - self.lines_start..).unwrap_or_default()
    }

    /// Decodes at least one more line and adds it to `lines`. Returns false at the end of the file.
    fn decode_more(&mut self) -> Result<bool, LogError> {
        if self.is_at_end {
            return Ok(false);
        }
        // Reads until there is a line end.
        let mut end = None;
        while end.is_none() && !self.is_at_end {
            let from = self.partial_line.len();
            self.read_block()?;
            let last_end = self.partial_line[from..].iter().rposition(|&byte| byte == b'\n');
            end = last_end.map(|end| from + end + 1);
        }
        // Decodes the whole lines, and keeps the beginning of the last one for the next call.
        let rest = match end {
            Some(end) if !self.is_at_end => self.partial_line.split_off(end),
            _ => Vec::new(),
        };
        let lines = String::from_utf8(std::mem::replace(&mut self.partial_line, rest));
        let mut lines = lines.unwrap_or_else(|error| each_utf8_or_windows_1252(error.as_bytes()));
        if self.is_at_end && !lines.is_empty() && !lines.ends_with('\n') {
            // Without a line end the `csv` crate would read a comment as a row.
            lines.push('\n');
        }
        // Removes the lines that were both read and counted.
        let done = self.read_to.min(self.counted_to) - self.lines_start;
        // A read may end within a character. In this case nothing is removed yet.
        let done = if self.lines.is_char_boundary(done) { done } else { 0 };
        self.lines.drain(..done);
        self.lines_start += done;
        // Checks the new lines and adds them.
        if let Some((in_lines, character)) = control_character(&lines) {
            let uncounted = self.lines.as_bytes().get(self.counted_to - self.lines_start..);
            let before = lines.as_bytes().get(..in_lines);
            let line = self.line + line_ends(uncounted) + line_ends(before);
            return Err(self.bad(format!("character {character:?} in line {line}")));
        }
        self.comments.extend(comments(&lines));
        self.lines += &with_empty_blank_lines(&lines);
        Ok(true)
    }

    /// Reads a block and appends it to `partial_line`. If the file has a byte order mark, the block is converted to UTF-8.
    fn read_block(&mut self) -> Result<(), LogError> {
        let mut block = Vec::new();
        let read = self.source.by_ref().take(BLOCK_BYTES).read_to_end(&mut block);
        let read = read.map_err(|source| LogError::Unreadable { path: self.path.to_owned(), source })?;
        self.is_at_end = (read as u64) < BLOCK_BYTES;
        let Some(decoder) = &mut self.decoder else {
            self.partial_line.append(&mut block);
            return Ok(());
        };
        let mut decoded = String::new();
        decoded.reserve(decoder.max_utf8_buffer_length(read).unwrap_or_default());
        let (_, _, is_damaged) = decoder.decode_to_string(&block, &mut decoded, self.is_at_end);
        if is_damaged {
            return Err(self.bad("its content does not have the encoding of its byte order mark".into()));
        }
        self.partial_line.extend(decoded.into_bytes());
        Ok(())
    }

    fn bad(&self, problem: String) -> LogError {
        LogError::NotText { path: self.path.to_owned(), problem }
    }
}

/// Errors of this reader contain a [`LogError`].
impl Read for Text<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        while self.read_to == self.lines_start + self.lines.len()
            && self.decode_more().map_err(io::Error::other)?
        {}
        let mut unread = self.lines.as_bytes().get(self.read_to - self.lines_start..).unwrap_or_default();
        let read = unread.read(into)?;
        self.read_to += read;
        Ok(read)
    }
}

fn line_ends(text: Option<&[u8]>) -> u64 {
    text.unwrap_or_default().iter().filter(|&&byte| byte == b'\n').count() as u64
}

fn each_utf8_or_windows_1252(lines: &[u8]) -> String {
    let line = |line: &[u8]| match std::str::from_utf8(line) {
        Ok(line) => line.to_owned(),
        Err(_) => WINDOWS_1252.decode_without_bom_handling(line).0.into_owned(),
    };
    lines.split_inclusive(|&byte| byte == b'\n').map(line).collect()
}

/// Empties the lines that contain only white space, because the `csv` crate skips only empty lines.
fn with_empty_blank_lines(lines: &str) -> Cow<'_, str> {
    let is_blank = |line: &str| line != "\n" && line.trim().is_empty();
    if !lines.split_inclusive('\n').any(is_blank) {
        return lines.into();
    }
    lines.split_inclusive('\n').map(|line| if is_blank(line) { "\n" } else { line }).collect()
}

/// The first character that is not allowed in a table, and its offset.
fn control_character(text: &str) -> Option<(usize, char)> {
    let is_invalid = |character: char| character.is_control() && !character.is_whitespace();
    // Blocks of printable ASCII and white space are skipped at once, which is faster for long texts.
    const BLOCK: usize = 64;
    let is_ordinary = |byte: &u8| matches!(byte, b'\t'..=b'\r' | b' '..=b'~');
    let are_ordinary = |block: &&[u8]| block.iter().fold(true, |ordinary, byte| ordinary & is_ordinary(byte));
    let ordinary = BLOCK * text.as_bytes().chunks_exact(BLOCK).take_while(are_ordinary).count();
    let (offset, character) =
        text[ordinary..].char_indices().find(|(_, character)| is_invalid(*character))?;
    Some((ordinary + offset, character))
}

/// Whether a line is a comment: its first character is `#`, as in the `csv` crate. A `#` after a blank begins a
/// cell, such as `#N/A`.
pub fn is_comment(line: impl AsRef<[u8]>) -> bool {
    line.as_ref().first() == Some(&COMMENT)
}

/// The first line that is neither blank nor a comment.
pub(in crate::logs) fn header_line(text: &str) -> &str {
    text.lines().find(|line| !line.trim().is_empty() && !is_comment(line)).unwrap_or_default()
}

/// Key and value of each comment line `# key: value`.
fn comments(lines: &str) -> impl Iterator<Item = (String, String)> {
    let pairs = lines.lines().filter(|line| is_comment(line)).filter_map(|line| line[1..].split_once(':'));
    pairs.map(|(key, value)| (key.trim().to_lowercase(), value.trim().to_owned()))
}

/// The text of a table by lines and by rows, to guess the layout of the table.
pub struct RowsAsText<'a> {
    text: String,
    path: &'a Path,
    is_workbook: bool,
}

/// The first rows of a table: names of the columns, lines of units, and rows of values.
pub type Cells = (Vec<String>, Vec<Vec<String>>, Vec<Vec<String>>);

impl<'a> RowsAsText<'a> {
    /// Decodes a file, or the sheet with this name if the file is a workbook.
    ///
    /// # Errors
    /// [`LogError::NotText`].
    pub fn new(bytes: &'a [u8], path: &'a Path, sheet: Option<&str>) -> Result<Self, LogError> {
        let text = Text::new(LogSource::in_memory(bytes, path), sheet)?.whole()?;
        Ok(Self { text, path, is_workbook: is_workbook(bytes) })
    }

    /// Names of the sheets with cells, if a workbook has several of them, so that the user must select one. Empty otherwise.
    pub fn sheets(bytes: &[u8]) -> Vec<String> {
        let sheets = if is_workbook(bytes) { sheets(bytes).unwrap_or_default() } else { Vec::new() };
        if sheets.len() > 1 { sheets.into_iter().map(|(name, _)| name).collect() } else { Vec::new() }
    }

    /// The lines of the file.
    pub fn lines(&self) -> impl Iterator<Item = &str> {
        self.text.lines()
    }

    /// Whether the file is a workbook, whose cells need no delimiter.
    pub fn is_workbook(&self) -> bool {
        self.is_workbook
    }

    /// Reads up to `rows_max` rows of values with a layout.
    ///
    /// # Errors
    /// [`LogError`] if the rows do not have this layout.
    pub fn rows(&self, layout: &CsvLayout, rows_max: usize) -> Result<Cells, LogError> {
        let source = LogSource::in_memory(self.text.as_bytes(), self.path);
        let mut table = CsvTable::open(source, &CsvLayout { unit_lines: 0, sheet: None, ..layout.clone() })?;
        let header = table.header().to_vec();
        let mut rows = Vec::new();
        while rows.len() < rows_max + layout.unit_lines
            && let Some(row) = table.next_row()?
        {
            rows.push(row.cells().map(str::to_owned).collect());
        }
        let values = rows.split_off(layout.unit_lines.min(rows.len()));
        Ok((header, rows, values))
    }
}
