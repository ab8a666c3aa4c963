//! `ballbard record`: records one run, then exits.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use shared::config::HomingConfig;
use shared::output::say;
use shared::recording::SystemDisk;
use shared::recording::schema::SIMULATED_BUS;

use super::client::text::{ensure_usable, last_run};
use super::configuration::{ConfigurationFiles, StateDirectory};
use super::fault::FaultParser;
use super::{Format, bus_choice, on_signal};
use crate::clock::Clock;
use crate::control::recordings::runs;
use crate::control::status::LastRun;
use crate::run::{self, About, BusChoice, RunDetails, RunRequest, Setup, Stop, Storage};
use crate::scheduler::Threads;
use crate::segment::faults::FaultWindow;

#[derive(Debug, Args)]
pub struct RecordArguments {
    /// Name of the run and of its file; characters other than letters, digits and `-_.+` become `-`. Default: date and time
    #[arg(long, help_heading = "Recording")]
    name: Option<String>,
    /// Duration of the run, such as 90 (seconds), 90s or 2m; default: until Ctrl-C, or to the end of a replay
    #[arg(long, help_heading = "Recording", value_parser = shared::time::parse_duration)]
    duration: Option<Duration>,
    /// Network interface to which the coupler is connected, such as eth1; `simulated` records generated data without hardware
    #[arg(long, help_heading = "Connection", value_name = "INTERFACE")]
    bus: Option<String>,
    /// Recording whose motion the encoders of the simulated bus repeat
    #[arg(long, help_heading = "Simulation", value_name = "FILE")]
    replay: Option<PathBuf>,
    /// If the bus does not come up, print the problem and retry until it does
    #[arg(long, help_heading = "Connection")]
    wait: bool,
    /// Inject a fault into the simulated bus, such as lost:0.01 or gone:3@10s-15s (repeatable; `list` prints all
    /// faults)
    #[arg(long = "fault", help_heading = "Simulation", value_name = "FAULT[@FROM[-UNTIL]]",
        value_parser = FaultParser)]
    faults: Vec<FaultWindow>,
    /// Run on virtual time, as fast as the machine allows (simulated bus only)
    #[arg(long, help_heading = "Simulation")]
    fast: bool,
    #[command(flatten)]
    about: About,
    /// Directory for the recording; default: `directory` of daemon.toml
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    state: StateDirectory,
    #[command(flatten)]
    format: Format,
    #[command(flatten)]
    configuration: ConfigurationFiles,
}

pub fn run(arguments: &RecordArguments) -> anyhow::Result<()> {
    let (mut daemon, bar) = (arguments.configuration.daemon()?, arguments.configuration.ball_bar()?);
    let homing = arguments.configuration.marks_file(&arguments.state, &daemon).read(&SystemDisk)?;
    if let Some(directory) = &arguments.out {
        daemon.directory.clone_from(directory);
    }
    let request = request(arguments, homing)?;
    let name = request.run.name.clone();
    let stop = Stop::default();
    let scheduler = Threads::on(Clock::Real);
    let work = async {
        let storage = Storage::new(&daemon, &*scheduler)?;
        Ok(run::record(&Setup { scheduler, storage, daemon, bar }, &request, &stop).await?)
    };
    let summary = on_signal(work, |signal| stop.stop(&format!("stopped by {signal}")))?;
    let mut last = LastRun::from_summary(name, summary);
    let file = last.file.clone().map(PathBuf::from);
    last.verdict = file.and_then(|file| runs::finished(&SystemDisk, last.name.clone(), file).verdict);
    if !arguments.format.prints(&last)? {
        // A replayed run has its log of the robot already.
        last.next = last.next.filter(|_| arguments.replay.is_none());
        say(last_run(&last))?;
        last.timing.iter().try_for_each(say)?;
    }
    ensure_usable(&last.name, last.verdict.as_ref())
}

fn request(arguments: &RecordArguments, homing: Option<HomingConfig>) -> anyhow::Result<RunRequest> {
    let bus = match (&arguments.replay, arguments.bus.as_deref()) {
        (Some(file), None | Some(SIMULATED_BUS)) => BusChoice::Replay(file.clone()),
        (Some(_), Some(interface)) => {
            anyhow::bail!("--replay needs the simulated bus, not {interface}; omit one of the two")
        }
        (None, name) => bus_choice(name)?,
    };
    let name = arguments.name.as_deref().map_or_else(|| Ok(run::name_by_time()), run::typed_name);
    let name = name.map_err(anyhow::Error::msg)?;
    let homing = homing.filter(|_| !matches!(bus, BusChoice::Replay(_)));
    let run = RunDetails { name, about: arguments.about.clone(), duration: arguments.duration, homing };
    let RecordArguments { faults, wait, fast, .. } = arguments;
    Ok(RunRequest { run, bus, faults: faults.clone(), wait: *wait, fast: *fast })
}
