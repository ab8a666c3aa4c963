//! What the readers of tables share: comments, header, cells.

use std::path::{Path, PathBuf};

use crate::logs::{Cell, CsvLayout, LogError};

/// How the numbers of a file are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::logs) struct Format {
    pub delimiter: u8,
    pub decimal_comma: bool,
}

/// A header and its rows, read on demand.
pub(in crate::logs) struct Table<'a> {
    path: PathBuf,
    lines: LineCounter<'a>,
    header: Vec<String>,
    decimal_comma: bool,
    rows: csv::Reader<&'a [u8]>,
}

/// One row and its line in the file.
#[derive(Default)]
pub(in crate::logs) struct Row {
    pub line: u64,
    cells: csv::StringRecord,
}

impl Row {
    /// The cells in their order.
    pub fn cells(&self) -> impl Iterator<Item = &str> {
        self.cells.iter().map(str::trim)
    }
}

/// A column that the header names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::logs) struct Column {
    pub index: usize,
    pub name: String,
}

/// The comment lines `# key: value` of a text, keys in lower case.
pub(in crate::logs) fn comments(text: &str) -> impl Iterator<Item = (String, &str)> {
    let comment = |(at, _): (usize, &str)| {
        let begin = text[..at].rfind('\n').map_or(0, |end| end + 1);
        let is_first = text[begin..at].trim().is_empty();
        is_first.then(|| text[at + 1..].lines().next().unwrap_or_default())
    };
    text.match_indices('#')
        .filter_map(comment)
        .filter_map(|comment| comment.split_once(':'))
        .map(|(key, value)| (key.trim().to_lowercase(), value.trim()))
}

/// The delimiter that the header row uses: whichever of comma, semicolon and tab it has most of.
pub(in crate::logs) fn delimiter_of_header(text: &str) -> u8 {
    let header = header_line(text);
    let count = |delimiter: u8| header.bytes().filter(|&byte| byte == delimiter).count();
    [b';', b'\t'].into_iter().filter(|&d| count(d) > count(b',')).max_by_key(|&d| count(d)).unwrap_or(b',')
}

/// The table of a text in the layout that a mapping gives, its first row of numbers next.
pub(in crate::logs) fn open_mapped<'a>(
    text: &'a str,
    path: &Path,
    layout: &CsvLayout,
) -> Result<Table<'a>, LogError> {
    let from = text.split_inclusive('\n').take(layout.skip_lines).map(str::len).sum::<usize>();
    let body = text.get(from..).unwrap_or_default();
    let delimiter = match (layout.delimiter, delimiter_of_header(body)) {
        // A workbook has no delimiter of its own.
        (Some(delimiter), b'\t') if !header_line(body).contains(delimiter) => b'\t',
        (Some(delimiter), _) => delimiter as u8,
        // Those commas are in numbers.
        (None, b',') if layout.decimal_comma => {
            if header_line(body).contains('\t') {
                b'\t'
            } else {
                b';'
            }
        }
        (None, found) => found,
    };
    let format = Format { delimiter, decimal_comma: layout.decimal_comma };
    let mut table = Table::open_behind(text, from, path, format, layout.header)?;
    for _ in 0..layout.unit_lines {
        // Whatever stands there is not numbers.
        let _ = table.next_row(&mut Row::default());
    }
    Ok(table)
}

/// The first line that is neither blank nor a comment.
pub(in crate::logs) fn header_line(text: &str) -> &str {
    text.lines()
        .find(|line| !line.trim().is_empty() && !line.trim_start().starts_with('#'))
        .unwrap_or_default()
}

impl<'a> Table<'a> {
    /// Reads the header of `text`.
    pub fn open(text: &'a str, path: &Path, format: Format) -> Result<Self, LogError> {
        Self::open_behind(text, 0, path, format, true)
    }

    /// [`Self::open`] where the table begins `from` bytes into the text. Without header the columns are called `1`, `2`
    /// and so on.
    fn open_behind(
        whole: &'a str,
        from: usize,
        path: &Path,
        format: Format,
        has_header: bool,
    ) -> Result<Self, LogError> {
        let (before, text) = whole.split_at_checked(from).unwrap_or((whole, ""));
        let first_line = 1 + before.bytes().filter(|&byte| byte == b'\n').count() as u64;
        let mut reader = csv::ReaderBuilder::new()
            .delimiter(format.delimiter)
            .has_headers(has_header)
            .comment(Some(b'#'))
            // Cells are trimmed where they are looked at: the reader would copy each row for it.
            .trim(csv::Trim::Headers)
            .from_reader(text.as_bytes());
        let first = reader
            .headers()
            .map_err(|error| malformed(&error, path, &mut LineCounter { text, byte: 0, line: first_line }))?;
        let name =
            |(number, cell): (usize, &str)| if has_header { cell.to_owned() } else { number.to_string() };
        let header: Vec<String> = (1..).zip(first).map(name).collect();
        if header.iter().all(String::is_empty) {
            return Err(LogError::NoHeader { path: path.to_owned() });
        }
        let lines = LineCounter { text, byte: 0, line: first_line };
        Ok(Self { path: path.to_owned(), lines, header, decimal_comma: format.decimal_comma, rows: reader })
    }

    /// The column named `name`, which must be there once.
    pub fn column(&self, name: &str, remedy: &str) -> Result<Column, LogError> {
        let mut matching = self.header.iter().enumerate().filter(|(_, header)| *header == name);
        let Some((index, _)) = matching.next() else {
            return Err(LogError::MissingColumn {
                path: self.path.clone(),
                column: name.to_owned(),
                found: self.header.join(", "),
                remedy: remedy.to_owned(),
            });
        };
        if matching.next().is_some() {
            return Err(LogError::RepeatedColumn { path: self.path.clone(), column: name.to_owned() });
        }
        Ok(Column { index, name: name.to_owned() })
    }

    /// Names of all columns, in their order.
    pub fn header(&self) -> &[String] {
        &self.header
    }

    /// Whether the header has a column of this name.
    pub fn has(&self, name: &str) -> bool {
        self.header.iter().any(|header| header == name)
    }

    /// Puts the next row into `row`, if there is one.
    pub fn next_row(&mut self, row: &mut Row) -> Result<bool, LogError> {
        let is_there = self.rows.read_record(&mut row.cells);
        let is_there = is_there.map_err(|error| malformed(&error, &self.path, &mut self.lines))?;
        if is_there {
            row.line = self.lines.line_of(row.cells.position());
        }
        Ok(is_there)
    }

    /// The text of one cell.
    pub fn text<'r>(&self, row: &'r Row, column: &Column) -> &'r str {
        row.cells.get(column.index).unwrap_or_default().trim()
    }

    /// A finite number from one cell.
    pub fn number(&self, row: &Row, column: &Column) -> Result<f64, LogError> {
        let text = self.text(row, column);
        if text.is_empty() {
            return Err(self.bad(row, column, "the cell is empty".into(), "remove the row or fill it in"));
        }
        let parsed = if self.decimal_comma { text.replace(',', ".").parse() } else { text.parse::<f64>() };
        match parsed {
            Ok(value) if value.is_finite() => Ok(value),
            Ok(_) => Err(self.bad(
                row,
                column,
                format!("`{text}` is not a finite number"),
                "remove the row; the controller had no value there",
            )),
            Err(_) if text.contains(',') => Err(self.bad(
                row,
                column,
                format!("`{text}` has a decimal comma"),
                "export with decimal points",
            )),
            Err(_) => {
                Err(self.bad(row, column, format!("`{text}` is not a number"), "correct or remove the row"))
            }
        }
    }

    /// An error about one cell.
    pub fn bad(&self, row: &Row, column: &Column, problem: String, remedy: &'static str) -> LogError {
        let cell = Cell { path: self.path.clone(), line: row.line, column: column.name.clone() };
        LogError::BadValue { cell, problem, remedy }
    }
}

/// Lines of records, in the order in which they are read. The positions of the `csv` crate lie before the comments,
/// blank lines and line ends that precede a record, so its own line numbers are too small there.
struct LineCounter<'a> {
    text: &'a str,
    byte: usize,
    line: u64,
}

impl LineCounter<'_> {
    fn line_of(&mut self, position: Option<&csv::Position>) -> u64 {
        let target = position.map_or(self.byte, |position| position.byte() as usize).max(self.byte);
        self.advance_to(target);
        while let Some(length) = self.length_of_skipped_line() {
            self.advance_to(self.byte + length);
        }
        self.line
    }

    fn advance_to(&mut self, byte: usize) {
        let passed = self.text.as_bytes().get(self.byte..byte).unwrap_or_default();
        self.line += passed.iter().filter(|&&byte| byte == b'\n').count() as u64;
        self.byte = byte;
    }

    /// Length of the comment or blank line at the cursor, with its line end.
    fn length_of_skipped_line(&self) -> Option<usize> {
        let rest = self.text.as_bytes().get(self.byte..)?;
        if !matches!(rest.first()?, b'#' | b'\r' | b'\n') {
            return None;
        }
        let end = rest.iter().position(|&byte| byte == b'\n').map_or(rest.len(), |end| end + 1);
        let line = rest.get(..end)?;
        let skipped = line.first() == Some(&b'#') || line.iter().all(|byte| matches!(byte, b'\r' | b'\n'));
        skipped.then_some(end)
    }
}

fn malformed(error: &csv::Error, path: &Path, lines: &mut LineCounter<'_>) -> LogError {
    let problem = match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("{len} cells where the header has {expected_len}")
        }
        _ => error.to_string(),
    };
    LogError::Malformed { path: path.to_owned(), line: lines.line_of(error.position()), problem }
}
