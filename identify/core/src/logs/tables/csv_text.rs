//! Reads header, rows and cells of text tables, row by row. All tables of logs are read by a [`CsvTable`].

use std::path::Path;

use shared::output::named;

use super::text::{COMMENT, Text};
use crate::logs::source::LogSource;
use crate::logs::{CsvLayout, LogError};

/// A table: its header, and a reader for its rows.
pub(in crate::logs) struct CsvTable<'a> {
    header: Vec<String>,
    decimal_comma: bool,
    rows: csv::Reader<Text<'a>>,
    /// Cells of the row that was read last.
    cells: csv::StringRecord,
}

/// One row of a table.
pub(in crate::logs) struct CsvRow<'t> {
    /// Line number in the file.
    pub line: u64,
    path: &'t Path,
    decimal_comma: bool,
    cells: &'t csv::StringRecord,
}

/// A column of a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::logs) struct CsvColumn {
    /// Index of the column, from 0.
    pub index: usize,
    pub name: String,
}

/// The delimiter of a header row: semicolon or tab if the row contains more of this character than commas, otherwise comma.
fn delimiter_of(header: &str) -> u8 {
    let count = |delimiter: u8| header.bytes().filter(|&byte| byte == delimiter).count();
    [b';', b'\t'].into_iter().filter(|&d| count(d) > count(b',')).max_by_key(|&d| count(d)).unwrap_or(b',')
}

impl<'a> CsvTable<'a> {
    /// Opens the table of a file. The next row that is read is the first row of values.
    pub fn open(source: LogSource<'a>, layout: &CsvLayout) -> Result<Self, LogError> {
        let mut text = Text::new(source, layout.sheet.as_deref())?;
        text.skip_lines(layout.skip_lines)?;
        let header = text.header_line()?;
        let delimiter = match (layout.delimiter, delimiter_of(header)) {
            // In a workbook the cells were separated by tabs, so the delimiter of the mapping does not apply.
            (Some(delimiter), b'\t') if !header.contains(delimiter) => b'\t',
            (Some(delimiter), _) => delimiter as u8,
            // Commas are decimal commas, so they do not separate cells.
            (None, b',') if layout.decimal_comma => {
                if header.contains('\t') {
                    b'\t'
                } else {
                    b';'
                }
            }
            (None, found) => found,
        };
        let mut table = Self::delimited(text, delimiter, layout)?;
        for _ in 0..layout.unit_lines {
            match table.read() {
                Ok(None) => break,
                // Lines of units may have another number of cells than the header.
                Ok(Some(_)) | Err(LogError::Malformed { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(table)
    }

    /// Opens the table of a `text` whose next line is the header. If the table has no header, the columns are named
    /// `1`, `2` and so on.
    pub fn delimited(text: Text<'a>, delimiter: u8, layout: &CsvLayout) -> Result<Self, LogError> {
        let &CsvLayout { decimal_comma, header: has_header, .. } = layout;
        let mut rows = csv::ReaderBuilder::new()
            .delimiter(delimiter)
            .has_headers(has_header)
            .comment(Some(COMMENT))
            // Only the header is trimmed here. The other cells are trimmed when they are used, because the `csv`
            // crate would copy each row.
            .trim(csv::Trim::Headers)
            .from_reader(text);
        let first = rows.headers().cloned().map_err(|error| malformed(error, rows.get_mut()))?;
        let name =
            |(number, cell): (usize, &str)| if has_header { cell.to_owned() } else { number.to_string() };
        let header: Vec<String> = (1..).zip(&first).map(name).collect();
        if header.iter().all(String::is_empty) {
            return Err(LogError::NoHeader { path: rows.get_ref().path.to_owned() });
        }
        Ok(Self { header, decimal_comma, rows, cells: csv::StringRecord::new() })
    }

    /// The comment lines `# key: value` that were decoded so far, with keys in lower case. They include all comments before
    /// the last row that was read.
    pub fn comments(&self) -> &[(String, String)] {
        self.rows.get_ref().comments()
    }

    /// Value of the first comment `# key: value` with this key.
    pub fn comment(&self, key: &str) -> Option<&str> {
        self.comments().iter().find(|(known, _)| known == key).map(|(_, value)| &**value)
    }

    /// Path of the file, for errors.
    pub fn path(&self) -> &'a Path {
        self.rows.get_ref().path
    }

    /// The column named `name`, which must occur exactly once.
    pub fn column(&self, name: &str, remedy: &str) -> Result<CsvColumn, LogError> {
        let mut matching = self.header.iter().enumerate().filter(|(_, header)| *header == name);
        let Some((index, _)) = matching.next() else {
            return Err(LogError::MissingColumn {
                path: self.path().to_owned(),
                column: name.to_owned(),
                found: self.names(),
                remedy: self.remedy_of_header().unwrap_or_else(|| remedy.to_owned()),
            });
        };
        if matching.next().is_some() {
            let problem = format!("column `{name}` occurs twice");
            return Err(LogError::content(self.path(), problem, "remove or rename one"));
        }
        Ok(CsvColumn { index, name: name.to_owned() })
    }

    /// The columns with these names, which must be different.
    pub fn columns(&self, names: &[impl AsRef<str>], remedy: &str) -> Result<Vec<CsvColumn>, LogError> {
        let columns = names.iter().map(|name| self.column(name.as_ref(), remedy));
        let columns = columns.collect::<Result<Vec<_>, LogError>>()?;
        LogError::unless_distinct(self.path(), names).map(|()| columns)
    }

    /// Like [`Self::column`]; `None` without a name.
    pub fn if_named(&self, name: Option<&String>, remedy: &str) -> Result<Option<CsvColumn>, LogError> {
        name.map(|name| self.column(name, remedy)).transpose()
    }

    /// The remedy, if the header shows why a column is missing: the header is a row of numbers, or the
    /// cells have another delimiter.
    fn remedy_of_header(&self) -> Option<String> {
        let is_number = |name: &String| name.replace(',', ".").parse::<f64>().is_ok();
        let is_numbered = (1..).zip(&self.header).all(|(number, name)| *name == number.to_string());
        if self.header.iter().all(is_number) && !is_numbered {
            return Some(
                "There are numbers in place of the header: write a line with the names of the columns above them, or \
                 header = false under [csv] of a mapping, where the columns are \"1\", \"2\" ..."
                    .into(),
            );
        }
        let [only] = self.header.as_slice() else { return None };
        let delimiter = char::from(delimiter_of(only));
        only.contains(delimiter).then(|| {
            format!(
                "The cells are separated by another character than the mapping states: write delimiter = \"{}\" under [csv], and \
                 decimal_comma = true if numbers are written 1,5.",
                delimiter.escape_default()
            )
        })
    }

    /// Names of the first columns, for a message. They are shortened, because the first line of a file without a
    /// header may be long.
    pub fn names(&self) -> String {
        const NAMED: usize = 16;
        const LETTERS: usize = 32;
        let shortened = |name: &String| {
            let name: String = name.chars().map(|one| if one.is_control() { '?' } else { one }).collect();
            match name.char_indices().nth(LETTERS) {
                Some((end, _)) => format!("{}..", &name[..end]),
                None => name,
            }
        };
        named(&self.header.iter().map(shortened).collect::<Vec<_>>(), NAMED)
    }

    /// Names of all columns, in their order.
    pub fn header(&self) -> &[String] {
        &self.header
    }

    /// Whether the header has a column of this name.
    pub fn has(&self, name: &str) -> bool {
        self.header.iter().any(|header| header == name)
    }

    /// The next row, if there is one.
    pub fn next_row(&mut self) -> Result<Option<CsvRow<'_>>, LogError> {
        let line = self.read().map_err(|mut error| {
            if let LogError::Malformed { problem, .. } = &mut error
                && matches!(self.rows.read_record(&mut self.cells), Ok(false))
            {
                problem.push_str(", in the last line: if the file was cut off there, remove that line");
            }
            error
        })?;
        let Self { decimal_comma, ref cells, .. } = *self;
        Ok(line.map(|line| CsvRow { line, path: self.path(), decimal_comma, cells }))
    }

    /// Reads the cells of the next row and returns its line, if there is one.
    fn read(&mut self) -> Result<Option<u64>, LogError> {
        let is_there = self.rows.read_record(&mut self.cells);
        let byte = self.cells.position().map_or(0, csv::Position::byte);
        // A cell whose quotation mark is not closed contains the following rows. A measurement has no line breaks.
        let text = self.cells.as_slice().as_bytes();
        if text.contains(&b'\n') || text.contains(&b'\r') {
            let place = format!("line {}", self.rows.get_mut().line_of_record(byte));
            let problem = "a quotation mark is not closed in this line".to_owned();
            let remedy = "close or remove it: a cell must not contain a line break";
            return Err(LogError::bad_record(self.path(), place, problem, remedy));
        }
        let is_there = is_there.map_err(|error| malformed(error, self.rows.get_mut()))?;
        Ok(is_there.then(|| self.rows.get_mut().line_of_record(byte)))
    }
}

impl CsvRow<'_> {
    /// All cells in their order.
    pub fn cells(&self) -> impl Iterator<Item = &str> {
        self.cells.iter().map(str::trim)
    }

    /// The text of one cell.
    pub fn text(&self, column: &CsvColumn) -> &str {
        self.cells.get(column.index).unwrap_or_default().trim()
    }

    /// The finite number in one cell.
    pub fn number(&self, column: &CsvColumn) -> Result<f64, LogError> {
        let text = self.text(column);
        if text.is_empty() {
            return Err(self.bad(column, "the cell is empty".into(), "remove the row or fill it in"));
        }
        let parsed = if self.decimal_comma { text.replace(',', ".").parse() } else { text.parse::<f64>() };
        match parsed {
            Ok(value) if value.is_finite() => Ok(value),
            Ok(_) => Err(self.bad(
                column,
                format!("`{text}` is not a finite number"),
                "remove the row: its value is missing",
            )),
            Err(_) if text.contains(',') && text.contains('.') => Err(self.bad(
                column,
                format!("`{text}` has a comma and a point"),
                "export numbers without separators of thousands",
            )),
            Err(_) if text.contains(',') && !self.decimal_comma => Err(self.bad(
                column,
                format!("`{text}` has a decimal comma"),
                "`decimal_comma = true` in the mapping reads it (--mapping, --log-mapping; `identify inspect --propose` \
                 writes one)",
            )),
            Err(_) => {
                let has_digit = |cell: &str| cell.contains(|letter: char| letter.is_ascii_digit());
                let remedy = if !self.cells().any(has_digit) {
                    "unit_lines = 1 under [csv] of a mapping skips a line of units"
                } else if text.contains(':') {
                    "[time] unit = \"date_time\" of a mapping reads stamps such as 2026-11-22 10:15:00.25"
                } else {
                    "correct or remove the row"
                };
                Err(self.bad(column, format!("`{text}` is not a number"), remedy))
            }
        }
    }

    /// An error about one cell.
    pub fn bad(&self, column: &CsvColumn, problem: String, remedy: &'static str) -> LogError {
        let place = format!("line {} column `{}`", self.line, column.name);
        LogError::bad_record(self.path, place, problem, remedy)
    }
}

fn malformed(error: csv::Error, text: &mut Text<'_>) -> LogError {
    let byte = error.position().map_or(0, csv::Position::byte);
    let message = error.to_string();
    let problem = match error.into_kind() {
        csv::ErrorKind::Io(error) => match error.downcast() {
            Ok(log_error) => return log_error,
            Err(source) => return LogError::Unreadable { path: text.path.to_owned(), source },
        },
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("{len} cells where the header has {expected_len}")
        }
        _ => message,
    };
    LogError::Malformed { path: text.path.to_owned(), line: text.line_of_record(byte), problem }
}
