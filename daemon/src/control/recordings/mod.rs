//! Recordings after their run: lists, grades, notes, tables, and the bin.

pub(crate) mod bin;
pub(crate) mod note;
pub mod runs;
pub mod table;
pub(crate) mod verdict;

use std::io;

use shared::recording::is_absent;

/// Replaces the error "does not exist" of a file or directory by a default value. A missing directory is normal, because
/// directories are created when a run needs them.
fn unless_absent<T: Default>(outcome: io::Result<T>) -> io::Result<T> {
    match outcome {
        Err(error) if is_absent(&error) => Ok(T::default()),
        outcome => outcome,
    }
}
