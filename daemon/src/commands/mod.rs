//! What a person types.

mod client;
mod export;
mod home;
mod record;
mod recover;
mod segment;
mod serve;
mod signals;
mod tune;

pub use export::write_csv;

use self::signals::Signals;
use crate::run::BusChoice;
use anyhow::Context;
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
    /// Keep the bus in operation and record when asked to.
    Run(serve::RunArguments),
    /// Ask the service to begin a run.
    Start(client::StartArguments),
    /// Ask the service to end the run; returns when its file is finished.
    Stop(client::AskArguments),
    /// What the service is doing.
    Status(client::AskArguments),
    /// Put a marker into the run.
    Mark(client::MarkArguments),
    /// Whether everything is as it should be before a run.
    Check(client::AskArguments),
    /// List recordings.
    Runs(client::RunsArguments),
    /// Record one run and exit.
    Record(record::RecordArguments),
    /// Find the encoders' reference marks and check their order and direction, joint by joint.
    Home(home::HomeArguments),
    /// Say what of this machine's settings makes the cycle late, and what to type.
    Tune(tune::TuneArguments),
    /// Write a recording as a table.
    Export(export::ExportArguments),
    /// Make a finished recording of one that was cut short or damaged.
    Recover(recover::RecoverArguments),
    /// Serve a simulated EK1100 with EL5021 terminals on a network interface.
    Segment(segment::SegmentArguments),
}

/// Does what was typed; an error's text is meant for a person.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Run(arguments) => serve::run(&arguments),
        Command::Start(arguments) => client::start(arguments),
        Command::Stop(arguments) => client::stop(&arguments),
        Command::Status(arguments) => client::status(&arguments),
        Command::Mark(arguments) => client::mark(&arguments),
        Command::Check(arguments) => client::check(&arguments),
        Command::Runs(arguments) => client::list(&arguments),
        Command::Record(arguments) => record::run(&arguments),
        Command::Home(arguments) => home::run(arguments),
        Command::Tune(arguments) => tune::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Recover(arguments) => recover::run(&arguments),
        Command::Segment(arguments) => segment::run(&arguments),
    }
}

/// The bus that a person names.
fn bus_choice(name: &str) -> BusChoice {
    match name {
        "simulated" => BusChoice::Simulated,
        interface => BusChoice::Interface(interface.to_owned()),
    }
}

/// Runs blocking work; each signal that ends programs calls `stop` with its name, and the work is waited for.
fn on_signal<T: Send + 'static>(
    work: impl FnOnce() -> anyhow::Result<T> + Send + 'static,
    stop: impl Fn(&str),
) -> anyhow::Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the signal handling")?;
    runtime.block_on(async {
        let mut signals = Signals::new()?;
        let mut work = tokio::task::spawn_blocking(work);
        loop {
            tokio::select! {
                result = &mut work => return result?,
                name = signals.next() => stop(name),
            }
        }
    })
}
