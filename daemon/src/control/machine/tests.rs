//! Properties for every order of events, and the usual sequences.

use proptest::prelude::*;

use super::*;
use crate::problem::Fact;

fn details(run: &str) -> Box<RunDetails> {
    Box::new(RunDetails { name: run.into(), ..RunDetails::default() })
}

fn started(run: &str) -> Event {
    Event::Start { run: details(run), named: true }
}

fn problem(error: &str) -> Problem {
    Fact::RunRefused { error: error.into() }.into()
}

/// A machine whose disk is ready, after these events, and their actions.
fn after(events: impl IntoIterator<Item = Event>) -> (Machine, Vec<Action>) {
    let mut machine = Machine::default();
    machine.handle(Event::Recovered);
    let actions = events.into_iter().flat_map(|event| machine.handle(event)).collect();
    (machine, actions)
}

fn any_event() -> impl Strategy<Value = Event> {
    let word = "[ab]";
    prop_oneof![
        3 => Just(Event::BusUp),
        1 => word.prop_map(|word| Event::BusDown(problem(&word))),
        4 => (word, any::<bool>()).prop_map(|(run, named)| Event::Start { run: details(&run), named }),
        3 => Just(Event::Opened),
        1 => word.prop_map(|word| Event::OpenFailed(problem(&word))),
        2 => Just(Event::Synced),
        1 => Just(Event::Stalled),
        2 => word.prop_map(Event::Stop),
        1 => word.prop_map(Event::Ended),
        3 => Just(Event::Closed),
        1 => word.prop_map(|word| Event::CloseFailed(problem(&word))),
        1 => Just(Event::Recovered),
        2 => Just(Event::Home),
        2 => Just(Event::HomingOver),
        1 => word.prop_map(|word| Event::BusTroubled(problem(&word))),
    ]
}

/// A run is open from its `Open` to its `Finished` or `NotBegun`.
fn check_runs(actions: &[Action]) -> Result<Option<String>, TestCaseError> {
    let mut open: Option<String> = None;
    for action in actions {
        match action {
            Action::Open(run) => {
                prop_assert!(open.is_none(), "{run:?} is opened while {open:?} is open");
                open = Some(run.name.clone());
            }
            Action::Finished { run, cause } => {
                let opened = open.take();
                prop_assert_eq!(opened.as_ref(), Some(run));
                prop_assert!(!cause.is_empty());
            }
            Action::NotBegun { run, .. } => {
                let opened = open.take();
                prop_assert_eq!(opened.as_ref(), Some(run));
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
        let last = if failing { Event::CloseFailed(problem("disk")) } else { Event::Closed };
        actions.extend(machine.handle(last));
        actions.extend(machine.handle(Event::HomingOver));
        prop_assert_eq!(check_runs(&actions)?, None);
        prop_assert_eq!(machine.run(), None);
        prop_assert_eq!(actions.iter().filter(|action| **action == Action::Exit).count(), 1);
    }

    #[test]
    fn every_question_gets_one_answer(
        events in prop::collection::vec(any_event(), 0..60),
    ) {
        let questions =
            events.iter().filter(|event| matches!(event, Event::Start { .. } | Event::Stop(_) | Event::Home)).count();
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
    assert_eq!(machine.state(), State::Waiting);
    machine.handle(started("a"));
    assert_eq!((machine.state(), machine.run()), (State::Opening, Some("a")));
    machine.handle(Event::Opened);
    assert_eq!((machine.state(), machine.run()), (State::Sampling, Some("a")));
    machine.handle(Event::Synced);
    assert_eq!((machine.state(), machine.run()), (State::Writing, Some("a")));
    machine.handle(Event::Stop("stopped".into()));
    assert_eq!((machine.run(), machine.cause()), (Some("a"), Some("stopped")));
    let actions = machine.handle(Event::Closed);
    assert_eq!(actions, [Action::Finished { run: "a".into(), cause: "stopped".into() }]);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn starting_twice_and_stopping_twice_change_nothing() {
    let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened]);
    assert_eq!(machine.handle(started("a")), [Action::Answer(Answer::Running("a".into()))]);
    assert_eq!(machine.handle(started("b")), [Action::Answer(Answer::Busy("a".into()))]);
    machine.handle(Event::Stop("first".into()));
    let second = machine.handle(Event::Stop("second".into()));
    assert_eq!(second, [Action::Answer(Answer::Stopping("a".into()))]);
    assert_eq!(machine.cause(), Some("first"));
    machine.handle(Event::Closed);
    assert_eq!(machine.handle(Event::Stop("third".into())), [Action::Answer(Answer::Idle)]);
}

#[test]
fn a_disk_that_fails_is_a_fault_until_it_is_looked_after() {
    let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened, Event::Synced]);
    let actions = machine.handle(Event::CloseFailed(problem("no space")));
    assert_eq!(actions, [Action::Finished { run: "a".into(), cause: "no space".into() }, Action::Recover]);
    assert_eq!(machine.handle(started("b")), [Action::Answer(Answer::Refused(problem("no space")))]);
    machine.handle(Event::Recovered);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn nothing_begins_before_what_earlier_runs_left_is_looked_after() {
    let mut machine = Machine::default();
    machine.handle(Event::BusUp);
    assert!(matches!(machine.handle(started("a"))[..], [Action::Answer(Answer::Refused(_))]));
    machine.handle(Event::Recovered);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn a_run_that_is_stopped_before_its_file_is_there_takes_no_more_cycles_and_ends_with_the_file() {
    let (mut machine, _) = after([Event::BusUp, started("a")]);
    let stopped = machine.handle(Event::Stop("enough".into()));
    assert_eq!(stopped, [Action::End("enough".into()), Action::Answer(Answer::Stopping("a".into()))]);
    machine.handle(Event::Opened);
    assert_eq!((machine.run(), machine.cause()), (Some("a"), Some("enough")));
}

#[test]
fn nothing_reaching_the_disk_is_shown() {
    let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened, Event::Synced]);
    machine.handle(Event::Stalled);
    assert_eq!((machine.state(), machine.run()), (State::Sampling, Some("a")));
}

#[test]
fn while_the_encoders_are_homed_no_run_begins_and_stop_ends_it() {
    let (mut machine, actions) = after([Event::BusUp, Event::Home]);
    assert_eq!(actions, [Action::BeginHoming, Action::Answer(Answer::Beginning)]);
    assert_eq!(machine.handle(Event::Home), [Action::Answer(Answer::Homing)]);
    assert!(matches!(machine.handle(started("a"))[..], [Action::Answer(Answer::Refused(_))]));
    let ended = machine.handle(Event::Stop("enough".into()));
    assert_eq!(ended, [Action::EndHoming("enough".into()), Action::Answer(Answer::Homing)]);
    machine.handle(Event::HomingOver);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn a_bus_in_trouble_lets_a_run_go_on_and_none_begin() {
    let (mut machine, _) = after([Event::BusUp, started("a"), Event::Opened, Event::Synced]);
    assert_eq!(machine.handle(Event::BusTroubled(problem("no cable"))), []);
    assert_eq!((machine.state(), machine.run()), (State::Writing, Some("a")));
    assert_eq!(machine.bus_fault(), Some(&problem("no cable")));
    machine.handle(Event::Ended("no valid samples".into()));
    machine.handle(Event::Closed);
    assert_eq!((machine.state(), machine.fault()), (State::Fault, Some(&problem("no cable"))));
    machine.handle(Event::BusUp);
    assert_eq!(machine.state(), State::Waiting);
}
