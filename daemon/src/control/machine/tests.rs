//! Tests of properties that hold for every order of events, and of the usual sequences.

use proptest::prelude::*;

use super::*;
use crate::problem::Fact;

fn details(run: &str) -> Box<RunDetails> {
    Box::new(RunDetails { name: run.into(), ..RunDetails::default() })
}

fn started(run: &str) -> MachineEvent {
    MachineEvent::Start { run: details(run), named: true }
}

fn problem(error: &str) -> Problem {
    Fact::RunRefused { error: error.into() }.into()
}

/// Returns a machine with a ready disk after these events, together with the actions of all events.
fn after(events: impl IntoIterator<Item = MachineEvent>) -> (StateMachine, Vec<Action>) {
    let mut machine = StateMachine::default();
    machine.handle(MachineEvent::Recovered);
    let actions = events.into_iter().flat_map(|event| machine.handle(event)).collect();
    (machine, actions)
}

fn any_event() -> impl Strategy<Value = MachineEvent> {
    let word = "[ab]";
    prop_oneof![
        3 => Just(MachineEvent::BusUp),
        1 => word.prop_map(|word| MachineEvent::BusDown(problem(&word))),
        4 => (word, any::<bool>()).prop_map(|(run, named)| MachineEvent::Start { run: details(&run), named }),
        3 => Just(MachineEvent::Opened),
        1 => word.prop_map(|word| MachineEvent::OpenFailed(problem(&word))),
        2 => Just(MachineEvent::Synced),
        1 => Just(MachineEvent::Stalled),
        2 => word.prop_map(MachineEvent::Stop),
        1 => word.prop_map(MachineEvent::Ended),
        3 => Just(MachineEvent::Closed),
        1 => word.prop_map(|word| MachineEvent::CloseFailed(problem(&word))),
        1 => Just(MachineEvent::Recovered),
        2 => Just(MachineEvent::Home),
        2 => Just(MachineEvent::HomingOver),
        1 => word.prop_map(|word| MachineEvent::BusTroubled(problem(&word))),
    ]
}

/// Checks the runs in these actions. A run is open from its `Open` to its `Finished` or `NotBegun`. Returns the open run.
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
        actions.extend(machine.handle(MachineEvent::Shutdown("SIGTERM".into())));
        actions.extend(machine.handle(MachineEvent::Opened));
        let last = if failing { MachineEvent::CloseFailed(problem("disk")) } else { MachineEvent::Closed };
        actions.extend(machine.handle(last));
        actions.extend(machine.handle(MachineEvent::HomingOver));
        prop_assert_eq!(check_runs(&actions)?, None);
        prop_assert_eq!(machine.run(), None);
        prop_assert_eq!(actions.iter().filter(|action| **action == Action::Exit).count(), 1);
    }

    #[test]
    fn every_question_gets_one_answer(
        events in prop::collection::vec(any_event(), 0..60),
    ) {
        let is_question = |event: &&MachineEvent| {
            matches!(event, MachineEvent::Start { .. } | MachineEvent::Stop(_) | MachineEvent::Home)
        };
        let questions = events.iter().filter(is_question).count();
        let (_, actions) = after(events);
        let answers = actions.iter().filter(|action| matches!(action, Action::Answer(_))).count();
        prop_assert_eq!(questions, answers);
    }

    #[test]
    fn a_lost_bus_is_always_being_brought_back(events in prop::collection::vec(any_event(), 0..60)) {
        let downs = events.iter().filter(|event| matches!(event, MachineEvent::BusDown(_))).count();
        let (_, actions) = after(events);
        prop_assert_eq!(actions.iter().filter(|action| **action == Action::Connect).count(), downs);
    }
}

#[test]
fn a_run_passes_through_the_five_states() {
    let (mut machine, _) = after([MachineEvent::BusUp]);
    assert_eq!(machine.state(), State::Waiting);
    machine.handle(started("a"));
    assert_eq!((machine.state(), machine.run()), (State::Opening, Some("a")));
    machine.handle(MachineEvent::Opened);
    assert_eq!((machine.state(), machine.run()), (State::Sampling, Some("a")));
    machine.handle(MachineEvent::Synced);
    assert_eq!((machine.state(), machine.run()), (State::Writing, Some("a")));
    machine.handle(MachineEvent::Stop("stopped".into()));
    assert_eq!((machine.run(), machine.cause()), (Some("a"), Some("stopped")));
    let actions = machine.handle(MachineEvent::Closed);
    assert_eq!(actions, [Action::Finished { run: "a".into(), cause: "stopped".into() }]);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn starting_twice_and_stopping_twice_change_nothing() {
    let (mut machine, _) = after([MachineEvent::BusUp, started("a"), MachineEvent::Opened]);
    assert_eq!(machine.handle(started("a")), [Action::Answer(Answer::Running("a".into()))]);
    assert_eq!(machine.handle(started("b")), [Action::Answer(Answer::Busy("a".into()))]);
    machine.handle(MachineEvent::Stop("first".into()));
    let second = machine.handle(MachineEvent::Stop("second".into()));
    assert_eq!(second, [Action::Answer(Answer::Stopping("a".into()))]);
    assert_eq!(machine.cause(), Some("first"));
    machine.handle(MachineEvent::Closed);
    assert_eq!(machine.handle(MachineEvent::Stop("third".into())), [Action::Answer(Answer::Idle)]);
}

#[test]
fn a_disk_that_fails_is_a_fault_until_it_is_looked_after() {
    let (mut machine, _) =
        after([MachineEvent::BusUp, started("a"), MachineEvent::Opened, MachineEvent::Synced]);
    let actions = machine.handle(MachineEvent::CloseFailed(problem("no space")));
    assert_eq!(actions, [Action::Finished { run: "a".into(), cause: "no space".into() }, Action::Recover]);
    assert_eq!(machine.handle(started("b")), [Action::Answer(Answer::Refused(problem("no space")))]);
    machine.handle(MachineEvent::Recovered);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn nothing_begins_before_what_earlier_runs_left_is_looked_after() {
    let mut machine = StateMachine::default();
    machine.handle(MachineEvent::BusUp);
    assert!(matches!(machine.handle(started("a"))[..], [Action::Answer(Answer::Refused(_))]));
    machine.handle(MachineEvent::Recovered);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn a_run_that_is_stopped_before_its_file_is_there_takes_no_more_cycles_and_ends_with_the_file() {
    let (mut machine, _) = after([MachineEvent::BusUp, started("a")]);
    let stopped = machine.handle(MachineEvent::Stop("enough".into()));
    assert_eq!(stopped, [Action::End("enough".into()), Action::Answer(Answer::Stopping("a".into()))]);
    machine.handle(MachineEvent::Opened);
    assert_eq!((machine.run(), machine.cause()), (Some("a"), Some("enough")));
}

#[test]
fn nothing_reaching_the_disk_is_shown() {
    let (mut machine, _) =
        after([MachineEvent::BusUp, started("a"), MachineEvent::Opened, MachineEvent::Synced]);
    machine.handle(MachineEvent::Stalled);
    assert_eq!((machine.state(), machine.run()), (State::Sampling, Some("a")));
}

#[test]
fn while_the_encoders_are_homed_no_run_begins_and_stop_ends_it() {
    let (mut machine, actions) = after([MachineEvent::BusUp, MachineEvent::Home]);
    assert_eq!(actions, [Action::BeginHoming, Action::Answer(Answer::Beginning)]);
    assert_eq!(machine.handle(MachineEvent::Home), [Action::Answer(Answer::Homing)]);
    assert!(matches!(machine.handle(started("a"))[..], [Action::Answer(Answer::Refused(_))]));
    let ended = machine.handle(MachineEvent::Stop("enough".into()));
    assert_eq!(ended, [Action::EndHoming("enough".into()), Action::Answer(Answer::Homing)]);
    machine.handle(MachineEvent::HomingOver);
    assert_eq!(machine.state(), State::Waiting);
}

#[test]
fn a_bus_in_trouble_lets_a_run_go_on_and_none_begin() {
    let (mut machine, _) =
        after([MachineEvent::BusUp, started("a"), MachineEvent::Opened, MachineEvent::Synced]);
    assert_eq!(machine.handle(MachineEvent::BusTroubled(problem("no cable"))), []);
    assert_eq!((machine.state(), machine.run()), (State::Writing, Some("a")));
    assert_eq!(machine.bus_fault(), Some(&problem("no cable")));
    machine.handle(MachineEvent::Ended("no valid samples".into()));
    machine.handle(MachineEvent::Closed);
    assert_eq!((machine.state(), machine.fault()), (State::Fault, Some(&problem("no cable"))));
    machine.handle(MachineEvent::BusUp);
    assert_eq!(machine.state(), State::Waiting);
}
