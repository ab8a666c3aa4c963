//! Computes the status of the service from the state of the controller.

use shared::recording::schema::{EncoderInfo, MAX_ENCODERS};
use shared::time::MonoNs;
use shared::version::software;

use super::Controller;
use super::bus_link::{are_silent, silent_encoders};
use crate::control::machine::State;
use crate::control::status::{EncoderStatus, RunStatus, Status};
use crate::problem::{Fact, Problem};
use crate::run::{BusChoice, Session};

impl Controller {
    /// Problems of the disk that concern the current run or the next one.
    pub(super) fn disk_problems(&self) -> Vec<Problem> {
        let run_problems = self.run.as_ref().map(|run| run.progress.get().problems).unwrap_or_default();
        let recovering = self.preparing.as_ref().map(|preparing| {
            Fact::DiskRecovering { since_s: Some(self.now.seconds_since(preparing.since())) }.into()
        });
        run_problems.into_iter().chain(self.storage.problem()).chain(recovering).collect()
    }

    /// Problems of the bus and the encoders. A run continues despite these problems.
    fn bus_problems(&self) -> Vec<Problem> {
        let fault = match self.machine.state() {
            State::Fault => self.machine.fault(),
            _ => self.machine.bus_fault(),
        };
        match fault {
            Some(problem) => vec![problem.clone()],
            None => self.bus.session().map(silent_encoders).unwrap_or_default(),
        }
    }

    /// The complete status, for programs and people.
    pub(super) fn status(&self) -> Status {
        // Collect the problems. A problem of the disk that the bus problems already contain is not repeated.
        let mut problems = self.bus_problems();
        for problem in self.disk_problems() {
            if !problems.iter().any(|other| other.fact.key() == problem.fact.key()) {
                problems.push(problem);
            }
        }
        let end_cause = self.machine.cause().map(str::to_owned);
        let problem_line = Some(Problem::line(&problems)).filter(|line| !line.is_empty());
        let reasons = end_cause.into_iter().chain(problem_line);
        let session = self.bus.session();
        let mut status = Status {
            state: self.machine.state(),
            reason: reasons.reduce(|first, second| format!("{first}; {second}")),
            severity: problems.iter().map(|problem| problem.severity).max().unwrap_or_default(),
            problems,
            totals: self.totals.clone(),
            run: self.run_status(),
            last: self.last.clone(),
            runs_over: self.runs_over,
            homing: self.homing.as_ref().map(|homing| homing.status().clone()),
            version: software("ballbard"),
            bus: bus_name(&self.settings.bus),
            simulated: session.map_or(self.settings.bus == BusChoice::Simulated, Session::is_simulated),
            disk_usable_mb: self.storage.usable_bytes().map(|bytes| bytes / 1_000_000),
            ..Status::default()
        };
        // Add what only a bus in operation can provide.
        if let Some(session) = session {
            add_bus(&mut status, session, self.bus.valid_shares());
            status.sample_age_ms = age_ms(status.sampled, self.now);
        }
        status
    }

    fn run_status(&self) -> Option<RunStatus> {
        let (name, run) = (self.machine.run()?, self.run.as_ref()?);
        let progress = run.progress.get();
        Some(RunStatus {
            name: name.to_owned(),
            started: run.started,
            started_ms: run.started.0 / 1_000_000,
            duration_s: self.duration.map(|duration| duration.as_secs_f64()),
            marks: self.marks.latest(),
            flagged: progress.flagged,
            file: progress.file.display().to_string(),
            cycles: progress.synced.cycles,
            cycles_valid: progress.synced.cycles_valid,
            cycles_written: progress.written,
            cycles_taken: progress.taken,
            cycles_lost: progress.lost,
            bytes: progress.synced.bytes,
            sync_age_ms: progress.sync_age.map(|age| age.as_millis() as i64),
            unsynced_s: progress.unsynced_s,
            backlog_s: progress.backlog_s,
            backlog_limit_s: progress.backlog_limit_s,
            disk: progress.longest,
            timing: progress.timing,
        })
    }
}

/// Adds devices, links and encoders to the status. The arrays are long enough, because `ball_bar.toml`
/// has at most [`MAX_ENCODERS`].
fn add_bus(status: &mut Status, session: &Session, valid_shares: Option<[f64; MAX_ENCODERS]>) {
    let live = &session.live;
    status.devices = session.devices().iter().map(|device| device.name.clone()).collect();
    status.sampled = live.at();
    status.origin = live.origin();
    status.bad_cables = live.bad_ports().into_iter().map(|counts| Fact::from(counts).into()).collect();
    let (samples, latches, silent) = (live.encoders(), live.latches(), are_silent(session));
    let encoder = |(index, info): (usize, &EncoderInfo)| EncoderStatus {
        joint: info.joint,
        count: samples[index].count,
        latch: latches[index],
        status: samples[index].status,
        valid: samples[index].valid,
        silent: silent[index],
        valid_share: valid_shares.map(|shares| shares[index]),
    };
    status.encoders = session.encoders.iter().enumerate().map(encoder).collect();
}

/// Age of a time; `None` if the time is 0, which means "never" \[ms\].
fn age_ms(at: MonoNs, now: MonoNs) -> Option<i64> {
    (at.0 != 0).then(|| now.ns_since(at) / 1_000_000)
}

fn bus_name(bus: &BusChoice) -> String {
    match bus {
        BusChoice::Simulated => "simulated".into(),
        BusChoice::Replay(file) => format!("replay of {}", file.display()),
        BusChoice::Interface(name) => name.clone(),
    }
}
