//! Transitions of the state machine. Each event has one method, which changes the state and returns the
//! actions for the controller.

use super::{Action, Answer, MachineEvent, State};
use crate::problem::{Fact, Problem};
use crate::run::RunDetails;

/// State of the acquisition, with the faults that prevent a run.
#[derive(Debug, Clone)]
pub struct StateMachine {
    state: State,
    /// The current run. Present in the states `Opening`, `Sampling`, `Writing` and `Closing`.
    run: Option<CurrentRun>,
    /// Why the bus is not in operation; `None` if it is.
    bus_fault: Option<Problem>,
    /// Why nothing can be recorded to the disk; `None` if the disk is ready.
    disk_fault: Option<Problem>,
    /// The end of the service is requested.
    leaving: bool,
}

/// Name and end of the current run.
#[derive(Debug, Clone)]
struct CurrentRun {
    name: String,
    /// Cause of the end of the run, once the end is requested.
    cause: Option<String>,
}

impl Default for StateMachine {
    fn default() -> Self {
        Self {
            state: State::Fault,
            run: None,
            bus_fault: Some(Fact::BusStarting {}.into()),
            disk_fault: Some(Fact::DiskRecovering { since_s: None }.into()),
            leaving: false,
        }
    }
}

impl StateMachine {
    pub fn state(&self) -> State {
        self.state
    }

    /// Why the bus is not in operation. It can be present during a run, too.
    pub fn bus_fault(&self) -> Option<&Problem> {
        self.bus_fault.as_ref()
    }

    /// Fault of the bus or the disk that prevents a run; `None` if there is no such fault.
    pub fn fault(&self) -> Option<&Problem> {
        self.bus_fault.as_ref().or(self.disk_fault.as_ref())
    }

    /// Name of the current run.
    pub fn run(&self) -> Option<&str> {
        self.run.as_ref().map(|run| run.name.as_str())
    }

    /// Cause of the end of the run, while the file of the run is being finished.
    pub fn cause(&self) -> Option<&str> {
        self.run.as_ref().filter(|_| self.state == State::Closing)?.cause.as_deref()
    }

    /// Handles one event. The returned actions must be executed in order. An event that has no meaning
    /// in the current state changes nothing.
    pub fn handle(&mut self, event: MachineEvent) -> Vec<Action> {
        match event {
            MachineEvent::BusUp => self.set_bus_fault(None),
            MachineEvent::BusDown(problem) => self.set_bus_fault(Some(problem)),
            MachineEvent::BusTroubled(problem) => self.bus_troubled(problem),
            MachineEvent::Home => self.home(),
            MachineEvent::HomingOver => self.homing_over(),
            MachineEvent::Start { run, named } => self.start(run, named),
            MachineEvent::Opened => self.opened(),
            MachineEvent::OpenFailed(problem) => self.open_failed(problem),
            MachineEvent::Synced => self.set_on_disk(true),
            MachineEvent::Stalled => self.set_on_disk(false),
            MachineEvent::Stop(cause) => self.stop(&cause),
            MachineEvent::Ended(cause) => self.ended(&cause),
            MachineEvent::Closed => self.closed(None),
            MachineEvent::CloseFailed(problem) => self.closed(Some(problem)),
            MachineEvent::Recovered => self.recovered(),
            MachineEvent::Shutdown(cause) => self.shutdown(&cause),
        }
    }

    fn set_bus_fault(&mut self, fault: Option<Problem>) -> Vec<Action> {
        let mut actions = Vec::new();
        if let Some(problem) = &fault {
            if !self.leaving {
                actions.push(Action::Connect);
            }
            let cause = format!("the bus failed: {problem}");
            actions.extend(self.end_homing(&cause));
            actions.extend(self.end_run(&cause));
        }
        self.bus_fault = fault;
        self.set_idle_state();
        actions
    }

    /// Stores the fault, so that nothing new can begin. A current run or homing continues.
    fn bus_troubled(&mut self, problem: Problem) -> Vec<Action> {
        self.bus_fault = Some(problem);
        self.set_idle_state();
        Vec::new()
    }

    fn home(&mut self) -> Vec<Action> {
        let answer = match self.state {
            _ if self.leaving => refused(Fact::ServiceEnding {}),
            State::Homing => Answer::Homing,
            State::Waiting => {
                self.state = State::Homing;
                return vec![Action::BeginHoming, Action::Answer(Answer::Beginning)];
            }
            _ => self.occupied(Answer::Busy),
        };
        vec![Action::Answer(answer)]
    }

    /// Answer to a start or a homing that is impossible. If a run prevents it, the answer is `answer_for_run` with the name
    /// of the run. If a fault prevents it, the request is refused.
    fn occupied(&self, answer_for_run: fn(String) -> Answer) -> Answer {
        match (self.run(), self.fault()) {
            (Some(run), _) => answer_for_run(run.to_owned()),
            (None, Some(problem)) => Answer::Refused(problem.clone()),
            (None, None) => Answer::Idle,
        }
    }

    fn end_homing(&mut self, cause: &str) -> Option<Action> {
        (self.state == State::Homing).then(|| Action::EndHoming(cause.to_owned()))
    }

    fn homing_over(&mut self) -> Vec<Action> {
        if self.state != State::Homing {
            return Vec::new();
        }
        self.state = State::Waiting;
        self.idle_or_exit().into_iter().collect()
    }

    fn start(&mut self, details: Box<RunDetails>, named: bool) -> Vec<Action> {
        let is_wanted = self.run().is_some_and(|run| !named || run == details.name);
        let answer = match self.state {
            _ if self.leaving => refused(Fact::ServiceEnding {}),
            State::Homing => refused(Fact::HomingActive {}),
            State::Waiting => {
                self.state = State::Opening;
                self.run = Some(CurrentRun { name: details.name.clone(), cause: None });
                return vec![Action::Open(details), Action::Answer(Answer::Beginning)];
            }
            State::Opening | State::Sampling | State::Writing if is_wanted => self.occupied(Answer::Running),
            _ => self.occupied(Answer::Busy),
        };
        vec![Action::Answer(answer)]
    }

    fn opened(&mut self) -> Vec<Action> {
        if self.state == State::Opening {
            let is_ending = self.run.as_ref().is_some_and(|run| run.cause.is_some());
            self.state = if is_ending { State::Closing } else { State::Sampling };
        }
        Vec::new()
    }

    fn open_failed(&mut self, problem: Problem) -> Vec<Action> {
        let Some(CurrentRun { name: run, .. }) = self.run.take_if(|_| self.state == State::Opening) else {
            return Vec::new();
        };
        self.state = State::Waiting;
        let mut actions = vec![Action::NotBegun { run, problem }];
        actions.extend(self.idle_or_exit());
        actions
    }

    fn set_on_disk(&mut self, on_disk: bool) -> Vec<Action> {
        if matches!(self.state, State::Sampling | State::Writing) {
            self.state = if on_disk { State::Writing } else { State::Sampling };
        }
        Vec::new()
    }

    fn stop(&mut self, cause: &str) -> Vec<Action> {
        let answer = match self.run() {
            Some(run) => Answer::Stopping(run.to_owned()),
            None if self.state == State::Homing => Answer::Homing,
            None => Answer::Idle,
        };
        let mut actions = self.end_run(cause);
        actions.extend(self.end_homing(cause));
        actions.push(Action::Answer(answer));
        actions
    }

    /// Records that the cycles of the run have ended. Returns no action, because the cycles need not be ended again.
    fn ended(&mut self, cause: &str) -> Vec<Action> {
        self.end_run(cause);
        Vec::new()
    }

    /// Ends the run with this cause. If the end was requested before, the first cause is kept. A run whose file is still
    /// being created enters the state closing once the file has been created.
    fn end_run(&mut self, cause: &str) -> Vec<Action> {
        let Some(run) = self.run.as_mut().filter(|run| run.cause.is_none()) else { return Vec::new() };
        run.cause = Some(cause.to_owned());
        if self.state != State::Opening {
            self.state = State::Closing;
        }
        vec![Action::End(cause.to_owned())]
    }

    fn closed(&mut self, failure: Option<Problem>) -> Vec<Action> {
        // If the recorder fails, its run ends without a request.
        if let Some(problem) = &failure {
            self.end_run(&problem.text);
        }
        let Some(CurrentRun { name: run, cause }) = self.run.take_if(|_| self.state == State::Closing) else {
            return Vec::new();
        };
        self.state = State::Waiting;
        let mut cause = cause.unwrap_or_default();
        if let Some(problem) = failure.as_ref().filter(|problem| problem.text != cause) {
            cause = format!("{cause}; {}", problem.text);
        }
        let mut actions = vec![Action::Finished { run, cause }];
        if failure.is_some() {
            self.disk_fault = failure;
            actions.push(Action::Recover);
        }
        actions.extend(self.idle_or_exit());
        actions
    }

    fn recovered(&mut self) -> Vec<Action> {
        self.disk_fault = None;
        self.set_idle_state();
        Vec::new()
    }

    fn shutdown(&mut self, cause: &str) -> Vec<Action> {
        self.leaving = true;
        let mut actions = self.end_run(cause);
        actions.extend(self.end_homing(cause));
        actions.extend(self.idle_or_exit());
        actions
    }

    fn is_idle(&self) -> bool {
        matches!(self.state, State::Fault | State::Waiting)
    }

    /// Sets the state when nothing is active: fault if bus or disk have a fault, otherwise waiting.
    fn set_idle_state(&mut self) {
        if self.is_idle() {
            self.state = if self.fault().is_some() { State::Fault } else { State::Waiting };
        }
    }

    /// Exits if the end of the service was requested and nothing is active any more.
    fn idle_or_exit(&mut self) -> Option<Action> {
        self.set_idle_state();
        (self.leaving && self.is_idle()).then_some(Action::Exit)
    }
}

fn refused(fact: Fact) -> Answer {
    Answer::Refused(fact.into())
}
