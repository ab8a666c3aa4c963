//! Reads tables. `text` decodes the bytes of a file, `workbook` converts an Excel sheet to text, `csv_text` splits text into
//! cells, and `stamp` converts cells to time stamps.

pub(super) mod csv_text;
pub(super) mod stamp;
pub(super) mod text;
pub(super) mod workbook;
