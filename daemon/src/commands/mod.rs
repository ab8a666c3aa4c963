//! What a person types.

mod client;
mod configuration;
mod home;
mod record;
mod recover;
mod segment;
mod serve;
mod signals;
mod smoke;
mod systemd;
mod tune;

use std::fmt::Display;

use self::client::{ServiceArguments, export, requests};
use self::signals::Signals;
use crate::run::BusChoice;
use crate::segment::interfaces;
use anyhow::Context;
use clap::{Args, CommandFactory, Parser, Subcommand};
use generate::GenerateArguments;
use serde::Serialize;
use shared::output::{named, say};
use shared::recording::schema::SIMULATED_BUS;
use shared::version::version;

const EXIT_CODES: &str = "Exit codes: 0: success; 1: failure, a check that found what stops a run, a tune that found a \
    problem, a smoke test that did not pass, or a run rated BAD; 2: usage error, such as a run without --bus.";
/// Interfaces that a message lists.
const INTERFACES_MAX: usize = 8;

/// Records a sensed double ball-bar over EtherCAT.
#[derive(Debug, Parser)]
#[command(name = "ballbard", version = version(), about, after_help = EXIT_CODES)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Keep the bus in operation and record when asked to.
    Run(serve::RunArguments),
    /// Ask the service to begin a run.
    Start(requests::StartArguments),
    /// Ask the service to end the run; returns when its file is finished.
    Stop(ServiceArguments),
    /// What the service is doing.
    Status(requests::StatusArguments),
    /// Put a marker into the run.
    Mark(requests::MarkArguments),
    /// Change the note of a finished run; the recording itself stays as it is.
    Note(requests::NoteArguments),
    /// Run pre-flight checks.
    Check(ServiceArguments),
    /// List recordings.
    Runs(requests::RunsArguments),
    /// Move a recording into the bin.
    Delete(requests::NameArguments),
    /// Move a recording from the bin to the others.
    Restore(requests::NameArguments),
    /// List the recordings in the bin, or remove all of them.
    Bin(requests::BinArguments),
    /// Show a QR code with which a phone opens the service's page without typing the token.
    Pair(ServiceArguments),
    /// Record one run and exit.
    Record(record::RecordArguments),
    /// Find the encoders' reference marks and check their order and direction, joint by joint.
    Home(home::HomeArguments),
    /// Check a bus before its first use, and write a report to send back.
    Smoke(smoke::SmokeArguments),
    /// Check this machine's real-time settings and print the commands that fix them.
    Tune(tune::TuneArguments),
    /// Write a recording as a table.
    Export(export::ExportArguments),
    /// Make a finished recording of one that was cut short or damaged.
    Recover(recover::RecoverArguments),
    /// Write completions for a shell, or man pages.
    Generate(GenerateArguments),
    /// Serve a simulated EK1100 with EL5021 terminals on a network interface.
    Segment(segment::SegmentArguments),
}

/// Does what was typed; an error's text is meant for a person.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Run(arguments) => serve::run(&arguments),
        Command::Start(arguments) => requests::start(arguments),
        Command::Stop(arguments) => requests::stop(&arguments),
        Command::Status(arguments) => requests::status(&arguments),
        Command::Mark(arguments) => requests::mark(&arguments),
        Command::Note(arguments) => requests::note(arguments),
        Command::Check(arguments) => requests::check(&arguments),
        Command::Runs(arguments) => requests::list(&arguments),
        Command::Delete(arguments) => requests::delete(arguments),
        Command::Restore(arguments) => requests::restore(arguments),
        Command::Bin(arguments) => requests::bin(&arguments),
        Command::Pair(arguments) => requests::pair(&arguments),
        Command::Record(arguments) => record::run(&arguments),
        Command::Home(arguments) => home::run(arguments),
        Command::Smoke(arguments) => smoke::run(arguments),
        Command::Tune(arguments) => tune::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Recover(arguments) => recover::run(&arguments),
        Command::Generate(arguments) => Ok(arguments.run(Arguments::command())?),
        Command::Segment(arguments) => segment::run(&arguments),
    }
}

/// Who reads what comes of a command: a person, or a program.
#[derive(Debug, Clone, Copy, Args)]
struct Format {
    /// Print what comes of it as JSON
    #[arg(long)]
    json: bool,
}

impl Format {
    /// Prints it if a program reads, and says whether it did.
    fn prints(self, outcome: &impl Serialize) -> anyhow::Result<bool> {
        if self.json {
            say(serde_json::to_string_pretty(outcome)?)?;
        }
        Ok(self.json)
    }

    /// Prints it for a program, or its text for a person.
    fn answer(self, outcome: &impl Serialize, text: impl Display) -> anyhow::Result<()> {
        if !self.prints(outcome)? {
            say(text)?;
        }
        Ok(())
    }
}

/// A command that cannot be carried out as it was typed.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(String);

impl UsageError {
    /// As clap ends the program. The Debian package's unit does not restart a service that ends with it.
    pub const EXIT_CODE: u8 = 2;
}

/// The bus that a person names. None is assumed: simulated data must not pass for measured ones.
fn bus_choice(name: Option<&str>) -> Result<BusChoice, UsageError> {
    match name {
        Some(SIMULATED_BUS) => Ok(BusChoice::Simulated),
        Some(interface) => Ok(BusChoice::Interface(interface.to_owned())),
        None => {
            // As the unit of the Debian package starts it.
            let remedy = if std::env::var_os("STATE_DIRECTORY").is_some() {
                " to BALLBARD_OPTIONS in /etc/default/ballbard"
            } else {
                ", or --bus simulated for made-up data"
            };
            let interfaces = named(&interfaces(), INTERFACES_MAX);
            Err(UsageError(format!(
                "no bus is given; add --bus INTERFACE{remedy}\nnetwork interfaces of this machine: {interfaces}"
            )))
        }
    }
}

/// Does work; each signal that ends programs calls `stop` with its name, and the work is waited for.
fn on_signal<T>(work: impl Future<Output = anyhow::Result<T>>, stop: impl Fn(&str)) -> anyhow::Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the signal handling")?;
    runtime.block_on(async {
        let mut signals = Signals::new()?;
        tokio::pin!(work);
        loop {
            tokio::select! {
                result = &mut work => return result,
                name = signals.next() => stop(name),
            }
        }
    })
}
