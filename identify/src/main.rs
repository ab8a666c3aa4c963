//! The program `identify`: parses the command line, runs the command, and maps errors to exit codes.

use std::io::{IsTerminal, Write};
use std::process::ExitCode;

use identify::commands::{self, IdentifyArguments};
use identify::report::summary::wrapped;
use shared::output::explained;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt;
use tracing_subscriber::prelude::*;

#[allow(clippy::print_stderr, reason = "the last word of a command-line program")]
fn main() -> ExitCode {
    let arguments = IdentifyArguments::from_words(std::env::args_os()).unwrap_or_else(|error| error.exit());
    let wanted = std::env::var("RUST_LOG").ok().and_then(|text| text.parse::<Targets>().ok());
    let filter = wanted.unwrap_or_else(|| Targets::new().with_default(LevelFilter::INFO));
    let on_terminal = std::io::stderr().is_terminal();
    let lines = fmt::layer().with_target(false).with_ansi(on_terminal).with_writer(std::io::stderr);
    tracing_subscriber::registry().with(lines).with(filter).init();
    match commands::run(arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let message = format!("error: {}", explained(error.as_ref()));
            // Lines are wrapped for a terminal only, because another program may search for whole sentences. The result of
            // the write is ignored: the reader of a pipe (`2>&1 | head`) may have ended.
            let _ = writeln!(std::io::stderr(), "{}", if on_terminal { wrapped(&message) } else { message });
            ExitCode::FAILURE
        }
    }
}
