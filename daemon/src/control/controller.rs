//! The thread that does what the [`machine`](super::machine) decides: bus, runs, homing, answers.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use shared::time::MonoNs;
use tokio::sync::{oneshot, watch};

use super::bus_link::BusLink;
use super::homing::Homing;
use super::machine::{Action, Answer, Event, Machine};
use super::preflight;
use super::service::{Connect, Settings};
use super::status::{CheckLine, LastRun, Status};
use super::view::View;
use crate::homing;
use crate::recorder::RunSummary;
use crate::run::{self, ActiveRun, RunDetails, RunError, Stop, Storage};

/// How often bus and recorder are looked at while nobody asks for anything.
const POLL: Duration = Duration::from_millis(100);
/// Why a run ends when this thread does.
const CONTROL_DIED: &str = "full fault: the thread of the control has ended; its cause is in the log";
/// Without anything new on disk for this long a run is not writing \[sync periods\].
const STALLED_SYNC_PERIODS: u32 = 3;

/// What somebody asks of the service.
pub(super) enum Command {
    Start(Box<RunDetails>, bool, oneshot::Sender<Answer>),
    /// Answered with how many runs were over when it was asked.
    Stop(String, oneshot::Sender<(Answer, u64)>),
    Home(oneshot::Sender<Answer>),
    Mark(String, MonoNs, oneshot::Sender<Result<Option<String>, String>>),
    Check(oneshot::Sender<Vec<CheckLine>>),
    Shutdown(String),
    /// Takes the thread with it.
    #[cfg(test)]
    Panic,
}

/// Does what the machine decides.
pub(super) struct Controller {
    settings: Arc<Settings>,
    machine: Machine,
    status: watch::Sender<Status>,
    bus: BusLink,
    homing: Option<Homing>,
    /// The run that is asked for, until it is opened.
    wanted: RunDetails,
    run: Option<ActiveRun>,
    summary: Option<RunSummary>,
    /// Why the file of the run that ends could not be finished in the ordinary way.
    failure: Option<String>,
    last: Option<LastRun>,
    runs_over: u64,
    storage: Storage,
    cycles_seen: u64,
    exit: bool,
}

impl Controller {
    pub fn new(
        settings: Arc<Settings>,
        connect: Arc<Connect>,
        storage: Storage,
        status: watch::Sender<Status>,
    ) -> Self {
        Self {
            settings,
            machine: Machine::default(),
            status,
            bus: BusLink::new(connect),
            homing: None,
            wanted: RunDetails::default(),
            run: None,
            summary: None,
            failure: None,
            last: None,
            runs_over: 0,
            storage,
            cycles_seen: 0,
            exit: false,
        }
    }

    /// Until the service is asked to end.
    pub fn run(&mut self, commands: &Receiver<Command>) {
        while !self.exit {
            match commands.recv_timeout(POLL) {
                Ok(command) => self.obey(command),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    self.handle(Event::Shutdown("the service was dropped".into()));
                }
            }
            self.look_at_bus();
            self.look_at_homing();
            self.look_at_run();
            self.publish();
        }
        self.bus.close();
    }

    /// After a panic of this thread: nothing is decided any more, but a run's file is finished and states the cause.
    pub fn abandon(&mut self) {
        self.status.send_modify(|status| {
            (status.state, status.reason) = ("fault".into(), Some(CONTROL_DIED.into()));
        });
        if let Some(run) = self.run.take() {
            run.stop.stop(CONTROL_DIED);
            match run.join() {
                Ok(summary) => tracing::info!(file = %summary.path.display(), "the run's file is finished"),
                Err(error) => tracing::error!("recording failed: {error}"),
            }
        }
        self.bus.close();
    }

    fn obey(&mut self, command: Command) {
        // Whoever asked may have gone away meanwhile; what was asked is done all the same.
        match command {
            Command::Start(details, named, reply) => {
                // A cable that was pulled since the last look is no bus to begin on.
                self.look_at_bus();
                self.wanted = *details;
                if !named {
                    self.wanted.name = self.free_name();
                }
                let run = self.wanted.name.clone();
                let answer = self.handle(Event::Start { run, named });
                self.publish();
                let _ = reply.send(answer.unwrap_or(Answer::Idle));
            }
            Command::Stop(cause, reply) => {
                let runs_over = self.runs_over;
                let answer = self.handle(Event::Stop(cause));
                self.publish();
                let _ = reply.send((answer.unwrap_or(Answer::Idle), runs_over));
            }
            Command::Home(reply) => {
                let answer = self.handle(Event::Home);
                self.publish();
                let _ = reply.send(answer.unwrap_or(Answer::Idle));
            }
            Command::Mark(text, at, reply) => {
                let marked = self.run.as_ref().filter(|run| !run.stop.is_stopped());
                let _ = reply.send(match marked.map(|run| run.mark(at, text)) {
                    Some(false) => Err("the disk takes no more markers; see `ballbard status`".into()),
                    Some(true) => Ok(self.machine.run().map(str::to_owned)),
                    None => Ok(None),
                });
            }
            Command::Check(reply) => {
                let view = self.view();
                let _ = reply.send(preflight::check(&view, &view.status()));
            }
            Command::Shutdown(cause) => {
                self.handle(Event::Shutdown(cause));
            }
            #[cfg(test)]
            Command::Panic => panic!("the test ends this thread"),
        }
    }

    /// Lets the machine decide and does it; what that brings about is decided in turn.
    fn handle(&mut self, event: Event) -> Option<Answer> {
        let mut answer = None;
        for action in self.machine.handle(event) {
            match action {
                Action::Answer(given) => answer = answer.or(Some(given)),
                Action::Open(_) => {
                    // It takes as long as the disk takes, and whoever asks meanwhile should know.
                    self.publish();
                    if let Err(refusal) = self.open() {
                        answer = Some(Answer::Refused(refusal));
                    }
                }
                Action::End(cause) => {
                    self.run.iter().for_each(|run| run.stop.stop(&cause));
                }
                Action::Finished { run, cause } => self.finished(run, cause),
                // The link tries by itself whenever it is down.
                Action::Connect => {}
                Action::BeginHoming => {
                    self.homing = self.bus.session().map(Homing::begin);
                    if self.homing.is_none() {
                        self.handle(Event::HomingOver);
                    }
                }
                Action::EndHoming(cause) => self.homing.iter().for_each(|homing| homing.stop(&cause)),
                Action::Recover => {
                    run::finish_leftovers(&self.storage);
                    self.handle(Event::Recovered);
                }
                Action::Exit => self.exit = true,
            }
        }
        answer
    }

    fn open(&mut self) -> Result<(), String> {
        match self.begin() {
            Ok(run) => {
                tracing::info!(run = self.wanted.name, "run begins");
                self.run = Some(run);
                self.cycles_seen = 0;
                self.handle(Event::Opened);
                Ok(())
            }
            Err(reason) => {
                self.handle(Event::OpenFailed(reason.clone()));
                Err(reason)
            }
        }
    }

    fn begin(&mut self) -> Result<ActiveRun, String> {
        let session = self.bus.session().ok_or("the bus is not in operation")?;
        self.wanted.homing =
            homing::file::read(&self.settings.homing_file).map_err(|error| error.to_string())?;
        session.begin(&self.wanted, &Stop::default()).map_err(|error| error.to_string())
    }

    fn finished(&mut self, name: String, cause: String) {
        let summary = self.summary.take();
        let error = self.failure.take().or_else(|| summary.is_none().then(|| cause.clone()));
        // What the file states is what everybody is told.
        let cause =
            summary.as_ref().filter(|_| error.is_none()).map_or(cause, |summary| summary.cause.clone());
        self.runs_over += 1;
        tracing::info!(
            run = name,
            cause,
            cycles = summary.as_ref().map(|summary| summary.cycles),
            "run is over"
        );
        let count = |of: fn(&RunSummary) -> u64| summary.as_ref().map_or(0, of);
        self.last = Some(LastRun {
            name,
            cause,
            cycles: count(|summary| summary.cycles),
            cycles_valid: count(|summary| summary.cycles_valid),
            cycles_lost: count(|summary| summary.cycles_lost),
            error,
            file: summary.as_ref().map(|summary| summary.path.display().to_string()),
            timing: summary.and_then(|summary| summary.timing),
        });
    }

    fn look_at_bus(&mut self) {
        if let Some(event) = self.bus.look() {
            self.handle(event);
        }
    }

    fn look_at_homing(&mut self) {
        let Some(homing) = &mut self.homing else { return };
        if homing.look(&self.settings) {
            self.handle(Event::HomingOver);
        }
    }

    fn look_at_run(&mut self) {
        let Some(run) = &self.run else { return };
        if run.is_finished() {
            if let Some(run) = self.run.take() {
                self.run_is_over(run);
            }
            return;
        }
        if run.stop.is_stopped() {
            let cause = run.stop.cause();
            self.handle(Event::Ended(cause));
            return;
        }
        let synced = run.progress.get().synced;
        let stalled_after = self.settings.daemon.sync_period() * STALLED_SYNC_PERIODS;
        if synced.cycles > self.cycles_seen {
            self.cycles_seen = synced.cycles;
            self.handle(Event::Synced);
        } else if synced.at.is_none_or(|at| at.elapsed() > stalled_after) {
            self.handle(Event::Stalled);
        }
    }

    fn run_is_over(&mut self, run: ActiveRun) {
        let outcome = run.join();
        match outcome {
            Ok(summary) => {
                self.handle(Event::Ended(summary.cause.clone()));
                self.summary = Some(summary);
                self.handle(Event::Closed);
            }
            Err(error) => {
                tracing::error!("recording failed: {error}");
                let told = error.to_string();
                if let RunError::Broken { content, .. } = error {
                    self.summary = content.map(|summary| *summary);
                }
                self.failure = Some(told.clone());
                self.handle(Event::CloseFailed(told));
            }
        }
    }

    /// A name of date and time that no file bears.
    fn free_name(&self) -> String {
        let base = run::name_by_time();
        let taken = |name: &str| {
            let directory = &self.settings.daemon.directory;
            ["mcap", "mcap.active"].iter().any(|ending| directory.join(format!("{name}.{ending}")).exists())
        };
        let numbered = (2..1000).map(|number| format!("{base}-{number}"));
        std::iter::once(base.clone()).chain(numbered).find(|name| !taken(name)).unwrap_or(base)
    }

    fn view(&self) -> View<'_> {
        View {
            settings: &self.settings,
            machine: &self.machine,
            session: self.bus.session(),
            run: self.run.as_ref(),
            homing: self.homing.as_ref(),
            last: self.last.as_ref(),
            runs_over: self.runs_over,
            storage: &self.storage,
        }
    }

    fn publish(&self) {
        self.status.send_replace(self.view().status());
    }
}
