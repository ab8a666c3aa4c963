//! Recordings after their run: lists, grades, notes, tables, and the bin.

pub(crate) mod bin;
pub(crate) mod note;
pub mod runs;
pub mod table;
pub(crate) mod verdict;
