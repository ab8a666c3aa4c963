//! What people and programs get: files, tables on a terminal, and a page.

pub mod examination;
pub mod file;
pub mod page;
mod read;
pub mod side_by_side;
pub mod table;

pub use read::CalibrationReadError;
