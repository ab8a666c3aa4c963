//! Commands that ask a running service: `start`, `stop`, `status`, `mark`, `note`, `check`, `runs`, `delete`, `restore`, `bin`.

use std::fmt::Write as _;
use std::io::{IsTerminal, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;
use serde::Serialize;
use serde::de::DeserializeOwned;
use shared::config::DaemonConfig;
use shared::output::say;
use shared::recording::{RunMark, SystemDisk};
use ureq::http::StatusCode;

use super::Format;
use super::configuration::Configuration;
use super::elsewhere::ElsewhereArguments;
use crate::control::recordings::runs::{self, RunLine};
use crate::control::recordings::verdict::Verdict;
use crate::control::status::{
    CheckLine, DeleteRequest, EmptyBinRequest, Granted, IN_SPITE_OF, LastRun, Level, MarkRequest,
    NoteRequest, PairReply, PairRequest, PairingLink, Refusal, Reply, RunStatus, StartRequest, Status,
    StopRequest,
};
use crate::problem::{Problem, clock_time};
use crate::run::About;

/// Longer than the service takes to finish a file on a slow disk.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Where the service is.
#[derive(Debug, Args)]
pub struct ServiceArguments {
    #[command(flatten)]
    configuration: Configuration,
    /// Port of the service; default: `port` of daemon.toml
    #[arg(long)]
    port: Option<u16>,
    #[command(flatten)]
    elsewhere: ElsewhereArguments,
    #[command(flatten)]
    pub format: Format,
}

#[derive(Debug, Args)]
pub struct StartArguments {
    /// Name of the run and of its file, in which spaces and the like become `-`; default: date, robot, bar and a number
    #[arg(long)]
    name: Option<String>,
    /// How long: 90 (seconds), 90s or 2m; default: until stopped
    #[arg(long, value_parser = shared::time::parse_duration)]
    duration: Option<Duration>,
    /// Why the run begins in spite of a problem that stops it; goes into the file
    #[arg(long)]
    reason: Option<String>,
    #[command(flatten)]
    about: About,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct AskArguments {
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
    /// Remove every recording in the bin from the disk for ever
    #[arg(long)]
    empty: bool,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct StatusArguments {
    /// Also how late the cycles of the run were, and how long they took
    #[arg(long)]
    timing: bool,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct MarkArguments {
    /// Text of the marker; default: a number
    text: Option<String>,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct NoteArguments {
    /// Name of the run
    name: String,
    /// Its note from now on; "" for none
    note: String,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct RunsArguments {
    /// Directory of the recordings; default: those of the running service, or `directory` of daemon.toml
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
    let what = if reply.answer == Granted::Running { "is running already" } else { "has begun" };
    let simulated = if reply.simulated { "; SIMULATED" } else { "" };
    service.format.answer(&reply, format_args!("run `{}` {what}{simulated}", run_of(&reply)))
}

pub fn stop(arguments: &AskArguments) -> anyhow::Result<()> {
    let request = StopRequest { cause: Some("stopped by `ballbard stop`".into()) };
    let reply: Reply = arguments.service.post("stop", &request)?;
    let Reply { answer, last, verdict, homing, .. } = &reply;
    let printed = arguments.service.format.prints(&reply)?;
    match (answer, last) {
        (Granted::Stopped, Some(last)) => {
            if !printed {
                say(last_run(last))?;
                verdict.iter().try_for_each(say)?;
                last.next.iter().try_for_each(|next| say(next_step(&last.name, next)))?;
            }
            if let Some(Verdict { level: Level::Bad, reasons }) = verdict {
                bail!("run `{}` is of no use: {}", last.name, reasons.join("; "));
            }
        }
        _ if printed => {}
        _ => homing.as_ref().map_or_else(|| say("no run goes on"), say)?,
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
        .answer(&reply, format_args!("`{name}` is in the bin; `ballbard restore {name}` brings it back"))
}

pub fn restore(arguments: NameArguments) -> anyhow::Result<()> {
    let NameArguments { name, service } = arguments;
    let reply: Reply = service.post("restore", &DeleteRequest { name })?;
    service.format.answer(&reply, format_args!("`{}` is among the recordings again", run_of(&reply)))
}

/// Prints a QR code that lets a phone in.
pub fn pair(arguments: &AskArguments) -> anyhow::Result<()> {
    let reply: PairReply = arguments.service.post("pair", &PairRequest {})?;
    if arguments.service.format.prints(&reply)? {
        return Ok(());
    }
    // On a terminal in black and white, whatever its own colours are.
    let [begin, end] = if std::io::stdout().is_terminal() { ["\x1b[97;40m", "\x1b[0m"] } else { ["", ""] };
    for PairingLink { url, .. } in &reply.links {
        let code = QrCode::new(url).context("no QR code can be made")?;
        let code = code.render::<Dense1x2>().dark_color(Dense1x2::Light).light_color(Dense1x2::Dark).build();
        code.lines().try_for_each(|line| say(format_args!("{begin}{line}{end}")))?;
        say(url)?;
    }
    let PairReply { valid_s, fingerprint, .. } = &reply;
    Ok(say(format_args!(
        "point the phone's camera at it; it works once, within {} minutes\nSHA-256 of the certificate: {fingerprint}",
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
    service.format.answer(&reply, format_args!("run `{}` has this note now", run_of(&reply)))
}

pub fn status(arguments: &StatusArguments) -> anyhow::Result<()> {
    let status: Status = arguments.service.get("status")?;
    if arguments.service.format.prints(&status)? {
        return Ok(());
    }
    let reason = status.reason.as_ref().map_or(String::new(), |why| format!(": {why}"));
    say(format_args!("{}{reason}{}", status.headline().word, codes(&status.problems)))?;
    if status.simulated {
        say("SIMULATED: no hardware; the encoder counts are made up")?;
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
        say(format_args!("disk: {usable} MB above the floor"))?;
    }
    if let Some(remote) = &status.remote {
        say(format_args!("for other machines: {remote}"))?;
    }
    if let Some(last) = &status.last {
        say(format_args!("last run: {}", last_run(last)))?;
        last.verdict.iter().try_for_each(say)?;
        last.next.iter().try_for_each(|next| say(next_step(&last.name, next)))?;
    }
    let of_run = status.run.as_ref().and_then(|run| run.timing.as_ref());
    let timing = of_run.or(status.last.as_ref().and_then(|last| last.timing.as_ref()));
    timing.filter(|_| arguments.timing).iter().try_for_each(say)?;
    Ok(())
}

pub fn check(arguments: &AskArguments) -> anyhow::Result<()> {
    let lines: Vec<CheckLine> = arguments.service.get("check")?;
    let printed = arguments.service.format.prints(&lines)?;
    for CheckLine { subject, finding, remedy, stops, problems } in lines.iter().filter(|_| !printed) {
        match remedy {
            None => say(format_args!("ok       {subject}: {finding}")),
            Some(remedy) => {
                let level = if *stops { "PROBLEM" } else { "warning" };
                say(format_args!("{level}  {subject}: {finding}{}\n         {remedy}", codes(problems)))
            }
        }?;
    }
    let problems = lines.iter().filter(|line| line.stops).count();
    if problems > 0 {
        bail!("{problems} of {} checks found a problem that would cost a run", lines.len());
    }
    Ok(())
}

/// The names under which the manual explains these problems.
fn codes(problems: &[Problem]) -> String {
    let mut codes: Vec<_> = problems.iter().map(Problem::code).collect();
    codes.dedup();
    if codes.is_empty() { String::new() } else { format!(" [{}]", codes.join(", ")) }
}

pub fn list(arguments: &RunsArguments) -> anyhow::Result<()> {
    let RunsArguments { directory, service } = arguments;
    let lines = match directory {
        Some(directory) => listed_in(directory, None)?,
        None => service.runs()?,
    };
    print_list(&lines, "no recordings", service.format)
}

fn print_list(lines: &[RunLine], none: &str, format: Format) -> anyhow::Result<()> {
    if format.prints(&lines)? {
        return Ok(());
    }
    // Where they are, once, as far as it is the same.
    let mut place = None;
    for line in lines {
        let parent = line.file.parent();
        if place != parent {
            place = parent;
            say(format_args!("in {}:", parent.unwrap_or(Path::new(".")).display()))?;
        }
        say(listed(line))?;
    }
    if lines.is_empty() {
        say(none)?;
    }
    Ok(())
}

fn listed_in(directory: &Path, spare: Option<&Path>) -> anyhow::Result<Vec<RunLine>> {
    runs::list(&SystemDisk, directory, spare)
        .with_context(|| format!("cannot list recordings in {}", directory.display()))
}

/// Nobody answers where the service should be.
#[derive(Debug, thiserror::Error)]
#[error("no answer from {url} ({why}); {remedy}")]
pub(super) struct NoService {
    url: String,
    why: ureq::Error,
    remedy: String,
}

impl ServiceArguments {
    /// Where the configuration comes from.
    pub fn configuration(&self) -> &Configuration {
        &self.configuration
    }

    /// Recordings of the running service; of the configured directory where none runs.
    pub fn runs(&self) -> anyhow::Result<Vec<RunLine>> {
        match self.get("runs") {
            Err(error) if self.is_default() && error.is::<NoService>() => {
                let DaemonConfig { directory, spare_directory, .. } = self.configuration.daemon()?;
                listed_in(&directory, Some(&spare_directory))
            }
            outcome => outcome,
        }
    }

    /// Asks the service for something that changes nothing.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        self.answer(path, |agent, url| agent.get(url).call(), understood)
    }

    /// A file of the service of another machine; none of this machine's, whose files are at hand.
    pub fn fetch<T>(
        &self,
        path: &str,
        read: impl FnOnce(&mut dyn Read) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let asked = |agent: &ureq::Agent, url: &str| {
            // However long it takes, as long as something comes.
            agent.get(url).config().timeout_global(None).timeout_per_read(Some(TIMEOUT)).build().call()
        };
        self.answer(path, asked, |mut response| {
            read(&mut response.body_mut().with_config().limit(u64::MAX).reader())
        })
    }

    /// Asks the service to do something.
    pub fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        self.answer(path, |agent, url| agent.post(url).send_json(body), understood)
    }

    /// That of another machine.
    pub fn is_elsewhere(&self) -> bool {
        self.elsewhere.named().is_some()
    }

    /// Nobody has said which.
    fn is_default(&self) -> bool {
        self.port.is_none() && !self.is_elsewhere()
    }

    /// What is made of the answer, where the request was granted.
    fn answer<T>(
        &self,
        path: &str,
        ask: impl FnOnce(&ureq::Agent, &str) -> Result<Response, ureq::Error>,
        read: impl FnOnce(Response) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let (agent, url) = self.reached(path)?;
        let mut response = match ask(&agent, &url) {
            Ok(response) => response,
            Err(ureq::Error::Other(why)) => bail!("{url}: {why}"),
            Err(why) => return Err(NoService { url, why, remedy: self.remedy() }.into()),
        };
        let status = response.status();
        if status.is_success() {
            return read(response);
        }
        let refused = response.body_mut().read_json::<Refusal>();
        let error =
            refused.map_or_else(|_| format!("the service answered {status}"), |refusal| refusal.error);
        match self.elsewhere.named() {
            Some(elsewhere) if status == StatusCode::UNAUTHORIZED => {
                bail!("{url} refuses the token in {}: {error}", elsewhere.token_file().display())
            }
            _ => bail!(error),
        }
    }

    fn reached(&self, path: &str) -> anyhow::Result<(ureq::Agent, String)> {
        let config = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .proxy(None)
            .timeout_global(Some(TIMEOUT));
        if let Some(elsewhere) = self.elsewhere.named() {
            return Ok((elsewhere.agent(config)?, elsewhere.url(path)));
        }
        let port = match self.port {
            Some(port) => port,
            None => self.configuration.daemon()?.port,
        };
        Ok((config.build().into(), format!("http://127.0.0.1:{port}/api/{path}")))
    }

    /// Where nobody answers.
    fn remedy(&self) -> String {
        if self.is_elsewhere() {
            return "does `ballbard run --listen` go on there, and does its `ballbard status` say this address? look at the \
                    network between"
                .into();
        }
        let from = self.port.map_or_else(|| self.configuration.origin(), |_| "--port".into());
        format!(
            "is the service running? start it with `ballbard run --bus INTERFACE` (the port is that of {from}; --port takes another, --service \
             that of another machine)"
        )
    }
}

/// A run without a single valid cycle is no success, although its file is whole.
pub(super) fn unless_blind(cycles: u64, cycles_valid: u64) -> anyhow::Result<()> {
    if cycles > 0 && cycles_valid == 0 {
        bail!(
            "none of the {cycles} cycles is valid; `ballbard check` says what is wrong with bus and encoders"
        );
    }
    Ok(())
}

/// Name of the run that a reply is about.
fn run_of(reply: &Reply) -> &str {
    reply.run.as_deref().unwrap_or_default()
}

type Response = ureq::http::Response<ureq::Body>;

fn understood<T: DeserializeOwned>(mut response: Response) -> anyhow::Result<T> {
    let answer = response.body_mut().read_json();
    answer.context("the service's answer is not understood; are both of the same version?")
}

fn running(run: &RunStatus) -> String {
    let age = run.sync_age_ms.map_or("nothing on disk yet".into(), |age| format!("all up to {age} ms ago"));
    format!(
        "run `{}`: {} cycles on disk, {} valid, {} lost, {:.1} MB, {age}\n{}; {:.1} s not synchronised yet, {:.1} s not \
         written yet (at {:.0} s cycles are lost)",
        run.name,
        run.cycles,
        run.cycles_valid,
        run.cycles_lost,
        run.bytes as f64 * 1e-6,
        if run.file.is_empty() { "no file yet" } else { &run.file },
        run.unsynced_s,
        run.backlog_s,
        run.backlog_limit_s
    )
}

pub(super) fn last_run(last: &LastRun) -> String {
    let LastRun { name, file, cycles, cycles_valid, cycles_lost, cause, provenance, .. } = last;
    let flagged = cycles - cycles_valid.min(cycles);
    let Some(file) = file else { return format!("{name}: {cause}") };
    let provenance = if provenance.is_measured() { String::new() } else { format!("\n{provenance}") };
    format!(
        "{file}\n{cycles} cycles, {cycles_valid} valid, {flagged} flagged, {cycles_lost} lost; {cause}{provenance}"
    )
}

/// What comes after a run.
fn next_step(name: &str, command: &str) -> String {
    format!("next: save the log of the robot's controller as {name}.csv, then type\n  {command}")
}

fn listed(line: &RunLine) -> String {
    let started = line.started.map_or(String::from("?"), |at| {
        at.to_datetime().with_timezone(&chrono::Local).format("%Y-%m-%d %H:%M:%S %:z").to_string()
    });
    let verdict = line.verdict.as_ref().map(ToString::to_string);
    let verdict = verdict.into_iter().chain(Some(line.cause.clone()).filter(|cause| !cause.is_empty()));
    let verdict = verdict.collect::<Vec<_>>().join("; ");
    let mut text = format!(
        "{:<28} {started:<26}  {:>8.1} s {:>8} cycles  {verdict}",
        line.name, line.length_s, line.cycles
    );
    if !line.provenance.is_measured() {
        let _ = write!(text, "  [{}]", line.provenance);
    }
    if line.recovered {
        text.push_str("  [recovered]");
    }
    let (reasons, marks): (Vec<_>, Vec<_>) =
        line.marks.iter().partition(|mark| mark.text.starts_with(IN_SPITE_OF));
    for RunMark { text: reason, .. } in reasons {
        let _ = write!(text, "  [{}]", reason.replace(char::is_control, " "));
    }
    if !marks.is_empty() {
        let _ = write!(text, "  [{} marks]", marks.len());
    }
    if !line.note.is_empty() {
        let _ = write!(text, "  {}", line.note.replace(char::is_control, " "));
    }
    text
}
