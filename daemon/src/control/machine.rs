//! The states of the acquisition, as a pure function of events.
//!
//! The thesis' five states (waiting, opening, sampling, writing, closing) and a sixth for what it had no answer to.
//! A run that was opened leaves exactly one [`Action::Finished`] with its cause, whatever happens meanwhile.

/// Where the acquisition is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum State {
    /// Nothing can be recorded, and why; it is being worked on.
    Fault {
        /// What is wrong and what to do.
        reason: String,
    },
    /// The bus is in operation, no run goes on.
    Waiting,
    /// A run's file is being created.
    Opening {
        /// Its name.
        run: String,
        /// Somebody has asked already that it end, and why.
        stop: Option<String>,
    },
    /// Cycles are being sampled, but none of the last seconds has reached the disk.
    Sampling {
        /// Name of the run.
        run: String,
    },
    /// Cycles are being sampled and reach the disk.
    Writing {
        /// Name of the run.
        run: String,
    },
    /// The rest is being written and the file finished.
    Closing {
        /// Name of the run.
        run: String,
        /// Why it ends.
        cause: String,
    },
}

/// What happens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// The bus is in operation.
    BusUp,
    /// The bus is not in operation, or no longer.
    BusDown(String),
    /// Somebody wants a run; without a name whichever is convenient.
    Start {
        /// Its name.
        run: String,
        /// The name was chosen by a person.
        named: bool,
    },
    /// The run's file is there.
    Opened,
    /// The run's file cannot be created.
    OpenFailed(String),
    /// More of the run is on disk.
    Synced,
    /// Nothing has reached the disk for too long.
    Stalled,
    /// Somebody wants the run to end, and why.
    Stop(String),
    /// The run ends by itself: duration, disk floor.
    Ended(String),
    /// The run's file is finished.
    Closed,
    /// The run's file could not be finished in the ordinary way.
    CloseFailed(String),
    /// What a failed run left has been looked after.
    Recovered,
    /// The service is asked to end, and by what.
    Shutdown(String),
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// Bring the bus into operation.
    Connect,
    /// Create the file of this run and begin to sample.
    Open(String),
    /// Take no more cycles, for this cause.
    End(String),
    /// A run is over.
    Finished {
        /// Its name.
        run: String,
        /// Why.
        cause: String,
    },
    /// Look after what a failed run left.
    Recover,
    /// Tell who asked.
    Answer(Answer),
    /// End the service.
    Exit,
}

/// What somebody who asked is told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// The run is being begun.
    Beginning,
    /// This run goes on already and is the one that was asked for.
    Running(String),
    /// Another run goes on.
    Busy(String),
    /// It cannot begin.
    Refused(String),
    /// The run is being ended.
    Stopping(String),
    /// Nothing goes on that could be ended.
    Idle,
}

/// The acquisition's state.
#[derive(Debug, Clone)]
pub struct Machine {
    state: State,
    /// Why the bus is not in operation; none if it is.
    bus_fault: Option<String>,
    /// Why a run could not be finished, until that is looked after.
    disk_fault: Option<String>,
    leaving: bool,
}

impl Default for Machine {
    fn default() -> Self {
        let reason = "the bus is being brought into operation".to_owned();
        Self {
            state: State::Fault { reason: reason.clone() },
            bus_fault: Some(reason),
            disk_fault: None,
            leaving: false,
        }
    }
}

impl Machine {
    /// Where it is.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The run that goes on.
    pub fn run(&self) -> Option<&str> {
        match &self.state {
            State::Fault { .. } | State::Waiting => None,
            State::Opening { run, .. }
            | State::Sampling { run }
            | State::Writing { run }
            | State::Closing { run, .. } => Some(run),
        }
    }

    /// Takes one event; the actions are to be done in their order. An event that makes no sense in this state
    /// changes nothing.
    pub fn handle(&mut self, event: Event) -> Vec<Action> {
        match event {
            Event::BusUp => self.bus_is(None),
            Event::BusDown(reason) => self.bus_is(Some(reason)),
            Event::Start { run, named } => self.start(run, named),
            Event::Opened => self.opened(),
            Event::OpenFailed(reason) => self.open_failed(reason),
            Event::Synced => self.progress(true),
            Event::Stalled => self.progress(false),
            Event::Stop(cause) => self.stop(&cause),
            Event::Ended(cause) => self.ended(&cause),
            Event::Closed => self.closed(None),
            Event::CloseFailed(reason) => self.closed(Some(reason)),
            Event::Recovered => self.recovered(),
            Event::Shutdown(cause) => self.shutdown(&cause),
        }
    }

    fn bus_is(&mut self, fault: Option<String>) -> Vec<Action> {
        let mut actions = Vec::new();
        if let Some(reason) = &fault {
            if !self.leaving {
                actions.push(Action::Connect);
            }
            actions.extend(self.end_run(&format!("the bus failed: {reason}")));
        }
        self.bus_fault = fault;
        self.rest();
        actions
    }

    fn start(&mut self, run: String, named: bool) -> Vec<Action> {
        let answer = match &self.state {
            _ if self.leaving => Answer::Refused("the service is ending".into()),
            State::Fault { reason } => Answer::Refused(reason.clone()),
            State::Closing { run, .. } => Answer::Busy(run.clone()),
            State::Opening { run: running, .. }
            | State::Sampling { run: running }
            | State::Writing { run: running } => {
                if !named || *running == run {
                    Answer::Running(running.clone())
                } else {
                    Answer::Busy(running.clone())
                }
            }
            State::Waiting => {
                self.state = State::Opening { run: run.clone(), stop: None };
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

    fn open_failed(&mut self, reason: String) -> Vec<Action> {
        let State::Opening { run, .. } = &mut self.state else { return Vec::new() };
        let run = std::mem::take(run);
        self.state = State::Waiting;
        let mut actions = vec![Action::Finished { run, cause: format!("it could not begin: {reason}") }];
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
        let answer = self.run().map_or(Answer::Idle, |run| Answer::Stopping(run.to_owned()));
        let mut actions = self.end_run(cause);
        actions.push(Action::Answer(answer));
        actions
    }

    /// The cycles have ended already, so nobody needs to be told.
    fn ended(&mut self, cause: &str) -> Vec<Action> {
        self.end_run(cause);
        Vec::new()
    }

    /// The first cause stands.
    fn end_run(&mut self, cause: &str) -> Vec<Action> {
        match &mut self.state {
            State::Opening { stop, .. } => {
                stop.get_or_insert_with(|| cause.to_owned());
                Vec::new()
            }
            State::Sampling { run } | State::Writing { run } => {
                let run = std::mem::take(run);
                self.state = State::Closing { run, cause: cause.to_owned() };
                vec![Action::End(cause.to_owned())]
            }
            State::Closing { .. } | State::Fault { .. } | State::Waiting => Vec::new(),
        }
    }

    fn closed(&mut self, failure: Option<String>) -> Vec<Action> {
        // A recorder that fails ends its run without being asked to.
        if let Some(reason) = &failure {
            self.end_run(reason);
        }
        let State::Closing { run, cause } = &mut self.state else { return Vec::new() };
        let (run, cause) = (std::mem::take(run), std::mem::take(cause));
        self.state = State::Waiting;
        let mut actions = Vec::new();
        let cause = match &failure {
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
        actions.extend(self.rest_or_exit());
        actions
    }

    /// Between runs: what stands in the way of the next decides the state.
    fn rest(&mut self) {
        if self.run().is_none() {
            let fault = self.bus_fault.as_ref().or(self.disk_fault.as_ref());
            self.state = fault.map_or(State::Waiting, |reason| State::Fault { reason: reason.clone() });
        }
    }

    fn rest_or_exit(&mut self) -> Option<Action> {
        self.rest();
        (self.leaving && self.run().is_none()).then_some(Action::Exit)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn started(run: &str) -> Event {
        Event::Start { run: run.into(), named: true }
    }

    fn after(events: impl IntoIterator<Item = Event>) -> (Machine, Vec<Action>) {
        let mut machine = Machine::default();
        let actions = events.into_iter().flat_map(|event| machine.handle(event)).collect();
        (machine, actions)
    }

    fn any_event() -> impl Strategy<Value = Event> {
        let word = "[ab]";
        prop_oneof![
            3 => Just(Event::BusUp),
            1 => word.prop_map(Event::BusDown),
            4 => (word, any::<bool>()).prop_map(|(run, named)| Event::Start { run, named }),
            3 => Just(Event::Opened),
            1 => word.prop_map(Event::OpenFailed),
            2 => Just(Event::Synced),
            1 => Just(Event::Stalled),
            2 => word.prop_map(Event::Stop),
            1 => word.prop_map(Event::Ended),
            3 => Just(Event::Closed),
            1 => word.prop_map(Event::CloseFailed),
            1 => Just(Event::Recovered),
        ]
    }

    /// A run is open from the moment it is asked to be until it is said to be finished.
    fn check_runs(actions: &[Action]) -> Result<Option<String>, TestCaseError> {
        let mut open: Option<String> = None;
        for action in actions {
            match action {
                Action::Open(run) => {
                    prop_assert!(open.is_none(), "{run} is opened while {open:?} goes on");
                    open = Some(run.clone());
                }
                Action::Finished { run, cause } => {
                    let opened = open.take();
                    prop_assert_eq!(opened.as_ref(), Some(run));
                    prop_assert!(!cause.is_empty());
                }
                _ => {}
            }
        }
        Ok(open)
    }

    proptest! {
        #[test]
        fn no_two_runs_at_once_and_none_is_lost_without_a_cause(
            events in prop::collection::vec(any_event(), 0..60),
        ) {
            let (machine, actions) = after(events);
            let open = check_runs(&actions)?;
            prop_assert_eq!(open.as_deref(), machine.run());
        }

        #[test]
        fn whatever_happened_a_shutdown_ends_the_run_and_the_service(
            events in prop::collection::vec(any_event(), 0..60),
            failing in any::<bool>(),
        ) {
            let (mut machine, mut actions) = after(events);
            actions.extend(machine.handle(Event::Shutdown("SIGTERM".into())));
            actions.extend(machine.handle(Event::Opened));
            let last = if failing { Event::CloseFailed("disk".into()) } else { Event::Closed };
            actions.extend(machine.handle(last));
            prop_assert_eq!(check_runs(&actions)?, None);
            prop_assert_eq!(machine.run(), None);
            prop_assert_eq!(actions.iter().filter(|action| **action == Action::Exit).count(), 1);
        }

        #[test]
        fn every_question_gets_one_answer(
            events in prop::collection::vec(any_event(), 0..60),
        ) {
            let questions =
                events.iter().filter(|event| matches!(event, Event::Start { .. } | Event::Stop(_))).count();
            let (_, actions) = after(events);
            let answers = actions.iter().filter(|action| matches!(action, Action::Answer(_))).count();
            prop_assert_eq!(questions, answers);
        }

        #[test]
        fn a_lost_bus_is_always_being_brought_back(events in prop::collection::vec(any_event(), 0..60)) {
            let downs = events.iter().filter(|event| matches!(event, Event::BusDown(_))).count();
            let (_, actions) = after(events);
            prop_assert_eq!(actions.iter().filter(|action| **action == Action::Connect).count(), downs);
        }
    }

    #[test]
    fn a_run_passes_through_the_five_states() {
        let (mut machine, _) = after([Event::BusUp]);
        assert_eq!(*machine.state(), State::Waiting);
        machine.handle(started("a"));
        assert_eq!(*machine.state(), State::Opening { run: "a".into(), stop: None });
        machine.handle(Event::Opened);
        assert_eq!(*machine.state(), State::Sampling { run: "a".into() });
        machine.handle(Event::Synced);
        assert_eq!(*machine.state(), State::Writing { run: "a".into() });
        machine.handle(Event::Stop("stopped".into()));
        assert_eq!(*machine.state(), State::Closing { run: "a".into(), cause: "stopped".into() });
        let actions = machine.handle(Event::Closed);
        assert_eq!(actions, [Action::Finished { run: "a".into(), cause: "stopped".into() }]);
        assert_eq!(*machine.state(), State::Waiting);
    }

    #[test]
    fn starting_twice_and_stopping_twice_change_nothing() {
        let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened]);
        assert_eq!(machine.handle(started("a")), [Action::Answer(Answer::Running("a".into()))]);
        assert_eq!(machine.handle(started("b")), [Action::Answer(Answer::Busy("a".into()))]);
        machine.handle(Event::Stop("first".into()));
        let second = machine.handle(Event::Stop("second".into()));
        assert_eq!(second, [Action::Answer(Answer::Stopping("a".into()))]);
        assert!(matches!(machine.state(), State::Closing { cause, .. } if cause == "first"));
        machine.handle(Event::Closed);
        assert_eq!(machine.handle(Event::Stop("third".into())), [Action::Answer(Answer::Idle)]);
    }

    #[test]
    fn a_disk_that_fails_is_a_fault_until_it_is_looked_after() {
        let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened, Event::Synced]);
        let actions = machine.handle(Event::CloseFailed("no space".into()));
        assert_eq!(
            actions,
            [Action::Finished { run: "a".into(), cause: "no space".into() }, Action::Recover]
        );
        assert_eq!(machine.handle(started("b")), [Action::Answer(Answer::Refused("no space".into()))]);
        machine.handle(Event::Recovered);
        assert_eq!(*machine.state(), State::Waiting);
    }

    #[test]
    fn nothing_reaching_the_disk_is_shown() {
        let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened, Event::Synced]);
        machine.handle(Event::Stalled);
        assert_eq!(*machine.state(), State::Sampling { run: "a".into() });
    }
}
