//! What people and programs get: files, tables on a terminal, and a page.

pub mod examination;
pub mod file;
pub mod page;
pub mod table;
