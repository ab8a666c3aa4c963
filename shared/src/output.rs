//! Standard output of both programs.

use std::fmt;
use std::io::{self, Write};

/// Prints a line.
///
/// # Errors
/// Where the output cannot be written, such as on a full disk; see [`unless_gone`].
pub fn say(line: impl fmt::Display) -> io::Result<()> {
    show(format_args!("{line}\n"))
}

/// Prints text that ends its own lines.
///
/// # Errors
/// As [`say`].
pub fn show(text: impl fmt::Display) -> io::Result<()> {
    unless_gone(write!(io::stdout().lock(), "{text}"))
}

/// An output whose reader has gone (`| head`) has taken all that is wanted of it.
///
/// # Errors
/// Any other, with what it concerns.
pub fn unless_gone(written: io::Result<()>) -> io::Result<()> {
    written.or_else(|error| match error.kind() {
        io::ErrorKind::BrokenPipe => Ok(()),
        kind => Err(io::Error::new(kind, format!("cannot write to standard output: {error}"))),
    })
}
