//! `identify`: parses the command line, runs, maps errors to exit codes.

use std::process::ExitCode;

use clap::Parser;
use identify::commands::{self, Arguments};
use tracing_subscriber::EnvFilter;

#[allow(clippy::print_stderr, reason = "the last word of a command-line program")]
fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_target(false).with_writer(std::io::stderr).init();
    match commands::run(arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
