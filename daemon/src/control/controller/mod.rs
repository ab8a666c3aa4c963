//! Executes the actions that the [`machine`](crate::control::machine) decides: it brings the bus into operation, begins and
//! ends runs and homings, and replies to clients.
//!
//! Each step first executes the requests of clients. It then polls the bus, the homing, the run and the tasks that use the
//! disk. Each change is an event for the machine, which returns actions. At the end the step publishes the status, which
//! `view` computes. No step waits for the disk. The thread that calls [`Controller::poll`] is in `service`.

mod bus_link;
pub mod homing;
mod marks;
pub mod preflight;
mod problem_log;
mod view;

use std::sync::Arc;
use std::time::Duration;

use shared::time::MonoNs;
use tokio::sync::{oneshot, watch};

use crate::claim::Claim;
use crate::control::live_tap::LiveTap;
use crate::control::machine::{Action, Answer, MachineEvent, State, StateMachine};
use crate::control::recordings::runs;
use crate::control::recordings::verdict::Verdict;
use crate::control::settings::{Connect, Settings};
use crate::control::status::{LastRun, ServiceState, Status, Totals};
use crate::problem::{Fact, Problem};
use crate::record::{RunSummary, Snapshot};
use crate::run::{self, ActiveRun, DISK_WAIT_AT_END, RunDetails, RunError, Stop, Storage};
use crate::scheduler::{Pending, Scheduler};
use bus_link::BusLink;
use homing::Homing;
use marks::Marks;
use problem_log::ProblemLog;

/// Time between two steps when no command arrives.
const POLL: Duration = Duration::from_millis(100);
/// Time between two steps while a client waits for the file of a run, or while the bus is closed at the end of the service.
const OPENING_POLL: Duration = Duration::from_millis(5);
/// Cause of a run's end if the control thread panics.
const CONTROL_DIED: &str = "the control thread has ended; the log shows why";
/// If no cycle has reached the disk for this long, the state falls back from writing to sampling \[sync periods\].
const STALLED_SYNC_PERIODS: u32 = 3;

/// A request to the service, executed at the beginning of a step.
pub(super) type Command = Box<dyn FnOnce(&mut Controller) + Send>;

/// Counts of the session and the run that are already included in [`Totals`].
#[derive(Debug, Default)]
struct Counted {
    /// Counts of the session: all cycles, valid cycles and late cycles.
    cycles: [u64; 3],
    /// Number of lost cycles of the run.
    lost: u64,
}

/// Executes what the machine decides.
pub(super) struct Controller {
    settings: Arc<Settings>,
    machine: StateMachine,
    status: watch::Sender<Status>,
    bus: BusLink,
    homing: Option<Homing>,
    run: Option<ActiveRun>,
    /// Requested duration of the run; `None` if it lasts until it is stopped.
    duration: Option<Duration>,
    marks: Marks,
    /// Clients that wait until the file of the run has been created. Each has the reply that it receives on success.
    start_clients: Vec<(oneshot::Sender<Answer>, Answer)>,
    /// Clients that wait for the end of the run.
    stop_clients: Vec<oneshot::Sender<LastRun>>,
    /// Task that claims the directory of the recordings and recovers earlier runs.
    preparing: Option<Pending<Result<Option<Claim>, RunError>>>,
    claim: Option<Claim>,
    /// Summary of the run that has ended, until the machine reports its end.
    summary: Option<RunSummary>,
    /// Why the file of the ending run could not be finished regularly.
    failure: Option<String>,
    last: Option<LastRun>,
    /// Task that reads the grade of the last run.
    grading: Option<Pending<Option<Verdict>>>,
    runs_over: u64,
    storage: Storage,
    /// Cycles of the run that were safe on disk at the last poll.
    cycles_synced: u64,
    problems: ProblemLog,
    totals: Totals,
    counted: Counted,
    /// Set by the handles of the service when they request its end.
    ending: Stop,
    /// Whether the machine permits the end of the service.
    may_exit: bool,
    /// Time at which the end of the service was requested.
    leaving_since: Option<MonoNs>,
    scheduler: Arc<dyn Scheduler>,
    /// Time of this step.
    now: MonoNs,
    /// Result of the service. It is set once the service ends and its bus is being closed.
    outcome: Option<Result<(), RunError>>,
}

impl Controller {
    pub fn new(
        settings: Arc<Settings>,
        connect: Arc<Connect>,
        storage: Storage,
        status: watch::Sender<Status>,
        ending: Stop,
        scheduler: Arc<dyn Scheduler>,
    ) -> Self {
        Self {
            now: scheduler.clock().now(),
            outcome: None,
            ending,
            settings,
            machine: StateMachine::default(),
            status,
            bus: BusLink::new(connect, Arc::clone(&scheduler)),
            scheduler,
            homing: None,
            run: None,
            duration: None,
            marks: Marks::default(),
            start_clients: Vec::new(),
            stop_clients: Vec::new(),
            preparing: None,
            claim: None,
            summary: None,
            failure: None,
            last: None,
            grading: None,
            runs_over: 0,
            storage,
            cycles_synced: 0,
            problems: ProblemLog::default(),
            totals: Totals::default(),
            counted: Counted::default(),
            may_exit: false,
            leaving_since: None,
        }
    }

    /// Executes the commands and polls bus, disk, homing and run. Returns the time until the next step. Returns `None` once
    /// the service has ended, on request or because the directory of the recordings cannot be claimed.
    pub fn poll(&mut self, now: MonoNs, commands: Vec<Command>) -> Option<Duration> {
        self.now = now;
        if self.outcome.is_some() {
            return (!self.bus.is_closed()).then_some(OPENING_POLL);
        }
        commands.into_iter().for_each(|command| command(self));
        if self.ending.is_stopped() && self.leaving_since.is_none() {
            self.shutdown(&self.ending.cause());
        }
        if let Err(error) = self.poll_preparation() {
            return self.end_service(Err(error));
        }
        self.poll_bus();
        self.poll_homing();
        self.poll_run();
        self.poll_grading();
        self.update_totals();
        self.log_and_publish();
        if self.is_over() {
            return self.end_service(Ok(()));
        }
        Some(if self.is_opening() { OPENING_POLL } else { POLL })
    }

    fn end_service(&mut self, outcome: Result<(), RunError>) -> Option<Duration> {
        self.outcome = Some(outcome);
        self.bus.close();
        Some(Duration::ZERO)
    }

    /// Result of the service after its end.
    pub fn into_outcome(self) -> Result<(), RunError> {
        self.outcome.unwrap_or(Ok(()))
    }

    /// Requests the end of the service after its last handle was dropped.
    pub fn dropped(&self) {
        self.ending.stop("the service was dropped");
    }

    /// Whether the service can end. It never ends before the file of a run is finished. It waits at most
    /// [`DISK_WAIT_AT_END`] for the creation of a file, the recovery of earlier runs and the saving of reference marks. The
    /// next service repeats the recovery.
    fn is_over(&self) -> bool {
        let Some(since) = self.leaving_since else { return false };
        let saving_since = self.homing.as_ref().and_then(Homing::saving_since);
        if self.preparing.is_none() && !self.is_opening() && saving_since.is_none() {
            return self.may_exit;
        }
        let has_waited_enough = self.now.ns_since(since) > DISK_WAIT_AT_END.as_nanos() as i64;
        if has_waited_enough {
            let problems = self.disk_problems();
            tracing::warn!("the disk is not waited for: {}", Problem::line(&problems));
        }
        has_waited_enough
    }

    fn is_opening(&self) -> bool {
        self.machine.state() == State::Opening
    }

    fn shutdown(&mut self, cause: &str) {
        self.leaving_since.get_or_insert(self.now);
        self.handle(MachineEvent::Shutdown(cause.to_owned()));
    }

    /// Called after a panic of this thread. Makes no further decisions, but finishes the file of the run with the cause.
    pub fn abandon(mut self) {
        self.status.send_modify(|status| {
            let problem = Problem::from(Fact::ThreadEnded { thread: "control".into() });
            (status.state, status.severity) = (ServiceState::Fault, problem.severity);
            (status.reason, status.problems) = (Some(CONTROL_DIED.into()), vec![problem]);
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

    /// Begins a run. `named` is true if a person chose the name. The reply follows once the file has
    /// been created, or the run is refused.
    pub fn start(&mut self, details: Box<RunDetails>, named: bool) -> oneshot::Receiver<Answer> {
        // Poll the bus first, because the cable may have been pulled since the last poll.
        self.poll_bus();
        let answer = self.handle(MachineEvent::Start { run: details, named }).unwrap_or(Answer::Idle);
        let (reply, begun) = oneshot::channel();
        if self.is_opening() && matches!(answer, Answer::Beginning | Answer::Running(_)) {
            self.start_clients.push((reply, answer));
        } else {
            let _ = reply.send(answer);
        }
        begun
    }

    /// Ends the run or the homing. The receiver returns the run once it is over.
    pub fn stop(&mut self, cause: String) -> (Answer, oneshot::Receiver<LastRun>) {
        let answer = self.handle(MachineEvent::Stop(cause)).unwrap_or(Answer::Idle);
        let (over, last) = oneshot::channel();
        if matches!(answer, Answer::Stopping(_)) {
            self.stop_clients.push(over);
        }
        (answer, last)
    }

    /// Begins a homing, unless a run or a fault prevents it.
    pub fn home(&mut self) -> Answer {
        self.poll_bus();
        self.handle(MachineEvent::Home).unwrap_or(Answer::Idle)
    }

    /// Passes an event to the machine and executes its actions. If an action causes another event, that
    /// event is handled, too.
    fn handle(&mut self, event: MachineEvent) -> Option<Answer> {
        let mut answer = None;
        for action in self.machine.handle(event) {
            match action {
                Action::Answer(given) => answer = answer.or(Some(given)),
                Action::Open(run) => {
                    if let Err(problem) = self.begin_run(&run) {
                        self.handle(MachineEvent::OpenFailed(problem.clone()));
                        answer = Some(Answer::Refused(problem));
                    }
                }
                Action::End(cause) => {
                    if let Some(run) = &self.run {
                        run.stop.stop(&cause);
                    }
                }
                Action::Finished { run, cause } => self.run_finished(run, cause),
                Action::NotBegun { run, problem } => {
                    let cause = format!("it could not begin: {problem}");
                    tracing::info!(run, "{cause}");
                    let error = Some(cause.clone());
                    self.answer_stops(&LastRun { name: run, cause, error, ..LastRun::default() });
                }
                // The link connects again on its own when it is down.
                Action::Connect => {}
                Action::BeginHoming => match self.bus.session() {
                    Some(session) => self.homing = Some(Homing::begin(session)),
                    None => {
                        self.handle(MachineEvent::HomingOver);
                        answer = Some(Answer::Refused(self.no_bus()));
                    }
                },
                Action::EndHoming(cause) => {
                    if let Some(homing) = &self.homing {
                        homing.stop(&cause);
                    }
                }
                Action::Recover => self.prepare_storage(),
                Action::Exit => self.may_exit = true,
            }
        }
        answer
    }

    /// Puts a marker into the run, with this text or else a number. Returns the run and the text, or `None` without a run.
    pub fn mark(&mut self, text: Option<String>, at: MonoNs) -> Result<Option<(String, String)>, String> {
        let current_run = self.run.as_ref().filter(|run| !run.stop.is_stopped());
        let Some((run, name)) = current_run.zip(self.machine.run()) else { return Ok(None) };
        let (is_numbered, text) = (text.is_none(), self.marks.text(text));
        if !run.mark(at, text.clone()) {
            return Err("the disk takes no more markers: `ballbard status` shows its state".into());
        }
        self.marks.add(at, text.clone(), is_numbered);
        Ok(Some((name.to_owned(), text)))
    }

    /// Why no run or homing can begin although the machine permitted it.
    fn no_bus(&self) -> Problem {
        self.machine.bus_fault().cloned().unwrap_or_else(|| Fact::BusStarting {}.into())
    }

    fn begin_run(&mut self, details: &RunDetails) -> Result<(), Problem> {
        let session = self.bus.session().ok_or_else(|| self.no_bus())?;
        let tap = self.settings.live_tap.as_ref().map(LiveTap::writer_end);
        self.run = Some(session.begin(details, tap).map_err(|error| error.problem())?);
        self.duration = details.duration;
        self.marks = Marks::new(self.now);
        (self.cycles_synced, self.counted.lost) = (0, 0);
        Ok(())
    }

    /// Replies to the clients that requested the run, when its file has been created or could not be created.
    fn answer_starts(&mut self, outcome: Result<(), Problem>) {
        self.handle(match &outcome {
            Ok(()) => MachineEvent::Opened,
            Err(problem) => MachineEvent::OpenFailed(problem.clone()),
        });
        self.publish();
        for (reply, answer) in std::mem::take(&mut self.start_clients) {
            let refused = outcome.as_ref().err().map(|problem| Answer::Refused(problem.clone()));
            let _ = reply.send(refused.unwrap_or(answer));
        }
    }

    /// Starts a task that claims the directory of the recordings, unless it is claimed, and recovers the
    /// files of earlier runs.
    pub fn prepare_storage(&mut self) {
        let (storage, is_claimed) = (self.storage.clone(), self.claim.is_some());
        self.preparing = Some(Pending::start(&*self.scheduler, "leftovers", move || {
            let claimed = if is_claimed { Ok(None) } else { run::claim_directory(&storage) };
            if claimed.is_ok() {
                run::finish_leftovers(&storage);
            }
            claimed
        }));
    }

    fn poll_preparation(&mut self) -> Result<(), RunError> {
        let Some(outcome) = self.preparing.as_ref().and_then(Pending::poll) else { return Ok(()) };
        self.preparing = None;
        // If the task died, the files that it did not recover still exist, and a later preparation recovers them.
        let claim = outcome.unwrap_or(Ok(None))?;
        self.claim = self.claim.take().or(claim);
        self.handle(MachineEvent::Recovered);
        Ok(())
    }

    /// Publishes a run that is over as the last run.
    fn run_finished(&mut self, name: String, cause: String) {
        let summary = self.summary.take();
        let error = self.failure.take().or_else(|| summary.is_none().then(|| cause.clone()));
        // All clients get the same cause as the file.
        let cause = match &summary {
            Some(summary) if error.is_none() => summary.cause.clone(),
            _ => cause,
        };
        self.runs_over += 1;
        tracing::info!(
            run = name,
            cause,
            cycles = summary.as_ref().map(|summary| summary.cycles),
            "run is over"
        );
        let last = match summary {
            Some(summary) => LastRun { cause, error, ..LastRun::from_summary(name, summary) },
            None => LastRun { name, cause, error, ..LastRun::default() },
        };
        self.answer_stops(&last);
        self.grade(&last);
        self.last = Some(last);
    }

    /// Starts a task that reads the grade of a run from its file, as the list of runs does.
    fn grade(&mut self, last: &LastRun) {
        // A task that reads the grade of an earlier run is dropped, even if this run has no file.
        self.grading = last.file.clone().map(|file| {
            let (disk, name) = (self.storage.disk(), last.name.clone());
            let read = move || runs::finished(&*disk, name, file.into()).verdict;
            Pending::start(&*self.scheduler, "grade", read)
        });
    }

    fn poll_grading(&mut self) {
        let verdict = self.grading.as_ref().and_then(Pending::poll);
        if let (Some(Ok(verdict)), Some(last)) = (verdict, &mut self.last) {
            last.verdict = verdict;
        }
    }

    /// Replies to the clients that requested the end of the run.
    fn answer_stops(&mut self, run: &LastRun) {
        for client in self.stop_clients.drain(..) {
            let _ = client.send(run.clone());
        }
    }

    fn poll_bus(&mut self) {
        if let Some(event) = self.bus.poll(self.now) {
            self.handle(event);
        }
    }

    fn poll_homing(&mut self) {
        let Some(homing) = &mut self.homing else { return };
        if homing.poll(&self.settings.marks_file) {
            self.handle(MachineEvent::HomingOver);
        }
    }

    fn poll_run(&mut self) {
        // The outcome must be read before the progress. Otherwise a run could create its file and end between the two
        // readings, and the machine would wait for the file for ever.
        let outcome = self.run.as_ref().and_then(ActiveRun::outcome);
        if self.is_opening() && self.run.as_ref().is_some_and(|run| run.progress.is_open()) {
            tracing::info!(run = self.machine.run(), "run begins");
            self.answer_starts(Ok(()));
        }
        if let Some(outcome) = outcome {
            self.run_is_over(outcome);
            return;
        }
        let Some(run) = &self.run else { return };
        if run.stop.is_stopped() {
            let cause = run.stop.cause();
            self.handle(MachineEvent::Ended(cause));
            return;
        }
        let Snapshot { synced, sync_age, .. } = run.progress.get();
        let stalled_after = self.settings.daemon.sync_period() * STALLED_SYNC_PERIODS;
        if synced.cycles > self.cycles_synced {
            self.cycles_synced = synced.cycles;
            self.handle(MachineEvent::Synced);
        } else if sync_age.is_none_or(|age| age > stalled_after) {
            self.handle(MachineEvent::Stalled);
        }
    }

    /// Passes the outcome of the recorder to the machine. The machine then returns the action that calls
    /// [`Self::run_finished`].
    fn run_is_over(&mut self, outcome: Result<RunSummary, RunError>) {
        if let Some(run) = self.run.take() {
            self.count_lost(run.progress.get().lost);
        }
        match outcome {
            Ok(summary) => {
                self.handle(MachineEvent::Ended(summary.cause.clone()));
                self.summary = Some(summary);
                self.handle(MachineEvent::Closed);
            }
            Err(error) if self.is_opening() => self.answer_starts(Err(error.problem())),
            Err(error) => {
                tracing::error!("recording failed: {error}");
                let problem = error.problem();
                if let RunError::Broken { content, .. } = error {
                    self.summary = content.map(|summary| *summary);
                }
                self.failure = Some(problem.text.clone());
                self.handle(MachineEvent::CloseFailed(problem));
            }
        }
    }

    /// Adds the counts of session and run since the last step.
    fn update_totals(&mut self) {
        if let Some(session) = self.bus.session() {
            let counts = session.live.totals();
            let before = std::mem::replace(&mut self.counted.cycles, counts);
            // A new session counts from zero. If the count has decreased, all of it is new.
            let [cycles, valid, late] = std::array::from_fn(|index| {
                counts[index].checked_sub(before[index]).unwrap_or(counts[index])
            });
            self.totals.cycles += cycles;
            self.totals.cycles_valid += valid;
            self.totals.cycles_late += late;
        }
        if let Some(lost) = self.run.as_ref().map(|run| run.progress.get().lost) {
            self.count_lost(lost);
        }
    }

    /// Logs problems that began or ended, and publishes the same status. A client therefore never sees the end of a problem
    /// before it is logged.
    fn log_and_publish(&mut self) {
        let mut status = self.status();
        self.problems.update(self.now, status.problems.iter().chain(&status.bad_cables));
        self.totals.problems.clone_from(self.problems.began());
        status.totals.problems.clone_from(self.problems.began());
        self.status.send_replace(status);
    }

    fn count_lost(&mut self, lost: u64) {
        self.totals.cycles_lost += lost.saturating_sub(self.counted.lost);
        self.counted.lost = lost;
    }

    pub fn publish(&self) {
        self.status.send_replace(self.status());
    }
}
