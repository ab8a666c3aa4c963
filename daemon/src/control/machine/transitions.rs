//! Transitions of the state machine.

use super::{Action, Answer, Event, State};
use crate::problem::{Fact, Problem};
use crate::run::RunDetails;

/// State of the acquisition, with the faults that prevent a run.
#[derive(Debug, Clone)]
pub struct Machine {
    state: State,
    /// Why the bus is not in operation; `None` if it is.
    bus_fault: Option<Problem>,
    /// Why nothing can be recorded before the disk is ready.
    disk_fault: Option<Problem>,
    leaving: bool,
}

impl Default for Machine {
    fn default() -> Self {
        let problem = Problem::from(Fact::BusStarting {});
        Self {
            state: State::Fault { problem: problem.clone() },
            bus_fault: Some(problem),
            disk_fault: Some(Fact::DiskRecovering { since_s: None }.into()),
            leaving: false,
        }
    }
}

impl Machine {
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Why the bus is not in operation, also during a run.
    pub fn bus_fault(&self) -> Option<&Problem> {
        self.bus_fault.as_ref()
    }

    /// Name of the current run.
    pub fn run(&self) -> Option<&str> {
        match &self.state {
            State::Fault { .. } | State::Waiting | State::Homing => None,
            State::Opening { run, .. }
            | State::Sampling { run }
            | State::Writing { run }
            | State::Closing { run, .. } => Some(run),
        }
    }

    /// Handles one event; the actions are to be executed in order. An event that has no meaning in the current state changes
    /// nothing.
    pub fn handle(&mut self, event: Event) -> Vec<Action> {
        match event {
            Event::BusUp => self.bus_is(None),
            Event::BusDown(problem) => self.bus_is(Some(problem)),
            Event::BusTroubled(problem) => self.bus_troubled(problem),
            Event::Home => self.home(),
            Event::HomingOver => self.homing_over(),
            Event::Start { run, named } => self.start(run, named),
            Event::Opened => self.opened(),
            Event::OpenFailed(problem) => self.open_failed(problem),
            Event::Synced => self.progress(true),
            Event::Stalled => self.progress(false),
            Event::Stop(cause) => self.stop(&cause),
            Event::Ended(cause) => self.ended(&cause),
            Event::Closed => self.closed(None),
            Event::CloseFailed(problem) => self.closed(Some(problem)),
            Event::Recovered => self.recovered(),
            Event::Shutdown(cause) => self.shutdown(&cause),
        }
    }

    fn bus_is(&mut self, fault: Option<Problem>) -> Vec<Action> {
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
        self.rest();
        actions
    }

    /// Nothing can begin; a current run or homing continues.
    fn bus_troubled(&mut self, problem: Problem) -> Vec<Action> {
        self.bus_fault = Some(problem);
        self.rest();
        Vec::new()
    }

    fn home(&mut self) -> Vec<Action> {
        let answer = match &self.state {
            _ if self.leaving => refused(Fact::ServiceEnding {}),
            State::Fault { problem } => Answer::Refused(problem.clone()),
            State::Homing => Answer::Homing,
            State::Opening { run, .. }
            | State::Sampling { run }
            | State::Writing { run }
            | State::Closing { run, .. } => Answer::Busy(run.clone()),
            State::Waiting => {
                self.state = State::Homing;
                return vec![Action::BeginHoming, Action::Answer(Answer::Beginning)];
            }
        };
        vec![Action::Answer(answer)]
    }

    fn end_homing(&mut self, cause: &str) -> Option<Action> {
        (self.state == State::Homing).then(|| Action::EndHoming(cause.to_owned()))
    }

    fn homing_over(&mut self) -> Vec<Action> {
        if self.state != State::Homing {
            return Vec::new();
        }
        self.state = State::Waiting;
        self.rest_or_exit().into_iter().collect()
    }

    fn start(&mut self, run: Box<RunDetails>, named: bool) -> Vec<Action> {
        let answer = match &self.state {
            _ if self.leaving => refused(Fact::ServiceEnding {}),
            State::Fault { problem } => Answer::Refused(problem.clone()),
            State::Homing => refused(Fact::HomingActive {}),
            State::Closing { run, .. } => Answer::Busy(run.clone()),
            State::Opening { run: running, .. }
            | State::Sampling { run: running }
            | State::Writing { run: running } => {
                if !named || *running == run.name {
                    Answer::Running(running.clone())
                } else {
                    Answer::Busy(running.clone())
                }
            }
            State::Waiting => {
                self.state = State::Opening { run: run.name.clone(), stop: None };
                return vec![Action::Open(run), Action::Answer(Answer::Beginning)];
            }
        };
        vec![Action::Answer(answer)]
    }

    fn opened(&mut self) -> Vec<Action> {
        let State::Opening { run, stop } = &mut self.state else { return Vec::new() };
        let (run, stop) = (std::mem::take(run), stop.take());
        self.state = State::Sampling { run };
        stop.map_or_else(Vec::new, |cause| self.end_run(&cause))
    }

    fn open_failed(&mut self, problem: Problem) -> Vec<Action> {
        let State::Opening { run, .. } = &mut self.state else { return Vec::new() };
        let run = std::mem::take(run);
        self.state = State::Waiting;
        let mut actions = vec![Action::NotBegun { run, problem }];
        actions.extend(self.rest_or_exit());
        actions
    }

    fn progress(&mut self, on_disk: bool) -> Vec<Action> {
        if let State::Sampling { run } | State::Writing { run } = &mut self.state {
            let run = std::mem::take(run);
            self.state = if on_disk { State::Writing { run } } else { State::Sampling { run } };
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

    /// The cycles have ended already, so no action follows.
    fn ended(&mut self, cause: &str) -> Vec<Action> {
        self.end_run(cause);
        Vec::new()
    }

    /// The first cause is kept.
    fn end_run(&mut self, cause: &str) -> Vec<Action> {
        match &mut self.state {
            State::Opening { stop: Some(_), .. } => Vec::new(),
            State::Opening { stop, .. } => {
                *stop = Some(cause.to_owned());
                vec![Action::End(cause.to_owned())]
            }
            State::Sampling { run } | State::Writing { run } => {
                let run = std::mem::take(run);
                self.state = State::Closing { run, cause: cause.to_owned() };
                vec![Action::End(cause.to_owned())]
            }
            State::Closing { .. } | State::Fault { .. } | State::Waiting | State::Homing => Vec::new(),
        }
    }

    fn closed(&mut self, failure: Option<Problem>) -> Vec<Action> {
        // A recorder that fails ends its run without a request.
        let reason = failure.as_ref().map(|problem| problem.text.clone());
        if let Some(reason) = &reason {
            self.end_run(reason);
        }
        let State::Closing { run, cause } = &mut self.state else { return Vec::new() };
        let (run, cause) = (std::mem::take(run), std::mem::take(cause));
        self.state = State::Waiting;
        let mut actions = Vec::new();
        let cause = match &reason {
            Some(reason) if *reason != cause => format!("{cause}; {reason}"),
            _ => cause,
        };
        actions.push(Action::Finished { run, cause });
        if failure.is_some() {
            self.disk_fault = failure;
            actions.push(Action::Recover);
        }
        actions.extend(self.rest_or_exit());
        actions
    }

    fn recovered(&mut self) -> Vec<Action> {
        self.disk_fault = None;
        self.rest();
        Vec::new()
    }

    fn shutdown(&mut self, cause: &str) -> Vec<Action> {
        self.leaving = true;
        let mut actions = self.end_run(cause);
        actions.extend(self.end_homing(cause));
        actions.extend(self.rest_or_exit());
        actions
    }

    fn is_resting(&self) -> bool {
        matches!(self.state, State::Fault { .. } | State::Waiting)
    }

    /// Between runs a fault of bus or disk decides the state.
    fn rest(&mut self) {
        if self.is_resting() {
            let fault = self.bus_fault.as_ref().or(self.disk_fault.as_ref());
            self.state = fault.map_or(State::Waiting, |problem| State::Fault { problem: problem.clone() });
        }
    }

    fn rest_or_exit(&mut self) -> Option<Action> {
        self.rest();
        (self.leaving && self.is_resting()).then_some(Action::Exit)
    }
}

fn refused(fact: Fact) -> Answer {
    Answer::Refused(fact.into())
}
