//! Requests to a running service: `start`, `stop`, `status`, `mark`, `note`, `check`, `runs`, `delete`,
//! `restore`, `bin`, `pair`.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;
use shared::output::say;
use shared::recording::RunMark;

use super::text::{SIMULATED, codes, ensure_usable, last_run, print_list, running};
use super::{ServiceArguments, listed_in};
use crate::control::recordings::runs::RunLine;
use crate::control::status::{
    CheckLine, DeleteRequest, EmptyBinRequest, Granted, MarkRequest, NoteRequest, PairReply, PairRequest,
    PairingLink, Reply, StartRequest, Status, StopRequest,
};
use crate::problem::clock_time;
use crate::run::About;

#[derive(Debug, Args)]
pub struct StartArguments {
    /// Name of the run and of its file; characters other than letters, digits and `-_.+` become `-`.
    /// Default: date, robot, bar and a number
    #[arg(long, help_heading = "Recording")]
    name: Option<String>,
    /// Duration of the run, such as 90 (seconds), 90s or 2m; default: until stopped
    #[arg(long, help_heading = "Recording", value_parser = shared::time::parse_duration)]
    duration: Option<Duration>,
    /// Begin the run even if the check finds a problem that prevents it; this reason is stored in the file
    #[arg(long, help_heading = "Recording")]
    reason: Option<String>,
    #[command(flatten)]
    about: About,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct NameArguments {
    /// Name of the recording
    name: String,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct BinArguments {
    /// Remove every recording in the bin from the disk permanently
    #[arg(long, help_heading = "Recording")]
    empty: bool,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct StatusArguments {
    /// Also print the timing of the run: lateness, round trip and duration of its cycles, and the longest waits for the disk
    #[arg(long, help_heading = "Output")]
    timing: bool,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct MarkArguments {
    /// Text of the marker; default: `mark N`, where N counts the markers without a text
    text: Option<String>,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct NoteArguments {
    /// Name of the run
    name: String,
    /// New note; "" removes the note
    note: String,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct RunsArguments {
    /// Directory of the recordings; default: the directories of the running service, else `directory` of daemon.toml
    #[arg(conflicts_with = "service")]
    directory: Option<PathBuf>,
    #[command(flatten)]
    service: ServiceArguments,
}

pub fn start(arguments: StartArguments) -> anyhow::Result<()> {
    let StartArguments { name, duration, reason, about, service } = arguments;
    let About { operator, robot, bar, payload, note } = about;
    let duration_s = duration.map(|duration| duration.as_secs_f64());
    let request = StartRequest { name, operator, robot, bar, payload, note, duration_s, reason };
    let reply: Reply = service.post("start", &request)?;
    let what = if reply.answer == Granted::Running { "was running already" } else { "has begun" };
    let simulated = if reply.simulated { "; SIMULATED" } else { "" };
    service.format.answer(&reply, format_args!("run `{}` {what}{simulated}", run_of(&reply)))
}

pub fn stop(service: &ServiceArguments) -> anyhow::Result<()> {
    let request = StopRequest { cause: Some("stopped by `ballbard stop`".into()) };
    let reply: Reply = service.post("stop", &request)?;
    let Reply { answer, last, verdict, homing, .. } = &reply;
    let printed = service.format.prints(&reply)?;
    match (answer, last) {
        (Granted::Stopped, Some(last)) => {
            if !printed {
                say(last_run(last))?;
            }
            ensure_usable(&last.name, verdict.as_ref())?;
        }
        _ if printed => {}
        _ => homing.as_ref().map_or_else(|| say("no run is active"), say)?,
    }
    Ok(())
}

pub fn mark(arguments: &MarkArguments) -> anyhow::Result<()> {
    let reply: Reply =
        arguments.service.post("mark", &MarkRequest { text: arguments.text.clone(), ago_ms: 0 })?;
    let mark = reply.mark.as_deref().unwrap_or_default();
    arguments.service.format.answer(&reply, format_args!("marked in run `{}`: {mark}", run_of(&reply)))
}

pub fn delete(arguments: NameArguments) -> anyhow::Result<()> {
    let NameArguments { name, service } = arguments;
    let reply: Reply = service.post("delete", &DeleteRequest { name })?;
    let name = run_of(&reply);
    service
        .format
        .answer(&reply, format_args!("`{name}` is in the bin; `ballbard restore {name}` restores it"))
}

pub fn restore(arguments: NameArguments) -> anyhow::Result<()> {
    let NameArguments { name, service } = arguments;
    let reply: Reply = service.post("restore", &DeleteRequest { name })?;
    service.format.answer(&reply, format_args!("`{}` is among the recordings again", run_of(&reply)))
}

/// Prints a QR code with which a phone opens the page without typing the token.
pub fn pair(service: &ServiceArguments) -> anyhow::Result<()> {
    let reply: PairReply = service.post("pair", &PairRequest {})?;
    if service.format.prints(&reply)? {
        return Ok(());
    }
    // On a terminal, set black and white explicitly, so that the code is readable with any colour scheme.
    let [begin, end] = if std::io::stdout().is_terminal() { ["\x1b[97;40m", "\x1b[0m"] } else { ["", ""] };
    for PairingLink { url, .. } in &reply.links {
        let code = QrCode::new(url).context("cannot make a QR code")?;
        let code = code.render::<Dense1x2>().dark_color(Dense1x2::Light).light_color(Dense1x2::Dark).build();
        code.lines().try_for_each(|line| say(format_args!("{begin}{line}{end}")))?;
        say(url)?;
    }
    let PairReply { valid_s, fingerprint, .. } = &reply;
    Ok(say(format_args!(
        "scan the code with the phone's camera; it works once, within {} minutes\nSHA-256 of the certificate: {fingerprint}",
        valid_s / 60
    ))?)
}

pub fn bin(arguments: &BinArguments) -> anyhow::Result<()> {
    let BinArguments { empty, service } = arguments;
    if *empty {
        let reply: Reply = service.post("bin/empty", &EmptyBinRequest {})?;
        let removed = reply.removed.unwrap_or_default();
        return service.format.answer(&reply, format_args!("recordings removed: {removed}"));
    }
    print_list(&service.get::<Vec<RunLine>>("bin")?, "the bin is empty", service.format)
}

pub fn note(arguments: NoteArguments) -> anyhow::Result<()> {
    let NoteArguments { name, note, service } = arguments;
    let reply: Reply = service.post("note", &NoteRequest { name, note })?;
    service.format.answer(&reply, format_args!("the note of run `{}` is saved", run_of(&reply)))
}

pub fn status(arguments: &StatusArguments) -> anyhow::Result<()> {
    let status: Status = arguments.service.get("status")?;
    if arguments.service.format.prints(&status)? {
        return Ok(());
    }
    let reason = status.reason.as_ref().map_or(String::new(), |why| format!(": {why}"));
    say(format_args!("{}{reason}{}", status.headline().word, codes(&status.problems)))?;
    if status.simulated {
        say(SIMULATED)?;
    }
    if let Some(run) = &status.run {
        say(running(run))?;
        for RunMark { at_s, text } in &run.marks {
            say(format_args!("  {:>8}  {text}", clock_time(*at_s)))?;
        }
    }
    say(format_args!("bus {}: {}", status.bus, status.devices.join(", ")))?;
    for encoder in &status.encoders {
        let valid = if encoder.valid { "valid" } else { "NOT VALID" };
        say(format_args!("  joint {}: {:>10}  {valid}", encoder.joint, encoder.count))?;
    }
    for cable in &status.bad_cables {
        say(cable)?;
    }
    status.homing.iter().try_for_each(say)?;
    if let Some(usable) = status.disk_usable_mb {
        say(format_args!("disk: {usable} MB usable"))?;
    }
    if let Some(remote) = &status.remote {
        say(format_args!("for other machines: {remote}"))?;
    }
    if let Some(last) = &status.last {
        say(format_args!("last run: {}", last_run(last)))?;
    }
    let of_run = status.run.as_ref().and_then(|run| run.timing.as_ref());
    let timing = of_run.or(status.last.as_ref().and_then(|last| last.timing.as_ref()));
    timing.filter(|_| arguments.timing).iter().try_for_each(say)?;
    Ok(())
}

pub fn check(service: &ServiceArguments) -> anyhow::Result<()> {
    let lines: Vec<CheckLine> = service.get("check")?;
    let printed = service.format.prints(&lines)?;
    for CheckLine { subject, finding, remedy, stops, problems, .. } in lines.iter().filter(|_| !printed) {
        match remedy {
            None => say(format_args!("ok       {subject}: {finding}")),
            Some(remedy) => {
                let level = if *stops { "PROBLEM" } else { "warning" };
                say(format_args!("{level}  {subject}: {finding}{}\n         {remedy}", codes(problems)))
            }
        }?;
    }
    let stopping: Vec<_> = lines.iter().filter(|line| line.stops).collect();
    if !stopping.is_empty() {
        let suffices = stopping.iter().all(|line| line.reason_suffices);
        let otherwise = if suffices { ", or give `start` a --reason" } else { "" };
        bail!(
            "{} of {} checks found a problem that stops a run; correct it{otherwise}",
            stopping.len(),
            lines.len()
        );
    }
    Ok(())
}

pub fn list(arguments: &RunsArguments) -> anyhow::Result<()> {
    let RunsArguments { directory, service } = arguments;
    let lines = match directory {
        Some(directory) => listed_in(directory, None)?,
        None => service.runs()?,
    };
    print_list(&lines, "no recordings", service.format)
}

/// Name of the run in a reply.
fn run_of(reply: &Reply) -> &str {
    reply.run.as_deref().unwrap_or_default()
}
