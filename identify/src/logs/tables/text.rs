//! Bytes of a table as text, however the program that made it saves: UTF-8, UTF-16, Windows-1252 (Latin-1) or a spreadsheet.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use calamine::{Data, Reader, Xlsx};
use encoding_rs::{Encoding, WINDOWS_1252};
use zip::ZipArchive;

use super::csv_text::{Row, open_mapped};
use crate::logs::{CsvLayout, LogError};

/// An Excel workbook is a ZIP archive; no text begins so.
const ZIP: &[u8] = b"PK\x03\x04";

/// Whether the bytes are a workbook, which only looks binary.
pub(in crate::logs) fn is_workbook(bytes: &[u8]) -> bool {
    bytes.starts_with(ZIP)
}

/// The text of a file without byte order mark. Of a workbook the named sheet, or its only one, one line for each row, cells between
/// tabs.
///
/// What is not UTF-8 and has no byte order mark is Windows-1252, as instruments export a micro or degree sign; a damaged
/// digit is no digit in any of them.
///
/// # Errors
/// [`LogError::NotText`] for anything else, such as binary data, a workbook with several sheets of which none is named, or a sheet of
/// what is no workbook.
pub(in crate::logs) fn decode<'a>(
    bytes: &'a [u8],
    path: &Path,
    sheet: Option<&str>,
) -> Result<Cow<'a, str>, LogError> {
    let not_text = |problem: String| LogError::NotText { path: path.to_owned(), problem };
    if is_workbook(bytes) {
        return text_of_sheet(bytes, sheet).map(Cow::Owned).map_err(not_text);
    }
    if let Some(sheet) = sheet {
        return Err(not_text(format!(
            "no workbook, and the mapping names its sheet `{sheet}`: take that out"
        )));
    }
    let (encoding, bytes) = match Encoding::for_bom(bytes) {
        Some((encoding, mark)) => (Some(encoding), bytes.get(mark..).unwrap_or_default()),
        None => (None, bytes),
    };
    let (text, damaged) = match (encoding, std::str::from_utf8(bytes)) {
        (None, Ok(text)) => (Cow::Borrowed(text), false),
        (encoding, _) => encoding.unwrap_or(WINDOWS_1252).decode_without_bom_handling(bytes),
    };
    let control = |character: char| character.is_control() && !character.is_whitespace();
    // Bytes that are none, in any of these encodings, are passed over first: texts are long.
    const BLOCK: usize = 64;
    let is_usual = |byte: &u8| matches!(byte, b'\t'..=b'\r' | b' '..=b'~');
    let are_usual = |block: &&[u8]| block.iter().fold(true, |usual, byte| usual & is_usual(byte));
    let usual = BLOCK * text.as_bytes().chunks_exact(BLOCK).take_while(are_usual).count();
    match text[usual..].char_indices().find(|(_, character)| control(*character)) {
        _ if damaged => Err(not_text("its byte order mark promises another encoding than it has".into())),
        Some((at, character)) => Err(not_text(format!("character {character:?} at offset {}", usual + at))),
        None => Ok(text),
    }
}

/// The rows of a sheet, as lines with the numbers of the rows.
fn text_of_sheet(bytes: &[u8], wanted: Option<&str>) -> Result<String, String> {
    let mut sheets = sheets(bytes)?;
    let list = |sheets: &[Sheet]| sheets.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
    match (wanted, sheets.len()) {
        (_, 0) => Err("a workbook without any cell".into()),
        (None, 1) => lines(&sheets.remove(0).1),
        (None, _) => {
            let names = list(&sheets);
            Err(format!(
                "a workbook with several sheets: {names}; name the one with the table as `sheet` under [csv] of the mapping"
            ))
        }
        (Some(wanted), _) => match sheets.iter().find(|(name, _)| name == wanted) {
            Some((_, rows)) => lines(rows),
            None => Err(format!("a workbook without cells in a sheet `{wanted}`; it has {}", list(&sheets))),
        },
    }
}

/// A sheet's name and cells.
type Sheet = (String, Rows);

/// The sheets of a workbook that have any cell.
fn sheets(bytes: &[u8]) -> Result<Vec<Sheet>, String> {
    // The parser takes what it unpacks as sound: the checksums of the archive are seen to first.
    checked(bytes).map_err(|error| format!("a damaged workbook: {error}"))?;
    let unreadable = |error: calamine::XlsxError| format!("a workbook that cannot be read: {error}");
    let mut workbook = Xlsx::new(Cursor::new(bytes)).map_err(unreadable)?;
    let names = workbook.sheet_names();
    let all = names.into_iter().map(|name| rows(&mut workbook, &name).map(|rows| (name, rows)));
    let mut all: Vec<Sheet> = all.collect::<Result<_, _>>().map_err(unreadable)?;
    all.retain(|(_, rows)| !rows.is_empty());
    Ok(all)
}

/// Everything in an archive unpacks to its checksum.
fn checked(bytes: &[u8]) -> Result<(), zip::result::ZipError> {
    let mut archive = ZipArchive::new(Cursor::new(bytes))?;
    for index in 0..archive.len() {
        std::io::copy(&mut archive.by_index(index)?, &mut std::io::sink())?;
    }
    Ok(())
}

/// Cells by row and column, from 0.
type Rows = BTreeMap<u32, BTreeMap<u32, String>>;

fn rows(workbook: &mut Xlsx<Cursor<&[u8]>>, sheet: &str) -> Result<Rows, calamine::XlsxError> {
    let mut rows = Rows::new();
    let mut cells = workbook.worksheet_cells_reader(sheet)?;
    while let Some(cell) = cells.next_cell()? {
        let (row, column) = cell.get_position();
        let value = Data::from(cell.get_value().clone());
        if value != Data::Empty {
            rows.entry(row).or_default().insert(column, shown(&value));
        }
    }
    Ok(rows)
}

fn lines(rows: &Rows) -> Result<String, String> {
    /// No table of joints is wider.
    const COLUMNS_MAX: u32 = 1000;
    let width = rows.values().filter_map(|row| row.last_key_value()).map(|(column, _)| column + 1).max();
    let width = width.unwrap_or(0);
    if width > COLUMNS_MAX {
        return Err(format!("a workbook with a cell in column {width}"));
    }
    let mut text = String::new();
    let mut next = 0;
    for (&row, cells) in rows {
        text.extend((next..row).map(|_| '\n'));
        let cell = |column: u32| cells.get(&column).map_or("", String::as_str);
        text += &(0..width).map(cell).collect::<Vec<_>>().join("\t");
        text.push('\n');
        next = row + 1;
    }
    Ok(text)
}

/// A cell as a table would have it: numbers with all their digits, dates as text.
fn shown(cell: &Data) -> String {
    match cell {
        Data::DateTime(date) => {
            date.as_datetime().map_or_else(|| cell.to_string(), |date| date.format("%FT%T%.f").to_string())
        }
        _ => cell.to_string().replace(['\t', '\n', '\r'], " "),
    }
}

/// A table's text, line by line and row by row, for who does not know yet what it holds.
pub struct RowsAsText<'a> {
    text: Cow<'a, str>,
    path: &'a Path,
    is_workbook: bool,
}

/// Names of the columns, lines of units, and rows of cells.
pub type Cells = (Vec<String>, Vec<Vec<String>>, Vec<Vec<String>>);

impl<'a> RowsAsText<'a> {
    /// Decodes a file, or a sheet of it.
    ///
    /// # Errors
    /// [`LogError::NotText`].
    pub fn new(bytes: &'a [u8], path: &'a Path, sheet: Option<&str>) -> Result<Self, LogError> {
        Ok(Self { text: decode(bytes, path, sheet)?, path, is_workbook: is_workbook(bytes) })
    }

    /// Names of a workbook's sheets with cells, where it has several: one of them is to be chosen.
    pub fn sheets(bytes: &[u8]) -> Vec<String> {
        let sheets = if is_workbook(bytes) { sheets(bytes).unwrap_or_default() } else { Vec::new() };
        if sheets.len() > 1 { sheets.into_iter().map(|(name, _)| name).collect() } else { Vec::new() }
    }

    /// The lines of the file.
    pub fn lines(&self) -> impl Iterator<Item = &str> {
        self.text.lines()
    }

    /// The file is a workbook, whose cells need no delimiter.
    pub fn is_workbook(&self) -> bool {
        self.is_workbook
    }

    /// The first rows in a layout.
    ///
    /// # Errors
    /// [`LogError`] where the layout does not suit them.
    pub fn rows(&self, layout: &CsvLayout, rows_max: usize) -> Result<Cells, LogError> {
        let mut table = open_mapped(&self.text, self.path, &CsvLayout { unit_lines: 0, ..layout.clone() })?;
        let header = table.header().to_vec();
        let mut rows = Vec::new();
        let mut row = Row::default();
        while rows.len() < rows_max + layout.unit_lines && table.next_row(&mut row)? {
            rows.push(row.cells().map(str::to_owned).collect());
        }
        let values = rows.split_off(layout.unit_lines.min(rows.len()));
        Ok((header, rows, values))
    }
}
