//! Homing through the service: its requests, its reports and the files that it writes.

use std::io::{BufRead, BufReader};
use std::process::Stdio;

use ballbard::control::status::{CheckLine, Granted, HomingStatus, Status};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use shared::config::{self, HomingConfig};

use super::rig::{Running, copied, shipped, text};
use crate::support::ballbard;

fn marks_line(service: &Running) -> CheckLine {
    let lines: Vec<CheckLine> = service.get("check");
    lines.into_iter().find(|line| line.subject == "reference marks").unwrap()
}

fn recorded_marks(service: &Running, name: &str) -> Vec<u32> {
    service.granted("start", &json!({"name": name, "duration_s": 0.2}));
    service.wait_until("the run", |status| status.last.as_ref().is_some_and(|last| last.name == name));
    let encoders = service.recording(name).run.encoders;
    encoders.iter().map(|encoder| encoder.scale.reference_counts).collect()
}

#[test]
#[ignore = "takes half a minute: every joint is turned"]
fn marks_are_found_used_by_runs_and_forgotten_with_the_terminals_power() {
    let config = copied();
    let service = Running::in_directory(tempfile::tempdir().unwrap(), config.path(), &[]);
    service.wait_for("waiting");
    assert!(marks_line(&service).finding.contains("not homed"));
    let output = service.command(&["home", "--json"]);
    assert!(output.status.success(), "{}", text(&output));
    let states = serde_json::Deserializer::from_slice(&output.stdout).into_iter::<HomingStatus>();
    let states: Vec<HomingStatus> = states.map(Result::unwrap).collect();
    assert!(states.len() > 5 && states.windows(2).all(|pair| pair[0] != pair[1]), "{states:?}");
    let asked: Vec<u8> = states.iter().filter_map(|state| state.joint).collect();
    assert!(asked.is_sorted() && asked.first() == Some(&1), "{asked:?}");
    // A joint near its mark may be turned for less time than between two polls. Its lines must still be in the status.
    let end = states.last().unwrap();
    let found = end.lines.iter().filter(|line| line.contains("mark at count")).count();
    assert!(end.is_over && end.error.is_none() && found == 5, "{end:?}");
    let output = service.command(&["home"]);
    assert!(output.status.success(), "{}", text(&output));
    for told in ["joint 1 (gimbal", "joint 5 (cardan", "joint 5: on terminal 5, counts up", "homing.toml"] {
        assert!(text(&output).contains(told), "`{told}` is missing in: {}", text(&output));
    }
    let homing: HomingConfig = config::load(&service.directory.path().join("homing.toml")).unwrap();
    let marks: Vec<u32> = homing.encoders.iter().map(|encoder| encoder.reference_counts).collect();
    assert_eq!(recorded_marks(&service, "homed"), marks);
    assert_eq!(marks_line(&service).remedy, None);
    assert!(!config.path().join("homing.toml").exists(), "configuration is only read");
    // When the process of a service ends, its simulated terminals lose power. Earlier versions wrote the file with the marks
    // to the directory of the configuration. That file is used until a newer file exists.
    std::fs::copy(service.directory.path().join("homing.toml"), config.path().join("homing.toml")).unwrap();
    let directory = tempfile::tempdir().unwrap();
    drop(service);
    let again = Running::in_directory(directory, config.path(), &[]);
    again.wait_for("waiting");
    assert!(marks_line(&again).remedy.unwrap().contains("ballbard home"));
    assert_eq!(recorded_marks(&again, "not-homed"), [0; 5]);
}

#[test]
fn homing_is_stopped_like_a_run_and_keeps_runs_out() {
    let service = Running::start();
    service.wait_for("waiting");
    assert_eq!(service.granted("home", &json!({})).answer, Granted::Begun);
    service.wait_for("homing");
    // A second client of the same homing only watches it. If the second client disconnects, the homing continues.
    assert_eq!(service.granted("home", &json!({})).answer, Granted::Homing);
    let mut other = ballbard();
    let mut other = other.args(["home", "--port", &service.port]).stdout(Stdio::piped()).spawn().unwrap();
    let mut told = BufReader::new(other.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert!(told.next().unwrap().contains("homing the encoders already"));
    told.next().unwrap();
    kill(Pid::from_raw(other.id().try_into().unwrap()), Signal::SIGINT).unwrap();
    assert!(!other.wait().unwrap().success());
    assert!(text(&service.command(&["status"])).contains("is to be turned"));
    let (status, refused) = service.post("start", &json!({}));
    assert_eq!(status, 409);
    assert!(refused["error"].as_str().unwrap().contains("being homed"), "{refused}");
    // The request is answered only when the homing has ended. The answer contains the result.
    let stopped = service.granted("stop", &json!({"cause": "enough"}));
    assert_eq!((stopped.answer, &stopped.homing), (Granted::Homing, &service.get::<Status>("status").homing));
    let homing = stopped.homing.unwrap();
    assert!(homing.is_over && homing.error.unwrap().contains("enough"));
    assert!(text(&service.command(&["status"])).contains("not homed: stopped"));
    assert_eq!(service.granted("start", &json!({"name": "at-once"})).answer, Granted::Begun);
    assert!(!service.directory.path().join("homing.toml").exists());
}

#[test]
fn a_homing_whose_marks_could_not_be_kept_is_refused_before_anybody_turns_a_joint() {
    let elsewhere = tempfile::tempdir().unwrap();
    let file = elsewhere.path().join("file");
    std::fs::write(&file, "").unwrap();
    let state = file.join("state");
    let service = Running::with_arguments(&["--state", state.to_str().unwrap()]);
    service.wait_for("waiting");
    let lines: Vec<CheckLine> = service.get("check");
    let line = lines.into_iter().find(|line| line.subject == "state").unwrap();
    assert!(line.finding.contains("file/state cannot be written"), "{line:?}");
    assert!(line.remedy.unwrap().contains("--state") && !line.stops);
    let (status, refused) = service.post("home", &json!({}));
    assert_eq!(status, 409);
    assert!(refused["error"].as_str().unwrap().contains("cannot be written"), "{refused}");
    assert!(service.get::<Status>("status").homing.is_none());
    // Without a service, `ballbard home` must refuse in the same way.
    let mut alone = ballbard();
    alone.args(["home", "--bus", "simulated", "--state"]).arg(&state).arg("--config").arg(shipped());
    let output = alone.output().unwrap();
    assert!(!output.status.success() && text(&output).contains("cannot be written"), "{}", text(&output));
    assert!(!text(&output).contains("turn it"), "{}", text(&output));
}
