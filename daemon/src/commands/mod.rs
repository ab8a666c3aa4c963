//! What a person types.

mod export;
mod record;
mod segment;

use anyhow::Context;
use clap::{Parser, Subcommand};
use tokio::signal::unix::{SignalKind, signal};

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
    /// Serve a simulated EK1100 with EL5021 terminals on a network interface.
    Segment(segment::SegmentArguments),
}

/// Does what was typed; an error's text is meant for a person.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Record(arguments) => record::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Segment(arguments) => segment::run(&arguments),
    }
}

/// Runs blocking work; Ctrl-C and SIGTERM call `stop` with their name, and the work is waited for.
fn on_signal<T: Send + 'static>(
    work: impl FnOnce() -> anyhow::Result<T> + Send + 'static,
    stop: impl Fn(&str),
) -> anyhow::Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the signal handling")?;
    runtime.block_on(async {
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut terminate = signal(SignalKind::terminate())?;
        let mut work = tokio::task::spawn_blocking(work);
        loop {
            tokio::select! {
                result = &mut work => return result?,
                _ = interrupt.recv() => stop("Ctrl-C"),
                _ = terminate.recv() => stop("SIGTERM"),
            }
        }
    })
}
