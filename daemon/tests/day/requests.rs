//! Answers to invalid requests, and the names that the service gives to runs.

use ballbard::control::status::{NameReply, ServiceState};
use serde_json::{Value, json};

use super::rig::{Day, live_on_bus};

#[test]
fn hostile_requests_are_refused_and_leave_nothing() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        let files = || std::fs::read_dir(day.home()).unwrap().count();
        let files_before = files();
        for name in ["", "..", "/", "\u{202e}", "-", "\u{0}"] {
            let (status, reply) = day.post("/start", &json!({"name": name})).await;
            assert_eq!(status, 422, "{name}: {reply}");
            assert!(reply["error"].as_str().unwrap().contains("run name"), "{reply}");
        }
        for body in [
            json!({"name": 5}),
            json!({"nmae": "x"}),
            json!({"duration_s": -1}),
            json!({"duration_s": 1e308}),
            json!({"duration_s": 1e9}),
            json!({"note": "\u{1b}[2J"}),
            json!({"duration_s": 0.0}),
            json!({"note": "x".repeat(5000)}),
            json!([1]),
            json!(null),
        ] {
            let (status, reply) = day.post("/start", &body).await;
            assert_eq!(status, 422, "{body}: {reply}");
            assert!(!reply["error"].as_str().unwrap().is_empty());
        }
        for (path, body) in [
            ("/mark", json!({"text": ""})),
            ("/mark", json!({"text": "x", "ago_ms": 600_001})),
            ("/mark", json!({"text": "x", "ago_ms": -1})),
            ("/stop", json!({"cause": ""})),
            ("/stop", json!({"cause": "\u{1b}]0;x\u{7}"})),
        ] {
            assert_eq!(day.post(path, &body).await.0, 422);
        }
        assert_eq!(day.post("/mark", &json!({"text": "x"})).await.0, 409);
        assert_eq!(day.post("/nowhere", &json!({})).await.0, 404);
        assert_eq!(files(), files_before);
        assert_eq!(day.service.status().state, ServiceState::Waiting);
    });
}

/// Returns the name that a run with these details would get.
async fn named(day: &Day, request: &Value) -> NameReply {
    serde_json::from_value(day.post("/name", request).await.1).unwrap()
}

#[test]
fn whatever_a_run_is_called_its_file_lies_in_the_directory_under_a_plain_name() {
    live_on_bus(&[], async |day| {
        day.wait_for(ServiceState::Waiting).await;
        for (typed, name) in [
            ("../up", "up".to_owned()),
            ("/etc/passwd", "etc-passwd".to_owned()),
            ("Prüfling 7/ä", "Prüfling-7-ä".to_owned()),
            ("a\u{0}b", "a-b".to_owned()),
            ("a.mcap.active", "a-mcap-active".to_owned()),
            (&"x".repeat(60_000), "x".repeat(120)),
        ] {
            let request = json!({"name": typed});
            let asked = named(&day, &request).await;
            assert_eq!((asked.name.as_str(), asked.problem), (name.as_str(), None));
            assert_eq!(day.granted("/start", &request).await.run.as_deref(), Some(name.as_str()));
            day.wait_for(ServiceState::Writing).await;
            day.granted("/stop", &json!({})).await;
            assert!(day.home().join(format!("{name}.mcap")).exists(), "{name}");
            assert!(named(&day, &request).await.problem.unwrap().contains("choose another name"));
        }
        let asked = named(&day, &json!({"name": "???"})).await;
        assert!(asked.name.is_empty() && asked.problem.unwrap().contains("no letter or digit"));
        // The page and the command use the same default name. It consists of date, robot, bar and a number.
        let about = json!({"robot": "IRB 2400", "bar": "short"});
        let NameReply { name, .. } = named(&day, &about).await;
        assert!(name.ends_with("_irb-2400_short_01"), "{name}");
        assert_eq!(day.granted("/start", &about).await.run.unwrap(), name);
    });
}
