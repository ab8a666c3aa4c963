//! Reports of the service while the bus or an encoder fails, and the effect of the failure on runs.

use std::time::Duration;

use ballbard::control::status::{ServiceState, Status};
use serde_json::{Value, json};
use shared::recording::schema::EventKind;

use super::rig::live_on_bus;
use crate::support::assert_bad_cycles_have_reasons;
use crate::support::world::{now, since, sleep};

/// The line of a check's output whose subject is `subject`.
pub fn line<'a>(lines: &'a Value, subject: &str) -> &'a Value {
    lines.as_array().unwrap().iter().find(|line| line["subject"] == subject).unwrap()
}

#[test]
fn terminals_that_are_gone_are_a_fault_at_once_and_no_run_begins() {
    live_on_bus(&["gone:3@4s-9s"], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        let is_silent = |status: &Status| status.encoders.iter().any(|encoder| !encoder.valid);
        day.wait(Duration::from_secs(10), is_silent).await;
        let silent = now();
        day.wait_for(ServiceState::Fault).await;
        // The service is in fault after 50 ms without samples, and checks this every 100 ms.
        assert!(since(silent) <= Duration::from_millis(200), "a fault after {:?}", since(silent));
        assert_eq!(day.post("/start", &json!({"name": "refused"})).await.0, 409);
        let (_, lines) = day.get("/check").await;
        assert!(line(&lines, "bus")["remedy"].is_string(), "{lines}");
        day.wait_for(ServiceState::Waiting).await;
        assert_eq!(day.service.status().last, None);
        day.end().await;
    });
}

#[test]
fn a_terminal_that_refuses_its_settings_is_named_until_it_accepts_them() {
    live_on_bus(&["gone:3@7s-8s", "abort:1,0x06090011@7s-9s"], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        let refusing =
            day.wait_for_reason("terminal 1 refused a command while setting the interpolation").await;
        assert_eq!(refusing.problems[0].code(), "bus_setting_refused");
        let reason = refusing.reason.unwrap();
        assert!(reason.starts_with("no samples from any encoder: terminal 1 refused"), "{reason}");
        day.wait_for(ServiceState::Waiting).await;
        day.end().await;
    });
}

#[test]
fn an_encoder_without_signal_needs_a_reason_for_a_run_which_is_in_the_file() {
    live_on_bus(&["no-signal:2@4s"], async |day| {
        let waiting = day.wait_for_reason("no valid sample from joint 2 ").await;
        assert_eq!(waiting.state, ServiceState::Waiting);
        let is_named = |text: &str| text.contains("no valid sample from joint 2 (status");
        let (code, refused) = day.post("/start", &json!({"name": "four"})).await;
        let why = refused["error"].as_str().unwrap();
        assert!(code == 409 && is_named(why) && why.contains("`reason`"), "{code}: {why}");
        let start = json!({"name": "four", "reason": "joint 2 is not needed"});
        assert_eq!(day.post("/start", &start).await.0, 200);
        let writing = day.wait_for(ServiceState::Writing).await;
        assert!(is_named(&writing.reason.unwrap()));
        assert_eq!(day.post("/start", &json!({"name": "four"})).await.1["answer"], "running");
        assert_eq!(day.post("/stop", &json!({})).await.0, 200);
        // The problem is not over when the run ends, so it must not be counted a second time.
        sleep(Duration::from_secs(1)).await;
        assert_eq!(day.service.status().totals.problems["encoder_invalid"], 1);
        let events = day.recording("four").events;
        let said = events.iter().find(|event| event.kind == EventKind::Marker).unwrap();
        assert!(is_named(&said.text) && said.text.contains("joint 2 is not needed"), "{said:?}");
        day.end().await;
    });
}

#[test]
fn the_check_has_a_line_for_each_thing_and_a_remedy_for_each_problem() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        sleep(Duration::from_millis(300)).await;
        let (_, before) = day.get("/check").await;
        for subject in ["bus", "encoders", "disk", "left-over files"] {
            assert!(line(&before, subject)["remedy"].is_null(), "{before}");
        }
        for subject in ["real time", "clock"] {
            // The content of this line depends on the machine, so the test requires only that the content is not empty.
            assert!(!line(&before, subject)["finding"].as_str().unwrap().is_empty());
        }
        // A file that appears while the service runs changes only the line about such files.
        std::fs::write(day.home().join("old.mcap.active"), "left").unwrap();
        let (_, after) = day.get("/check").await;
        for (before, after) in before.as_array().unwrap().iter().zip(after.as_array().unwrap()) {
            if after["subject"] == "left-over files" {
                assert!(after["remedy"].as_str().unwrap().contains("recover"), "{after}");
                assert!(after["finding"].as_str().unwrap().contains("old.mcap.active"), "{after}");
            } else {
                assert_eq!(before["remedy"], after["remedy"]);
            }
        }
        day.end().await;
    });
}

#[test]
fn a_bad_cable_is_in_status_and_check_before_it_costs_a_cycle() {
    live_on_bus(&["noise:3,0.05@1s"], async |day| {
        let has_cable = |status: &Status| !status.bad_cables.is_empty();
        let status = day.wait(Duration::from_secs(40), has_cable).await;
        let contact = "bad contact between terminal 2 and terminal 3";
        assert!(status.bad_cables[0].text.contains(contact), "{:?}", status.bad_cables);
        let (_, lines) = day.get("/check").await;
        assert!(line(&lines, "cables")["remedy"].is_string(), "{lines}");
    });
}

#[test]
fn a_bus_that_is_gone_for_good_ends_the_run_and_the_service_is_ready_again_when_it_is_back() {
    live_on_bus(&["gone:0@7s-20s"], async |day| {
        day.begin_run().await;
        // The run ends, and no new run can start while the bus is missing.
        let fault = day.wait_for(ServiceState::Fault).await;
        let reason = fault.reason.unwrap();
        assert_eq!(fault.problems[0].code(), "bus_no_answer");
        assert!(reason.contains("no EtherCAT device answers on sim"), "{reason}");
        let last = fault.last.unwrap();
        assert!(last.cause.contains("`full_fault_s`") && last.cause.contains("bus_down"), "{}", last.cause);
        let (status, refused) = day.post("/start", &json!({"name": "refused"})).await;
        assert_eq!((status, refused["error"].as_str()), (409, Some(reason.as_str())));
        // The line about the encoders is the same as before the bus was in operation for the first time.
        let (_, lines) = day.get("/check").await;
        assert_eq!(line(&lines, "encoders")["finding"], "no sample in the last second", "{lines}");
        let recording = day.recording("day");
        assert_eq!(recording.end.cause, last.cause);
        let blind = recording.cycles.iter().rev().take_while(|cycle| !cycle.is_valid()).count();
        assert!(blind >= 300, "{blind} cycles");
        assert_bad_cycles_have_reasons(&recording.cycles);
        // When power returns, the service recovers without any request.
        day.wait_for(ServiceState::Waiting).await;
        assert_eq!(day.post("/start", &json!({"name": "next", "duration_s": 1.0})).await.0, 200);
        let is_next = |status: &Status| status.last.as_ref().is_some_and(|last| last.name == "next");
        day.wait(Duration::from_secs(10), is_next).await;
        let next = day.recording("next");
        assert!(next.cycles.len() == 100 && next.cycles.iter().all(|cycle| cycle.is_valid()));
        day.end().await;
    });
}

#[test]
fn a_short_fault_leaves_the_run_as_it_is_and_the_status_says_so() {
    live_on_bus(&["gone:3@5s-9s"], async |day| {
        day.begin_run().await;
        let troubled = day.wait_for_reason("terminal 3 and all behind it do not answer").await;
        assert_eq!(troubled.state, ServiceState::Writing);
        // The terminals before the missing ones stay in use.
        let valid: Vec<bool> = troubled.encoders.iter().map(|encoder| encoder.valid).collect();
        assert_eq!(valid, [true, true, false, false, false]);
        // While the run continues, the reason names the expected and the detected devices.
        let reason = troubled.reason.unwrap();
        for part in
            ["joint 3, 4, 5: terminal 3", "found [EK1100", "check the power of terminal 3 (bus position 3)"]
        {
            assert!(reason.contains(part), "`{part}` is missing in: {reason}");
        }
        let [expected, found] = ["expected [", "found ["]
            .map(|list| reason.split(list).nth(1).unwrap().split(']').next().unwrap());
        assert_eq!([expected, found].map(|list| list.matches("EL5021").count()), [5, 2], "{reason}");
        let (_, lines) = day.get("/check").await;
        assert!(reason.starts_with(line(&lines, "bus")["finding"].as_str().unwrap()), "{lines}");
        day.wait(Duration::from_secs(40), |status| status.reason.is_none()).await;
        assert_eq!(day.post("/stop", &json!({})).await.0, 200);
        let recording = day.recording("day");
        let is_half = |cycle: &shared::recording::schema::CycleRecord| {
            cycle.encoders()[0].valid && !cycle.encoders()[4].valid
        };
        assert!(recording.cycles.iter().any(is_half));
        let missing = "terminal 3 and all behind it do not answer";
        assert!(recording.events.iter().any(|event| event.text.contains(missing)));
        day.end().await;
    });
}

#[test]
fn a_homing_is_followed_while_a_joint_is_turned_and_stopped_in_the_middle() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        let (status, begun) = day.post("/home", &json!({})).await;
        assert_eq!((status, &begun["simulated"]), (200, &true.into()));
        let turned =
            |status: &Status| status.homing.as_ref().and_then(|homing| homing.turned_deg).unwrap_or(0.0);
        let early = day.wait(Duration::from_secs(60), |status| turned(status) > 1.0).await;
        assert_eq!(early.state, ServiceState::Homing);
        let later = day.wait(Duration::from_secs(60), |status| turned(status) > turned(&early)).await;
        // After the homing has ended, cycles continue as they would without a homing.
        assert!(later.sampled > early.sampled && later.encoders.iter().all(|encoder| encoder.valid));
        let (status, answer) = day.post("/stop", &json!({"cause": "enough"})).await;
        assert!(status == 200 && answer["homing"]["error"].as_str().unwrap().contains("enough"), "{answer}");
        assert_eq!(day.post("/stop", &json!({})).await.1["simulated"], true);
        day.begin_run().await;
        for (path, body) in [
            ("/mark", json!({})),
            ("/stop", json!({})),
            ("/note", json!({"name": "day", "note": "text"})),
            ("/delete", json!({"name": "day"})),
            ("/bin/empty", json!({})),
        ] {
            let (status, answer) = day.post(path, &body).await;
            assert_eq!((status, &answer["simulated"]), (200, &true.into()), "{path}: {answer}");
        }
        day.end().await;
    });
}

#[test]
fn what_is_wrong_with_the_bus_is_reported_during_a_homing() {
    live_on_bus(&["gone:3@5s"], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        assert_eq!(day.post("/home", &json!({})).await.0, 200);
        let is_over = |status: &Status| status.homing.as_ref().is_some_and(|homing| homing.is_over);
        let status = day.wait(Duration::from_secs(600), is_over).await;
        assert!(status.homing.unwrap().error.unwrap().contains("no valid counts"));
        let fault = day.wait_for(ServiceState::Fault).await;
        assert_eq!(fault.problems[0].code(), "bus_device_missing");
        day.end().await;
    });
}
