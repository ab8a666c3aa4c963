//! What a person types.

mod export;
mod record;

use clap::{Parser, Subcommand};

/// Records a sensed double ball-bar over EtherCAT.
#[derive(Debug, Parser)]
#[command(name = "ballbard", version, about)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Record one run.
    Record(record::RecordArguments),
    /// Write a recording as a table.
    Export(export::ExportArguments),
}

/// Does what was typed; an error's text is meant for a person.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Record(arguments) => record::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
    }
}
