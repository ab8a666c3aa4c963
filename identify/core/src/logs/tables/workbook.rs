//! Converts Excel workbooks to text. The rows of a sheet become lines with tabs between the cells, which
//! [`Text`](super::text::Text) reads like any other table.

use std::collections::BTreeMap;
use std::io::Cursor;

use calamine::{Data, Reader, SheetType, Xlsx};
use zip::ZipArchive;

/// First bytes of an Excel workbook, which is a ZIP archive. No text begins with these bytes.
const ZIP: &[u8] = b"PK\x03\x04";

/// Cells by row and column, from 0.
pub(super) type SheetRows = BTreeMap<u32, BTreeMap<u32, String>>;

/// A sheet's name and cells.
pub(super) type Sheet = (String, SheetRows);

/// Whether the bytes are a workbook.
pub(in crate::logs) fn is_workbook(bytes: &[u8]) -> bool {
    bytes.starts_with(ZIP)
}

/// The rows of a sheet as lines: line n is row n of the sheet, and a row without cells is a blank line. `wanted` is the name
/// of the sheet. Without a name, the workbook must have exactly one sheet with cells.
pub(super) fn text_of_sheet(bytes: &[u8], wanted: Option<&str>) -> Result<String, String> {
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

/// The sheets of a workbook that contain at least one cell.
pub(super) fn sheets(bytes: &[u8]) -> Result<Vec<Sheet>, String> {
    // The parser does not verify the data that it unpacks, so the checksums of the archive are checked first.
    check_archive(bytes).map_err(|error| format!("a damaged workbook: {error}"))?;
    let unreadable = |error: calamine::XlsxError| format!("a workbook that cannot be read: {error}");
    let mut workbook = Xlsx::new(Cursor::new(bytes)).map_err(unreadable)?;
    // Sheets of charts and macros have no cells.
    let tables = workbook.sheets_metadata().iter().filter(|sheet| sheet.typ == SheetType::WorkSheet);
    let names: Vec<String> = tables.map(|sheet| sheet.name.clone()).collect();
    let all = names.into_iter().map(|name| rows(&mut workbook, &name).map(|rows| (name, rows)));
    let mut all: Vec<Sheet> = all.collect::<Result<_, _>>().map_err(unreadable)?;
    all.retain(|(_, rows)| !rows.is_empty());
    Ok(all)
}

/// Checks the checksums of all files in an archive.
fn check_archive(bytes: &[u8]) -> Result<(), zip::result::ZipError> {
    let mut archive = ZipArchive::new(Cursor::new(bytes))?;
    for index in 0..archive.len() {
        std::io::copy(&mut archive.by_index(index)?, &mut std::io::sink())?;
    }
    Ok(())
}

fn rows(workbook: &mut Xlsx<Cursor<&[u8]>>, sheet: &str) -> Result<SheetRows, calamine::XlsxError> {
    let mut rows = SheetRows::new();
    let mut cells = workbook.worksheet_cells_reader(sheet)?;
    while let Some(cell) = cells.next_cell()? {
        let (row, column) = cell.get_position();
        let value = Data::from(cell.get_value().clone());
        if value != Data::Empty {
            rows.entry(row).or_default().insert(column, cell_text(&value));
        }
    }
    Ok(rows)
}

fn lines(rows: &SheetRows) -> Result<String, String> {
    /// Largest number of columns; no table of joints is wider.
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

/// The text of a cell, as in a text table. Numbers have all their digits, dates are text, and control characters become
/// spaces. Cells with quotes are quoted as in a CSV file.
fn cell_text(cell: &Data) -> String {
    let text = match cell {
        Data::DateTime(date) => {
            date.as_datetime().map_or_else(|| cell.to_string(), |date| date.format("%FT%T%.f").to_string())
        }
        // Errors such as `#N/A` begin with a blank, because a row that begins with `#` is a comment.
        Data::Error(error) => format!(" {error}"),
        _ => cell.to_string().replace(char::is_control, " "),
    };
    if text.contains('"') { format!("\"{}\"", text.replace('"', "\"\"")) } else { text }
}

#[cfg(test)]
mod tests {
    use calamine::CellErrorType;

    use super::*;
    use crate::logs::tables::text::is_comment;

    #[test]
    fn a_row_that_begins_with_an_error_is_no_comment() {
        let error = cell_text(&Data::Error(CellErrorType::NA));
        let row = BTreeMap::from([(0, error), (1, "0.5".to_owned())]);
        let text = lines(&SheetRows::from([(0, row)])).unwrap_or_default();
        assert_eq!(text, " #N/A\t0.5\n");
        assert!(!is_comment(&text));
    }
}
