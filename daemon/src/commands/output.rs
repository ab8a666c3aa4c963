//! Standard output of the commands.

use std::fmt;
use std::io::{self, Write};

use anyhow::Context;

/// Prints a line. A reader who has gone (`| head`) wants no more, and that is no error; a full disk is one.
pub(super) fn say(line: impl fmt::Display) -> anyhow::Result<()> {
    unless_gone(writeln!(io::stdout().lock(), "{line}")).context("cannot write to standard output")
}

/// An output whose reader has gone has taken all that is wanted of it.
pub(super) fn unless_gone(written: io::Result<()>) -> io::Result<()> {
    written.or_else(|error| if error.kind() == io::ErrorKind::BrokenPipe { Ok(()) } else { Err(error) })
}
