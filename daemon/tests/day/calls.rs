//! Injects a fault into each disk call of a service during a whole day. A day consists of the recovery of an earlier
//! run, lists, a check, a run, and the shutdown. The call fails, hangs, or transfers a single byte. Or the disk
//! fails from this call on.

use std::path::Path;
use std::rc::Rc;
use std::time::Duration;

use ballbard::control::status::{ServiceState, Status};
use serde_json::json;
use shared::recording::Recording;
use shared::recording::schema::EventKind;

use super::rig::{Answers, Day, ENDS_WITHIN, live};
use crate::support::runs::in_parallel;
use crate::support::wall::{Call, Fault};
use crate::support::world::{World, now, since, sleep};

/// Duration of a hang that exceeds the time of a check of the disk.
const HANG: Duration = Duration::from_millis(1300);
/// Duration of a hang that is longer than any client waits.
const EVER: Duration = Duration::from_secs(8);
/// Interval at which the service checks for commands and for its shutdown.
const POLL: Duration = Duration::from_millis(100);
/// Number of days that are simulated in parallel. A simulated day never waits, so it keeps one processor busy.
const AT_ONCE: usize = 4;

/// Checks that every answer of the service agrees with the files on disk, and that the service ends.
async fn check(day: &Day, fault: Fault) {
    let answers = day.record().await;
    check_answers(&answers, fault);
    day.service.shutdown("test over");
    assert!(day.has_ended_within(ENDS_WITHIN + HANG).await, "{:?}", day.service.status());
    // Wait until the service has also released its claim on the directory. Another directory may get the same inode number.
    day.service.join().unwrap();
    day.check_files();
}

fn check_answers(answers: &Answers, fault: Fault) {
    for (status, answer) in answers.values().filter(|(status, _)| *status != 200) {
        assert!(answer["error"].as_str().is_some_and(|error| error.len() > 10), "{status} {answer}");
    }
    if fault == Fault::Fails {
        let begun = answers.get("second start").unwrap_or(&answers["start"]);
        assert!(begun.0 == 200, "one refusal refuses no second run: {answers:?}");
    }
    let (status, stopped) = &answers["stop"];
    if *status == 200 && stopped["answer"] == "stopped" {
        let recording = Recording::open(Path::new(stopped["last"]["file"].as_str().unwrap())).unwrap();
        assert_eq!(json!(recording.cycles.len()), stopped["last"]["cycles"]);
        assert_eq!(stopped["last"]["cycles_lost"], 0);
        let is_marked =
            recording.events.iter().any(|event| event.kind == EventKind::Marker && event.text == "noon");
        assert_eq!(is_marked, answers["mark"].0 == 200, "{answers:?}");
    } else {
        assert_ne!(fault, Fault::Fails, "the run was lost with one refusal: {answers:?}");
    }
    if answers["runs"].0 == 200 {
        let listed = answers["runs"].1.as_array().unwrap().iter().any(|line| line["name"] == "left");
        assert!(listed || fault == Fault::DiesEverywhere, "{answers:?}");
    }
}

/// Checks that the service reports a call that never returns. No answer may be late. The shutdown may be late, but only
/// while cycles wait to be written.
async fn check_for_ever(day: Rc<Day>) {
    let other = Rc::clone(&day);
    World::here().unwrap().spawn(async move {
        other.record().await;
    });
    day.wait_until_struck().await;
    sleep(Duration::from_millis(1200)).await;
    let asked = now();
    let lines = day.get("/check").await;
    assert!(since(asked) < Duration::from_secs(1) + 2 * POLL, "check took {:?}", since(asked));
    assert_eq!(lines.0, 200, "{lines:?}");
    // If a run has just begun, its data may reach the disk up to a second later.
    let is_told = |status: &Status| {
        matches!(status.state, ServiceState::Waiting | ServiceState::Writing) || status.reason.is_some()
    };
    let status = day.wait(Duration::from_secs(1), is_told).await;
    assert!(is_told(&status), "not reported: {status:?}");
    day.service.shutdown("test over");
    let has_ended = day.has_ended_within(ENDS_WITHIN).await;
    let status = day.service.status();
    assert!(has_ended || (status.run.is_some() && status.reason.is_some()), "{status:?}");
}

#[test]
#[ignore = "takes a minute"]
fn whatever_becomes_of_any_call_of_a_service_what_it_answers_is_true_and_it_ends() {
    let calls = live(None, async |day| {
        let answers = day.record().await;
        assert!(answers.values().all(|(status, _)| *status == 200), "{answers:?}");
        day.end().await;
        day.check_files();
        day.wall.calls()
    });
    let faults =
        [Fault::Fails, Fault::DiesEverywhere, Fault::CutsShort, Fault::Hangs(HANG), Fault::Hangs(EVER)];
    let mut cases = Vec::new();
    for (&call, &count) in &calls {
        let all = (0..count).flat_map(|nth| faults.map(|fault| (call, nth, fault)));
        cases.extend(all.filter(|(_, _, fault)| *fault != Fault::CutsShort || call.moves_bytes()));
    }
    in_parallel(&cases, AT_ONCE, |case| {
        let (_, _, fault) = *case;
        live(Some(*case), async move |day| match fault {
            Fault::Hangs(EVER) => check_for_ever(day).await,
            fault => check(&day, fault).await,
        });
    });
    println!("{} calls, {} cases, 0 failures: {calls:?}", calls.values().sum::<usize>(), cases.len());
}

/// Injects faults into the first and the last disk call of each kind.
#[test]
fn a_service_whose_first_or_last_call_of_a_kind_fails_answers_what_is_true() {
    let calls = live(None, async |day| {
        day.record().await;
        day.end().await;
        day.wall.calls()
    });
    let cases: Vec<(Call, usize, Fault)> = calls
        .iter()
        .flat_map(|(&call, &count)| [0, count - 1].map(|nth| (call, nth, Fault::Fails)))
        .collect();
    in_parallel(&cases, AT_ONCE, |case| live(Some(*case), async |day| check(&day, Fault::Fails).await));
}
