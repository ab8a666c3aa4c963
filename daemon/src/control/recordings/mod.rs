//! Recordings after their run: lists, grades, notes, tables, and the bin.

pub mod bin;
pub(crate) mod note;
pub mod runs;
pub mod table;
pub mod verdict;
