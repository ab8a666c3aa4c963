//! The thread that does what the [`machine`](super::machine) decides: bus, runs, answers.

use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use shared::config::{BallBarConfig, DaemonConfig};
use shared::time::MonoNs;
use tokio::sync::{oneshot, watch};

use super::machine::{Action, Answer, Event, Machine, State};
use super::preflight;
use super::status::{CheckLine, EncoderStatus, LastRun, Refusal, RunStatus, StartRequest, Status};
use crate::clock::Clock;
use crate::recorder::RunSummary;
use crate::run::{self, ActiveRun, BusChoice, DiskFloor, RunDetails, RunError, Session, Stop};

/// How often bus and recorder are looked at while nobody asks for anything.
const POLL: Duration = Duration::from_millis(100);
/// Without anything new on disk for this long a run is not writing \[sync periods\].
const STALLED_SYNC_PERIODS: i64 = 3;
/// Pauses between attempts to bring the bus up.
const RETRY_FIRST: Duration = Duration::from_secs(1);
const RETRY_LONGEST: Duration = Duration::from_secs(30);

/// What the service is made of.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Which bus.
    pub bus: BusChoice,
    /// `daemon.toml`.
    pub daemon: DaemonConfig,
    /// `ball_bar.toml`.
    pub bar: BallBarConfig,
}

/// What somebody asks of the service.
enum Command {
    Start(Box<RunDetails>, bool, oneshot::Sender<Answer>),
    Stop(String, oneshot::Sender<Answer>),
    Mark(String, oneshot::Sender<Option<String>>),
    Check(oneshot::Sender<Vec<CheckLine>>),
    Shutdown(String),
}

/// What the preflight check looks at beside the status.
pub(super) struct Seen {
    pub state: State,
    pub directory: PathBuf,
    pub floor: DiskFloor,
    pub realtime_problem: Option<String>,
}

/// The way to the service's thread. Clones reach the same service.
#[derive(Clone)]
pub struct Service {
    commands: Sender<Command>,
    status: watch::Receiver<Status>,
    settings: Arc<Settings>,
    thread: Arc<Mutex<Option<thread::JoinHandle<()>>>>,
}

impl Service {
    /// Starts the service: left-over runs are finished, the bus is brought up and kept up.
    pub fn start(settings: Settings) -> std::io::Result<Self> {
        run::finish_leftovers(&settings.daemon.directory);
        let settings = Arc::new(settings);
        let (commands, commands_rx) = channel();
        let (status_tx, status) = watch::channel(Status::default());
        let mut controller = Controller::new(Arc::clone(&settings), status_tx);
        let thread =
            thread::Builder::new().name("control".into()).spawn(move || controller.run(&commands_rx))?;
        Ok(Self { commands, status, settings, thread: Arc::new(Mutex::new(Some(thread))) })
    }

    /// What it is doing.
    pub fn status(&self) -> Status {
        self.status.borrow().clone()
    }

    /// Told whenever the status changes.
    pub fn watch(&self) -> watch::Receiver<Status> {
        self.status.clone()
    }

    /// What it is made of.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub(super) async fn begin(&self, request: StartRequest) -> Result<Answer, Refusal> {
        let named = request.name.is_some();
        let details = Box::new(details(request, &self.settings.daemon)?);
        self.ask(|reply| Command::Start(details, named, reply)).await
    }

    pub(super) async fn stop(&self, cause: String) -> Result<Answer, Refusal> {
        self.ask(|reply| Command::Stop(cause, reply)).await
    }

    /// The run that was marked; none if none goes on.
    pub(super) async fn mark(&self, text: String) -> Result<Option<String>, Refusal> {
        self.ask(|reply| Command::Mark(text, reply)).await
    }

    /// The preflight check.
    pub async fn check(&self) -> Result<Vec<CheckLine>, Refusal> {
        self.ask(Command::Check).await
    }

    /// Ends a running run with `cause` and its file finished, then the service. Does not wait.
    pub fn shutdown(&self, cause: &str) {
        // A service that has ended already needs no telling.
        let _ = self.commands.send(Command::Shutdown(cause.to_owned()));
    }

    /// Waits for the end of the service.
    pub fn join(&self) {
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the service's thread panicked");
        }
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<T>) -> Command) -> Result<T, Refusal> {
        let ended = || Refusal { error: "the service is ending".into() };
        let (reply, answer) = oneshot::channel();
        self.commands.send(command(reply)).map_err(|_| ended())?;
        answer.await.map_err(|_| ended())
    }
}

fn details(request: StartRequest, daemon: &DaemonConfig) -> Result<RunDetails, Refusal> {
    let duration = request
        .duration_s
        .map(|seconds| {
            Duration::try_from_secs_f64(seconds).ok().filter(|duration| *duration >= daemon.cycle_period()).ok_or(
                Refusal { error: format!("duration of {seconds} s: must be at least one cycle; leave it out to record until stopped") },
            )
        })
        .transpose()?;
    Ok(RunDetails {
        name: request.name.unwrap_or_default(),
        operator: request.operator,
        robot: request.robot,
        note: request.note,
        duration,
    })
}

/// Does what the machine decides.
struct Controller {
    settings: Arc<Settings>,
    machine: Machine,
    status: watch::Sender<Status>,
    bus: BusLink,
    /// The run that is asked for, until it is opened.
    wanted: RunDetails,
    run: Option<ActiveRun>,
    summary: Option<RunSummary>,
    last: Option<LastRun>,
    cycles_seen: u64,
    exit: bool,
}

/// The bus, or the attempt to bring it up.
enum BusLink {
    Down { retry_at: Instant, pause: Duration },
    Connecting { attempt: Receiver<Result<Session, RunError>>, pause: Duration },
    Up(Box<Session>),
}

impl Controller {
    fn new(settings: Arc<Settings>, status: watch::Sender<Status>) -> Self {
        Self {
            settings,
            machine: Machine::default(),
            status,
            bus: BusLink::Down { retry_at: Instant::now(), pause: RETRY_FIRST },
            wanted: RunDetails::default(),
            run: None,
            summary: None,
            last: None,
            cycles_seen: 0,
            exit: false,
        }
    }

    fn run(&mut self, commands: &Receiver<Command>) {
        while !self.exit {
            match commands.recv_timeout(POLL) {
                Ok(command) => self.obey(command),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    self.handle(Event::Shutdown("the service was dropped".into()));
                }
            }
            self.look_at_bus();
            self.look_at_run();
            self.publish();
        }
        if let BusLink::Up(session) = std::mem::replace(&mut self.bus, down(RETRY_FIRST)) {
            log_error(session.close());
        }
    }

    fn obey(&mut self, command: Command) {
        // Whoever asked may have gone away meanwhile; what was asked is done all the same.
        match command {
            Command::Start(details, named, reply) => {
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
                let answer = self.handle(Event::Stop(cause));
                self.publish();
                let _ = reply.send(answer.unwrap_or(Answer::Idle));
            }
            Command::Mark(text, reply) => {
                let marked = self.run.as_ref().filter(|run| !run.stop.is_stopped());
                marked.inspect(|run| run.mark(&text));
                let _ = reply.send(marked.and_then(|_| self.machine.run().map(str::to_owned)));
            }
            Command::Check(reply) => {
                let _ = reply.send(preflight::check(&self.seen(), &self.current_status()));
            }
            Command::Shutdown(cause) => {
                self.handle(Event::Shutdown(cause));
            }
        }
    }

    /// Lets the machine decide and does it; what that brings about is decided in turn.
    fn handle(&mut self, event: Event) -> Option<Answer> {
        let mut answer = None;
        for action in self.machine.handle(event) {
            match action {
                Action::Answer(given) => answer = answer.or(Some(given)),
                Action::Open(_) => {
                    if let Err(refusal) = self.open() {
                        answer = Some(Answer::Refused(refusal));
                    }
                }
                Action::End(cause) => {
                    self.run.iter().for_each(|run| run.stop.stop(&cause));
                }
                Action::Finished { run, cause } => self.finished(run, cause),
                Action::Connect => self.bus = down(RETRY_FIRST),
                Action::Recover => {
                    run::finish_leftovers(&self.settings.daemon.directory);
                    self.handle(Event::Recovered);
                }
                Action::Exit => self.exit = true,
            }
        }
        answer
    }

    fn open(&mut self) -> Result<(), String> {
        let BusLink::Up(session) = &self.bus else {
            let reason = "the bus is not in operation".to_owned();
            self.handle(Event::OpenFailed(reason.clone()));
            return Err(reason);
        };
        match session.begin(&self.wanted, &Stop::default()) {
            Ok(run) => {
                tracing::info!(run = self.wanted.name, "run begins");
                self.run = Some(run);
                self.cycles_seen = 0;
                self.handle(Event::Opened);
                Ok(())
            }
            Err(error) => {
                let reason = error.to_string();
                self.handle(Event::OpenFailed(reason.clone()));
                Err(reason)
            }
        }
    }

    fn finished(&mut self, name: String, cause: String) {
        let summary = self.summary.take();
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
            file: summary.as_ref().map(|summary| summary.path.display().to_string()),
            timing: summary.and_then(|summary| summary.timing),
        });
    }

    fn look_at_bus(&mut self) {
        match &self.bus {
            BusLink::Down { retry_at, pause } if Instant::now() >= *retry_at => {
                let (settings, pause) = (Arc::clone(&self.settings), *pause);
                let (result, attempt) = channel();
                let connect = move || {
                    // Nobody waits any more if the service has ended meanwhile.
                    let _ = result.send(run::open(&settings.bus, &settings.daemon, &settings.bar));
                };
                match thread::Builder::new().name("bus".into()).spawn(connect) {
                    Ok(_) => self.bus = BusLink::Connecting { attempt, pause },
                    Err(error) => self.bus_failed(&error.to_string(), pause),
                }
            }
            BusLink::Connecting { attempt, pause } => {
                if let Ok(outcome) = attempt.try_recv() {
                    let pause = *pause;
                    self.connected(outcome, pause);
                }
            }
            BusLink::Up(session) if !session.is_alive() => {
                if let BusLink::Up(session) = std::mem::replace(&mut self.bus, down(RETRY_FIRST)) {
                    log_error(session.close());
                }
                self.bus_failed("the cycle's thread ended; its cause is in the log", RETRY_FIRST);
            }
            _ => {}
        }
    }

    fn connected(&mut self, outcome: Result<Session, RunError>, pause: Duration) {
        match outcome {
            Ok(session) => {
                session.log();
                self.bus = BusLink::Up(Box::new(session));
                self.handle(Event::BusUp);
            }
            Err(error) => self.bus_failed(&error.to_string(), pause),
        }
    }

    fn bus_failed(&mut self, reason: &str, pause: Duration) {
        tracing::warn!("bus: {reason}; next attempt in {} s", pause.as_secs());
        self.handle(Event::BusDown(reason.to_owned()));
        self.bus = BusLink::Down { retry_at: Instant::now() + pause, pause: (pause * 2).min(RETRY_LONGEST) };
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
        let synced = run.progress.get();
        let age_ns = Clock::Real.now().ns_since(synced.at);
        if synced.cycles > self.cycles_seen {
            self.cycles_seen = synced.cycles;
            self.handle(Event::Synced);
        } else if age_ns > STALLED_SYNC_PERIODS * self.settings.daemon.sync_period().as_nanos() as i64 {
            self.handle(Event::Stalled);
        }
    }

    fn run_is_over(&mut self, run: ActiveRun) {
        let cause = run.stop.cause();
        match run.join() {
            Ok(summary) => {
                self.summary = Some(summary);
                self.handle(Event::Ended(cause));
                self.handle(Event::Closed);
            }
            Err(error) => {
                tracing::error!("recording failed: {error}");
                self.handle(Event::CloseFailed(error.to_string()));
            }
        }
    }

    /// A name of date and time that no file bears.
    fn free_name(&self) -> String {
        let base = chrono::Local::now().format("%Y-%m-%d_%H-%M-%S").to_string();
        let taken = |name: &str| {
            let directory = &self.settings.daemon.directory;
            ["mcap", "mcap.active"].iter().any(|ending| directory.join(format!("{name}.{ending}")).exists())
        };
        let numbered = (2..1000).map(|number| format!("{base}-{number}"));
        std::iter::once(base.clone()).chain(numbered).find(|name| !taken(name)).unwrap_or(base)
    }

    fn seen(&self) -> Seen {
        let daemon = &self.settings.daemon;
        Seen {
            state: self.machine.state().clone(),
            directory: daemon.directory.clone(),
            floor: DiskFloor::new(&daemon.directory, daemon.disk_floor_mb),
            realtime_problem: match &self.bus {
                BusLink::Up(session) => session.realtime_problem(),
                _ => None,
            },
        }
    }

    fn publish(&self) {
        self.status.send_replace(self.current_status());
    }

    fn current_status(&self) -> Status {
        let (state, reason) = match self.machine.state() {
            State::Fault { reason } => ("fault", Some(reason.clone())),
            State::Waiting => ("waiting", None),
            State::Opening { .. } => ("opening", None),
            State::Sampling { .. } => ("sampling", None),
            State::Writing { .. } => ("writing", None),
            State::Closing { cause, .. } => ("closing", Some(cause.clone())),
        };
        let floor = DiskFloor::new(&self.settings.daemon.directory, self.settings.daemon.disk_floor_mb);
        let usable = floor.usable_bytes().ok();
        let mut status = Status {
            state: state.into(),
            reason,
            run: self.run_status(),
            last: self.last.clone(),
            bus: bus_name(&self.settings.bus),
            disk_usable_mb: usable.map(|bytes| bytes.unwrap_or(0) / 1_000_000),
            ..Status::default()
        };
        if let BusLink::Up(session) = &self.bus {
            add_bus(&mut status, session);
        }
        status
    }

    fn run_status(&self) -> Option<RunStatus> {
        let (name, run) = (self.machine.run()?, self.run.as_ref()?);
        let synced = run.progress.get();
        Some(RunStatus {
            name: name.to_owned(),
            started: run.started,
            cycles: synced.cycles,
            cycles_valid: synced.cycles_valid,
            cycles_lost: synced.cycles_lost,
            bytes: synced.bytes,
            sync_age_ms: age_ms(synced.at),
            timing: run.progress.timing(),
        })
    }
}

fn add_bus(status: &mut Status, session: &Session) {
    let live = session.live();
    status.devices = session.devices().iter().map(|device| device.name.clone()).collect();
    status.sample_age_ms = age_ms(live.at());
    status.encoders = session
        .encoders()
        .iter()
        .zip(live.encoders())
        .map(|(info, encoder)| EncoderStatus {
            joint: info.joint,
            count: encoder.count,
            status: encoder.status,
            valid: encoder.valid,
        })
        .collect();
}

/// Zero stands for "never".
fn age_ms(at: MonoNs) -> Option<i64> {
    (at.0 != 0).then(|| Clock::Real.now().ns_since(at) / 1_000_000)
}

fn down(pause: Duration) -> BusLink {
    BusLink::Down { retry_at: Instant::now(), pause }
}

fn bus_name(bus: &BusChoice) -> String {
    match bus {
        BusChoice::Simulated => "simulated".into(),
        BusChoice::Replay(file) => format!("replay of {}", file.display()),
        BusChoice::Interface(name) => name.clone(),
    }
}

fn log_error(outcome: Result<(), RunError>) {
    if let Err(error) = outcome {
        tracing::error!("{error}");
    }
}
