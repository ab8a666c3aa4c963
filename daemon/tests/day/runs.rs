//! Complete runs that are requested by programs.

use std::time::Duration;

use ballbard::control::status::{Granted, ServiceState, Status};
use serde_json::json;
use shared::recording::schema::EventKind;

use super::rig::live_on_bus;
use crate::support::assert_bad_cycles_have_reasons;
use crate::support::world::sleep;

#[test]
fn runs_are_recorded_one_after_the_other_from_one_bus() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        for name in ["first", "second"] {
            let begun = day.granted("/start", &json!({"name": name, "note": "n"})).await;
            assert_eq!(begun.answer, Granted::Begun);
            let writing = day.wait_for(ServiceState::Writing).await.run.unwrap();
            assert!(writing.cycles > 0 && writing.bytes > 0, "{writing:?}");
            let marked = day.granted("/mark", &json!({"text": "half way"})).await;
            assert_eq!(marked.run.as_deref(), Some(name));
            let stopped = day.granted("/stop", &json!({"cause": "enough"})).await;
            assert_eq!((stopped.answer, stopped.run.as_deref()), (Granted::Stopped, Some(name)));
            let recording = day.recording(name);
            assert_eq!((recording.run.name.as_str(), recording.run.note.as_str()), (name, "n"));
            assert_eq!(recording.end.cause, "enough");
            assert_eq!(recording.cycles.len() as u64, stopped.last.unwrap().cycles);
            let marks: Vec<_> =
                recording.events.iter().filter(|event| event.kind == EventKind::Marker).collect();
            assert!(matches!(marks[..], [mark] if mark.text == "half way"), "{marks:?}");
            assert_bad_cycles_have_reasons(&recording.cycles);
        }
        let names: Vec<_> = day.runs().await.into_iter().map(|line| line.name).collect();
        assert_eq!(names, ["second", "first", "left"]);
        day.end().await;
    });
}

#[test]
fn starting_and_stopping_twice_changes_nothing() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        assert_eq!(day.granted("/stop", &json!({})).await.answer, Granted::Idle);
        assert_eq!(day.granted("/start", &json!({"name": "one"})).await.answer, Granted::Begun);
        for body in [json!({"name": "one"}), json!({})] {
            let again = day.granted("/start", &body).await;
            assert_eq!((again.answer, again.run.as_deref()), (Granted::Running, Some("one")));
        }
        let (status, other) = day.post("/start", &json!({"name": "two"})).await;
        assert_eq!(status, 409);
        assert!(other["error"].as_str().unwrap().contains("`one` is active"), "{other}");
        assert_eq!(day.granted("/stop", &json!({})).await.answer, Granted::Stopped);
        assert_eq!(day.granted("/stop", &json!({})).await.answer, Granted::Idle);
        let (status, taken) = day.post("/start", &json!({"name": "one"})).await;
        assert_eq!(status, 409);
        assert!(taken["error"].as_str().unwrap().contains("never overwritten"), "{taken}");
        day.wait_for(ServiceState::Waiting).await;
        day.end().await;
    });
}

#[test]
fn a_run_ends_by_itself_after_its_duration() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.granted("/start", &json!({"name": "short", "duration_s": 0.5})).await;
        let is_over = |status: &Status| status.last.is_some();
        let last = day.wait(Duration::from_secs(10), is_over).await.last.unwrap();
        assert_eq!((last.cycles, last.cause.as_str()), (50, "duration reached"));
        assert_eq!(day.recording("short").cycles.len(), 50);
        day.wait_for(ServiceState::Waiting).await;
        day.end().await;
    });
}

#[test]
fn prometheus_reads_what_the_page_shows() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.start_run("measured").await;
        sleep(Duration::from_millis(300)).await;
        let text = day.text("/metrics").await;
        let value = |name: &str| -> f64 {
            let line = text.lines().find(|line| line.starts_with(name) && !line.starts_with('#'));
            line.unwrap_or_else(|| panic!("no {name} in {text}")).rsplit(' ').next().unwrap().parse().unwrap()
        };
        assert_eq!((value("ballbard_recording "), value("ballbard_ready ")), (1.0, 0.0));
        assert!(value("ballbard_run_cycles_synced ") > 0.0 && value("ballbard_run_cycles_lost ") == 0.0);
        assert_eq!(value("ballbard_encoder_good{joint=\"3\"} "), 1.0);
        assert!(value("ballbard_disk_left_hours ") > 0.0 && text.ends_with("# EOF\n"));
        day.end().await;
    });
}
