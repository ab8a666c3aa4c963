//! `ballbard smoke`: checks a bus before its first use.

use std::fs;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use shared::config;
use shared::output::{explained, say, show};
use shared::recording::SystemDisk;
use shared::recording::schema::SIMULATED_BUS;

use super::configuration::ConfigurationFiles;
use super::fault::FaultParser;
use super::{Format, UsageError, bus_choice, on_signal};
use crate::clock::Clock;
use crate::run::{RunRequest, Stop};
use crate::scheduler::Threads;
use crate::segment::faults::FaultWindow;
use crate::smoke::{self, Bench, Report, SmokeConfig};
use crate::whole_file;

#[derive(Debug, Args)]
pub struct SmokeArguments {
    /// Network interface to which the coupler is connected, such as eth1; `simulated` tests the simulated bus
    #[arg(long, help_heading = "Connection", value_name = "INTERFACE")]
    bus: Option<String>,
    /// File with the checks, or the name of a file in `config` or /etc/ballbard
    #[arg(long, help_heading = "Input", value_name = "FILE", default_value = "smoke")]
    checks: PathBuf,
    /// Output file of the report; default: smoke-INTERFACE.json in the current directory
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    report: Option<PathBuf>,
    /// Inject a fault into the simulated bus, such as lost:0.01 or noise:3,0.1 (repeatable; `list` prints all faults)
    #[arg(long = "fault", help_heading = "Simulation", value_name = "FAULT[@FROM[-UNTIL]]",
        value_parser = FaultParser)]
    faults: Vec<FaultWindow>,
    /// Run on virtual time, as fast as the machine allows (simulated bus only)
    #[arg(long, help_heading = "Simulation")]
    fast: bool,
    #[command(flatten)]
    format: Format,
    #[command(flatten)]
    configuration: ConfigurationFiles,
}

pub fn run(arguments: SmokeArguments) -> anyhow::Result<()> {
    let SmokeArguments { bus, checks, report: file, faults, fast, format, configuration } = arguments;
    if bus.as_deref() != Some(SIMULATED_BUS) && (fast || !faults.is_empty()) {
        let error = "--fast and --fault need the simulated bus; type --bus simulated, or omit them";
        return Err(UsageError(error.into()).into());
    }
    let request = RunRequest { bus: bus_choice(bus.as_deref())?, faults, fast, ..RunRequest::default() };
    let smoke: SmokeConfig = config::load(&checks)?;
    let (daemon, bar) = (configuration.daemon()?, configuration.ball_bar()?);
    let stop = Stop::default();
    let has_person = !format.json && io::stdin().is_terminal() && io::stdout().is_terminal();
    let work = async {
        let bench =
            Bench { smoke: &smoke, daemon: &daemon, bar: &bar, request: &request, has_person, stop: &stop };
        // Stop if nothing can be printed, because the person would see no instructions.
        let mut print = |line: &str| {
            if !format.json
                && let Err(error) = say(line)
            {
                stop.stop(&explained(&error));
            }
        };
        Ok(smoke::smoke(&Threads::on(Clock::Real), &bench, &mut print).await?)
    };
    let report = on_signal(work, |signal| stop.stop(&format!("stopped by {signal}")))?;
    let file = file.unwrap_or_else(|| format!("smoke-{}.json", report.bus).into());
    finish(&report, &file, format)
}

fn finish(report: &Report, file: &Path, format: Format) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(report)? + "\n";
    // A device such as /dev/null, a pipe or a link must not be replaced by a file. The test of a bus often runs as root.
    if fs::symlink_metadata(file).is_ok_and(|found| !found.is_file()) {
        fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))?;
    } else {
        whole_file::write(&SystemDisk, file, &text)?;
    }
    if !format.prints(report)? {
        show(report)?;
        say(format_args!("all figures are in {}; send it with these lines", file.display()))?;
    }
    let (bad, all) = (report.bad_checks(), report.checks.len());
    if bad > 0 {
        bail!("{bad} of {all} checks failed or could not be done");
    }
    Ok(())
}
