//! The command line.

mod client;
mod configuration;
mod fault;
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

const AFTER_HELP: &str = "Example: ballbard run --bus eth1\n\n\
    Exit codes:\n  \
    0  success\n  \
    1  failure, or: check finds a problem that prevents a run; tune finds a problem;\n     \
       a smoke test does not pass; a run is rated BAD or has no valid cycle\n  \
    2  usage error: an unknown option, an invalid value, or no --bus";
/// Largest number of interfaces that a message lists.
const INTERFACES_MAX: usize = 8;

/// Records a sensed double ball-bar over EtherCAT.
#[derive(Debug, Parser)]
#[command(name = "ballbard", version = version(), after_help = AFTER_HELP)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Keep the bus in operation and record on request.
    #[command(after_help = "Example: ballbard run --bus eth1")]
    Run(serve::RunArguments),
    /// Begin a run in the running service.
    #[command(after_help = "Example: ballbard start --name monday-1 --duration 2m")]
    Start(requests::StartArguments),
    /// End the current run; returns when its file is finished.
    #[command(after_help = "Example: ballbard stop")]
    Stop(ServiceArguments),
    /// Print the state of the service.
    #[command(after_help = "Example: ballbard status --timing")]
    Status(requests::StatusArguments),
    /// Add a marker to the current run.
    #[command(after_help = "Example: ballbard mark collision")]
    Mark(requests::MarkArguments),
    /// Change the note of a finished run; the recording itself is unchanged.
    #[command(after_help = "Example: ballbard note monday-1 \"payload 10 kg\"")]
    Note(requests::NoteArguments),
    /// Run pre-flight checks.
    #[command(after_help = "Example: ballbard check")]
    Check(ServiceArguments),
    /// List recordings with their grades.
    #[command(after_help = "Example: ballbard runs --json")]
    Runs(requests::RunsArguments),
    /// Move a recording into the bin.
    #[command(after_help = "Example: ballbard delete monday-1")]
    Delete(requests::NameArguments),
    /// Move a recording out of the bin.
    #[command(after_help = "Example: ballbard restore monday-1")]
    Restore(requests::NameArguments),
    /// List the recordings in the bin, or remove all of them.
    #[command(after_help = "Example: ballbard bin --empty")]
    Bin(requests::BinArguments),
    /// Show a QR code that opens the service's page on a phone without typing the token.
    #[command(after_help = "Example: ballbard pair")]
    Pair(ServiceArguments),
    /// Record one run and exit.
    #[command(after_help = "Example: ballbard record --bus eth1 --name monday-1 --duration 2m")]
    Record(record::RecordArguments),
    /// Find the reference mark of each encoder, and check the order and direction of the encoders, joint by joint.
    #[command(after_help = "Example: ballbard home")]
    Home(home::HomeArguments),
    /// Check a bus before its first use, and write a report.
    #[command(after_help = "Example: ballbard smoke --bus eth1 --report smoke.json")]
    Smoke(smoke::SmokeArguments),
    /// Check this machine's real-time settings and print the commands that fix them.
    #[command(after_help = "Example: ballbard tune --interface eth1")]
    Tune(tune::TuneArguments),
    /// Write a recording as a table.
    #[command(after_help = "Example: ballbard export monday-1 --out monday-1.csv")]
    Export(export::ExportArguments),
    /// Repair a truncated or damaged recording.
    #[command(after_help = "Example: ballbard recover runs/monday-1.mcap.active")]
    Recover(recover::RecoverArguments),
    /// Write shell completions or man pages.
    #[command(
        after_help = "Example: ballbard generate completions bash",
        mut_subcommands(generate::with_example("ballbard"))
    )]
    Generate(GenerateArguments),
    /// Serve a simulated EK1100 with EL5021 terminals on a network interface.
    #[command(after_help = "Example: ballbard segment --interface veth1 --fault gone:3@10s-15s")]
    Segment(segment::SegmentArguments),
}

/// Executes a command. Errors are texts for people.
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

/// Output format of a command: text or JSON.
#[derive(Debug, Clone, Copy, Args)]
struct Format {
    /// Print the result as JSON
    #[arg(long, help_heading = "Output")]
    json: bool,
}

impl Format {
    /// Prints the result as JSON if that is requested. Returns whether it was printed.
    fn prints(self, outcome: &impl Serialize) -> anyhow::Result<bool> {
        if self.json {
            say(serde_json::to_string_pretty(outcome)?)?;
        }
        Ok(self.json)
    }

    /// Prints the result as JSON if that is requested, otherwise the text.
    fn answer(self, outcome: &impl Serialize, text: impl Display) -> anyhow::Result<()> {
        if !self.prints(outcome)? {
            say(text)?;
        }
        Ok(())
    }
}

/// An invalid command line.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(String);

impl UsageError {
    /// Exit code of clap for usage errors. The systemd unit of the Debian package does not restart a
    /// service that ends with this code.
    pub const EXIT_CODE: u8 = 2;
}

/// Parses the bus from the command line. There is no default, because simulated data must not be mistaken for measured data.
fn bus_choice(name: Option<&str>) -> Result<BusChoice, UsageError> {
    match name {
        Some(SIMULATED_BUS) => Ok(BusChoice::Simulated),
        Some(interface) => Ok(BusChoice::Interface(interface.to_owned())),
        None => {
            // The variable is set if the program runs in the systemd unit of the Debian package.
            let remedy = if std::env::var_os("STATE_DIRECTORY").is_some() {
                " to BALLBARD_OPTIONS in /etc/default/ballbard"
            } else {
                ", or --bus simulated for generated data"
            };
            let interfaces = named(&interfaces(), INTERFACES_MAX);
            Err(UsageError(format!(
                "no bus is given; add --bus INTERFACE{remedy}\nnetwork interfaces of this machine: {interfaces}"
            )))
        }
    }
}

/// Runs `work` to its end. Each terminating signal calls `stop` with the name of the signal, and `work`
/// then continues until it ends.
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
