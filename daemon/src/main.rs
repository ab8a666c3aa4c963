//! `ballbard`: parses the command line, runs the command, and converts errors to exit codes.

use std::process::ExitCode;

use ballbard::commands::{self, Arguments, UsageError};
use ballbard::log::Log;
use clap::Parser;
use shared::output::explained;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let Ok(log) = Log::start() else { return ExitCode::FAILURE };
    match commands::run(arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log.line(&format!("error: {}", explained(error.as_ref())));
            if error.is::<UsageError>() { UsageError::EXIT_CODE.into() } else { ExitCode::FAILURE }
        }
    }
}
