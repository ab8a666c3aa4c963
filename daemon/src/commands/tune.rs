//! `ballbard tune`: finds settings of this machine that delay the cycle, and prints the commands that correct them.

use std::path::Path;

use anyhow::bail;
use clap::Args;
use shared::output::say;

use super::Format;
use super::configuration::ConfigurationFiles;
use crate::segment::interface_index;
use crate::tuning::{self, Machine, SettingGrade};

#[derive(Debug, Args)]
pub struct TuneArguments {
    /// Network interface of the bus, such as eth1
    #[arg(long, help_heading = "Connection")]
    interface: Option<String>,
    #[command(flatten)]
    format: Format,
    #[command(flatten)]
    configuration: ConfigurationFiles,
}

pub fn run(arguments: &TuneArguments) -> anyhow::Result<()> {
    let daemon = arguments.configuration.daemon()?;
    let interface = arguments.interface.as_deref();
    interface.map(interface_index).transpose()?;
    let machine = Machine::at(Path::new("/"), daemon.realtime.core, daemon.cycle_period(), interface);
    let findings = tuning::findings(&machine);
    if !arguments.format.prints(&findings)? {
        findings.iter().try_for_each(say)?;
    }
    let count = |verdict| findings.iter().filter(|finding| finding.verdict == verdict).count();
    let (problems, unknown) = (count(SettingGrade::Problem), count(SettingGrade::Unknown));
    if problems > 0 {
        bail!("{problems} of {} settings delay the cycle, {unknown} are unknown", findings.len());
    }
    Ok(())
}
