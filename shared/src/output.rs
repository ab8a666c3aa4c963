//! Prints to standard output, for both programs. The output of a thread can also be captured
//! instead of printed, see [`captured`].

use std::cell::RefCell;
use std::error::Error;
use std::fmt::{self, Write as _};
use std::io::{self, Write as _};

thread_local! {
    /// Captured output of this thread. `None` if output is printed and not captured.
    static CAPTURED: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Runs `work` and captures what it prints in this thread. Returns its result and the captured text; nothing is printed.
pub fn captured<T>(work: impl FnOnce() -> T) -> (T, String) {
    let before = CAPTURED.replace(Some(String::new()));
    let result = work();
    (result, CAPTURED.replace(before).unwrap_or_default())
}

/// Prints a line.
///
/// # Errors
/// If the output cannot be written, for example because the disk is full. A closed pipe is not an error, see [`unless_gone`].
pub fn say(line: impl fmt::Display) -> io::Result<()> {
    show(format_args!("{line}\n"))
}

/// Prints a text that contains its own line breaks.
///
/// # Errors
/// See [`say`].
pub fn show(text: impl fmt::Display) -> io::Result<()> {
    let written = CAPTURED.with_borrow_mut(|output| output.as_mut().map(|output| write!(output, "{text}")));
    if written.is_some() {
        return Ok(());
    }
    unless_gone(write!(io::stdout().lock(), "{text}"))
}

/// Ignores the error of a closed pipe. The pipe closes when the program that reads the output ends first, such as `head`.
///
/// # Errors
/// Any other error, with a text that names standard output.
pub fn unless_gone(written: io::Result<()>) -> io::Result<()> {
    written.or_else(|error| match error.kind() {
        io::ErrorKind::BrokenPipe => Ok(()),
        kind => Err(io::Error::new(kind, format!("cannot write to standard output: {error}"))),
    })
}

/// The first `most` names, separated by commas, followed by the number of the remaining names.
pub fn named(things: &[impl fmt::Display], most: usize) -> String {
    let shown = things.iter().take(most).map(ToString::to_string).collect::<Vec<_>>().join(", ");
    match things.len().checked_sub(most) {
        Some(more) if more > 0 => format!("{shown} and {more} more"),
        _ => shown,
    }
}

/// The text of an error, followed by the texts of its causes. A cause is omitted if the text already contains it. This is
/// the case for most of our errors.
pub fn explained(error: &(dyn Error + 'static)) -> String {
    let (mut text, mut next) = (error.to_string(), error.source());
    while let Some(error) = next {
        let cause = error.to_string();
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
        next = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::WriteError;

    #[derive(Debug, thiserror::Error)]
    #[error("the run failed")]
    struct Silent(#[source] WriteError);

    #[test]
    fn each_cause_of_an_error_is_named_once() {
        let refused =
            || WriteError::Io { path: "runs".into(), source: io::Error::other("Permission denied") };
        let named = refused().to_string();
        assert_eq!(explained(&refused()), named);
        assert_eq!(named.matches("Permission denied").count(), 1);
        assert_eq!(explained(&Silent(refused())), format!("the run failed: {named}"));
    }
}
