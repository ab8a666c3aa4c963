//! What all readers of text tables share: encodings, cells, stamps.

pub(super) mod csv_text;
pub(super) mod stamp;
pub(super) mod text;
pub(super) mod workbook;
