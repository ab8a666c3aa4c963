//! Encodings, cells and stamps of text tables.

pub(super) mod csv_text;
pub(super) mod stamp;
pub(super) mod text;
pub(super) mod workbook;
