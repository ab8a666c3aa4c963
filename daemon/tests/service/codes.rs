//! Codes of problems in all outputs of the program: status, log, metrics, page, API and recording. For the faults of the
//! bus, `day/codes.rs` contains these tests.

use std::fs::File;
use std::path::Path;
use std::time::Duration;

use ballbard::problem::CODES;
use serde_json::{Value, json};
use shared::recording::Recording;

use super::rig::{Running, agent};
use crate::support::{has_problem, is_in_metrics};

/// Waits until the status contains the code. Then checks all other outputs except the recording.
pub fn assert_reported(service: &Running, log: &Path, code: &str) {
    service.wait_until(code, |status| has_problem(status, code));
    let page = || service.get::<Value>("live").to_string().contains(&format!("\"code\":\"{code}\""));
    let metrics = || {
        let url = format!("http://127.0.0.1:{}/metrics", service.port);
        is_in_metrics(&agent().get(&url).call().unwrap().body_mut().read_to_string().unwrap(), code)
    };
    let logged = || std::fs::read_to_string(log).unwrap().contains(&format!("code=\"{code}\""));
    // The page is later than the status, and lines of the log wait in a queue. The test therefore waits
    // some time for each output.
    let places: [(&str, &dyn Fn() -> bool); 3] = [("page", &page), ("metrics", &metrics), ("log", &logged)];
    for (place, is_there) in places {
        let is_there = (0..200).any(|_| {
            let is_there = is_there();
            if !is_there {
                std::thread::sleep(Duration::from_millis(50));
            }
            is_there
        });
        assert!(is_there, "{code} is not in the {place}");
    }
}

/// Whether an event of the recording has this code.
pub fn is_in_file(recording: &Recording, code: &str) -> bool {
    recording.events.iter().any(|event| event.code == code)
}

#[test]
fn a_fault_has_the_same_code_in_all_outputs_of_the_program() {
    let outside = tempfile::tempdir().unwrap();
    let log = &outside.path().join("log");
    let stderr = File::create(log).unwrap().into();
    let faults = ["--fault", "noise:3,0.05@2s"];
    let service = &Running::logging_to(stderr, &faults);
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "run", "reason": "a test"}));
    assert_reported(service, log, "link_errors");
    service.granted("stop", &json!({}));
    let recording = service.recording("run");
    assert!(is_in_file(&recording, "link_errors"), "{:?}", recording.events);
}

#[test]
fn the_api_document_has_every_code() {
    let service = Running::start();
    let document: Value = service.get("openapi.json");
    let codes = &document["components"]["schemas"]["Problem"]["properties"]["code"]["enum"];
    assert_eq!(codes, &json!(CODES));
    let states = document["components"]["schemas"]["ServiceState"].to_string();
    let answers = document["components"]["schemas"]["Granted"].to_string();
    assert!(states.contains("\"sampling\"") && answers.contains("\"emptied\""), "{states} {answers}");
}
