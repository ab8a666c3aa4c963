//! Commands that ask a running service: `start`, `stop`, `status`, `mark`, `check`, `runs`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;
use serde::de::DeserializeOwned;
use shared::config::{self, DaemonConfig};
use shared::output::say;

use crate::control::runs::{self, RunLine};
use crate::control::status::{
    CheckLine, LastRun, MarkRequest, Refusal, Reply, RunStatus, StartRequest, Status, StopRequest,
};

/// Longer than the service takes to finish a file on a slow disk.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Where the service is.
#[derive(Debug, Args)]
pub struct ServiceArguments {
    /// Directory with daemon.toml
    #[arg(long, value_name = "DIR", default_value = "config")]
    config: PathBuf,
    /// Port of the service; default: `port` of daemon.toml
    #[arg(long)]
    port: Option<u16>,
}

#[derive(Debug, Args)]
pub struct StartArguments {
    /// Name of the run and of its file; default: date and time
    #[arg(long)]
    name: Option<String>,
    /// How long, such as 60s or 2m; default: until stopped
    #[arg(long, value_parser = humantime::parse_duration)]
    duration: Option<Duration>,
    /// Who records
    #[arg(long, default_value = "")]
    operator: String,
    /// Which robot
    #[arg(long, default_value = "")]
    robot: String,
    /// Free text, kept in the file
    #[arg(long, default_value = "")]
    note: String,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct AskArguments {
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct MarkArguments {
    /// Text of the marker
    text: String,
    #[command(flatten)]
    service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct RunsArguments {
    /// Directory of the recordings; default: `directory` of daemon.toml
    directory: Option<PathBuf>,
    /// Directory with daemon.toml
    #[arg(long, value_name = "DIR", default_value = "config")]
    config: PathBuf,
}

pub fn start(arguments: StartArguments) -> anyhow::Result<()> {
    let StartArguments { name, duration, operator, robot, note, service } = arguments;
    let request = StartRequest {
        name,
        operator,
        robot,
        note,
        duration_s: duration.map(|duration| duration.as_secs_f64()),
    };
    let reply: Reply = service.post("start", &request)?;
    let run = reply.run.unwrap_or_default();
    match reply.answer.as_str() {
        "running" => say(format_args!("run `{run}` goes on already"))?,
        _ => say(format_args!("run `{run}` has begun"))?,
    }
    Ok(())
}

pub fn stop(arguments: &AskArguments) -> anyhow::Result<()> {
    let request = StopRequest { cause: Some("stopped by `ballbard stop`".into()) };
    let reply: Reply = arguments.service.post("stop", &request)?;
    match (reply.answer.as_str(), reply.last) {
        ("stopped", Some(last)) => {
            say(last_run(&last))?;
            unless_blind(last.cycles, last.cycles_valid)?;
        }
        ("homing", _) => say("the homing ends")?,
        _ => say("no run goes on")?,
    }
    Ok(())
}

pub fn mark(arguments: &MarkArguments) -> anyhow::Result<()> {
    let reply: Reply = arguments.service.post("mark", &MarkRequest { text: arguments.text.clone() })?;
    Ok(say(format_args!("marked in run `{}`", reply.run.unwrap_or_default()))?)
}

pub fn status(arguments: &AskArguments) -> anyhow::Result<()> {
    let status: Status = arguments.service.get("status")?;
    let reason = status.reason.map_or(String::new(), |why| format!(": {why}"));
    say(format_args!("{}{reason}", status.state.to_uppercase()))?;
    if let Some(run) = &status.run {
        say(running(run))?;
    }
    say(format_args!("bus {}: {}", status.bus, status.devices.join(", ")))?;
    for encoder in &status.encoders {
        let valid = if encoder.valid { "valid" } else { "NOT VALID" };
        say(format_args!("  joint {}: {:>10}  {valid}", encoder.joint, encoder.count))?;
    }
    for cable in &status.bad_cables {
        say(cable)?;
    }
    if let Some(usable) = status.disk_usable_mb {
        say(format_args!("disk: {usable} MB above the floor"))?;
    }
    if let Some(last) = &status.last {
        say(format_args!("last run: {}", last_run(last)))?;
    }
    let run = status.run.as_ref().and_then(|run| run.timing.as_ref());
    if let Some(timing) = run.or(status.last.as_ref().and_then(|last| last.timing.as_ref())) {
        say(timing)?;
    }
    Ok(())
}

pub fn check(arguments: &AskArguments) -> anyhow::Result<()> {
    let lines: Vec<CheckLine> = arguments.service.get("check")?;
    for CheckLine { subject, finding, remedy } in &lines {
        match remedy {
            None => say(format_args!("ok       {subject}: {finding}")),
            Some(remedy) => say(format_args!("PROBLEM  {subject}: {finding}\n         {remedy}")),
        }?;
    }
    let problems = lines.iter().filter(|line| line.remedy.is_some()).count();
    if problems > 0 {
        bail!("{problems} of {} checks found a problem", lines.len());
    }
    Ok(())
}

pub fn list(arguments: &RunsArguments) -> anyhow::Result<()> {
    let (directory, spare) = match &arguments.directory {
        Some(directory) => (directory.clone(), None),
        None => {
            let daemon: DaemonConfig = config::load(&arguments.config.join("daemon.toml"))?;
            (daemon.directory, Some(daemon.spare_directory))
        }
    };
    let lines = runs::list(&directory, spare.as_deref())
        .with_context(|| format!("cannot list recordings in {}", directory.display()))?;
    for line in &lines {
        let elsewhere = line.file.parent().filter(|parent| *parent != directory);
        let place = elsewhere.map_or(String::new(), |parent| format!("  [in {}]", parent.display()));
        say(format_args!("{}{place}", listed(line)))?;
    }
    if lines.is_empty() {
        say(format_args!("no recordings in {}", directory.display()))?;
    }
    Ok(())
}

impl ServiceArguments {
    /// Directory of the configuration.
    pub fn config(&self) -> &Path {
        &self.config
    }

    /// Asks the service for something that changes nothing.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        let url = self.url(path)?;
        let response = agent().get(&url).call().with_context(|| not_there(&url))?;
        understood(response)
    }

    /// Asks the service to do something.
    pub fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        let url = self.url(path)?;
        let response = agent().post(&url).send_json(body).with_context(|| not_there(&url))?;
        understood(response)
    }

    fn url(&self, path: &str) -> anyhow::Result<String> {
        let port = match self.port {
            Some(port) => port,
            None => config::load::<DaemonConfig>(&self.config.join("daemon.toml"))?.port,
        };
        Ok(format!("http://127.0.0.1:{port}/{path}"))
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

fn agent() -> ureq::Agent {
    let config =
        ureq::Agent::config_builder().http_status_as_error(false).proxy(None).timeout_global(Some(TIMEOUT));
    config.build().into()
}

fn not_there(url: &str) -> String {
    format!("no answer from {url}; is the service running? start it with `ballbard run`")
}

fn understood<T: DeserializeOwned>(mut response: ureq::http::Response<ureq::Body>) -> anyhow::Result<T> {
    let status = response.status();
    let body = response.body_mut();
    if status.is_success() {
        return body
            .read_json()
            .context("the service's answer is not understood; are both of the same version?");
    }
    match body.read_json::<Refusal>() {
        Ok(Refusal { error }) => bail!(error),
        Err(_) => bail!("the service answered {status}"),
    }
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
        run.file,
        run.unsynced_s,
        run.backlog_s,
        run.backlog_limit_s
    )
}

fn last_run(last: &LastRun) -> String {
    let LastRun { name, file, cycles, cycles_valid, cycles_lost, cause, error: _, timing: _ } = last;
    let flagged = cycles - cycles_valid.min(cycles);
    match file {
        Some(file) => {
            format!(
                "{file}\n{cycles} cycles, {cycles_valid} valid, {flagged} flagged, {cycles_lost} lost; {cause}"
            )
        }
        None => format!("{name}: {cause}"),
    }
}

fn listed(line: &RunLine) -> String {
    let started = line.started.map_or(String::from("?"), |at| {
        at.to_datetime().with_timezone(&chrono::Local).format("%Y-%m-%d %H:%M:%S %:z").to_string()
    });
    let mut text = format!(
        "{:<28} {started:<26}  {:>8.1} s {:>8} cycles  {}",
        line.name, line.length_s, line.cycles, line.verdict
    );
    if line.recovered {
        text.push_str("  [recovered]");
    }
    if !line.note.is_empty() {
        let _ = write!(text, "  {}", line.note.replace(char::is_control, " "));
    }
    text
}
