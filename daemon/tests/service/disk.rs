//! Reports and reactions of the service when the disk changes during a run.

use std::path::Path;

use ballbard::control::recordings::runs::RunLine;
use ballbard::control::status::{CheckLine, Status};
use serde_json::json;
use shared::recording::Recording;

use super::rig::{Running, changed, text};

/// A service that records to `<directory>/runs`, with `<directory>/spare` as the spare directory.
fn service(directory: &Path) -> Running {
    let spare = format!("spare_directory = {:?}", directory.join("spare"));
    let config = changed("spare_directory = \"/var/tmp/ballbard\"", &spare);
    let runs = tempfile::Builder::new().prefix("runs").tempdir_in(directory).unwrap();
    Running::in_directory(runs, config.path())
}

#[test]
fn a_directory_removed_in_mid_run_is_reported_and_stop_names_a_file_that_is_there() {
    let directory = tempfile::tempdir().unwrap();
    let service = service(directory.path());
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "moved"}));
    let before = service.wait_for("writing").run.unwrap();
    std::fs::remove_dir_all(service.directory.path()).unwrap();
    let is_told =
        |status: &Status| status.reason.as_ref().is_some_and(|reason| reason.contains("not there any more"));
    service.wait_until("the loss", is_told);
    let lines: Vec<CheckLine> = service.get("check");
    assert!(lines.iter().any(|line| line.subject == "disk" && line.remedy.is_some()), "{lines:?}");
    let stopped = service.granted("stop", &json!({})).last.unwrap();
    let recording = Recording::open(Path::new(&stopped.file.unwrap())).unwrap();
    assert_eq!(recording.cycles.len() as u64, stopped.cycles);
    assert!(stopped.cycles > before.cycles && stopped.cycles_lost == 0);
}

#[test]
fn a_run_that_has_no_place_left_is_no_success_for_whoever_stops_it() {
    let directory = tempfile::tempdir().unwrap();
    let service = service(directory.path());
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "lost"}));
    service.wait_for("writing");
    // Neither directory accepts a file any more.
    std::fs::write(directory.path().join("spare"), "in the way").unwrap();
    std::fs::remove_dir_all(service.directory.path()).unwrap();
    std::fs::write(service.directory.path(), "in the way").unwrap();
    let last = service.wait_until("the end", |status| status.last.is_some()).last.unwrap();
    assert!(last.error.as_ref().unwrap().contains("no part of the run is saved"), "{last:?}");
    assert_eq!((last.file, last.cycles), (None, 0));
    // A directory that accepts no file gets no further runs, also after the recovery of this run.
    service.wait_for("waiting");
    let (status, refused) = service.post("start", &json!({"name": "next"}));
    assert_eq!(status, 409);
    assert!(refused["error"].as_str().unwrap().contains("cannot be written"), "{refused}");
    std::fs::remove_file(service.directory.path()).unwrap();
}

#[test]
fn a_run_left_behind_while_the_service_goes_on_is_recovered_when_the_next_one_starts() {
    let other = Running::start();
    other.wait_for("waiting");
    other.granted("start", &json!({"name": "left"}));
    other.wait_for("writing");
    let service = Running::start();
    service.wait_for("waiting");
    for name in ["left.mcap.active", "empty.mcap.active"] {
        std::fs::write(service.directory.path().join(name), "").unwrap();
    }
    let left = other.directory.path().join("left.mcap.active");
    std::fs::copy(left, service.directory.path().join("left.mcap.active")).unwrap();
    // The file that was left keeps its name when it is recovered, which comes first and is reported.
    let (status, refused) = service.post("start", &json!({"name": "left"}));
    let error = refused["error"].as_str().unwrap();
    assert!(
        status == 409 && error.contains("left.mcap") && error.contains("just been recovered"),
        "{refused}"
    );
    assert!(service.recording("left").end.recovered);
    // An empty file does not block its name.
    service.granted("start", &json!({"name": "empty"}));
    let recording = service.recording("left");
    assert!(recording.end.recovered && !recording.cycles.is_empty());
    service.wait_for("writing");
    service.granted("stop", &json!({}));
    assert!(!service.recording("empty").cycles.is_empty());
}

#[test]
fn a_start_that_was_refused_is_no_run_for_status_and_stop() {
    let service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "before"}));
    service.wait_for("writing");
    let before = service.granted("stop", &json!({})).last;
    let taken = service.directory.path().join("again.mcap");
    std::fs::write(&taken, "another").unwrap();
    assert_eq!(service.post("start", &json!({"name": "again"})).0, 409);
    let status: Status = service.get("status");
    assert_eq!((status.last, status.runs_over), (before, 1));
    let told = text(&service.command(&["status"]));
    assert!(told.contains("before.mcap") && !told.contains("again"), "{told}");
    std::fs::remove_file(&taken).unwrap();
    service.granted("start", &json!({"name": "again"}));
    service.wait_for("writing");
    let stopped = service.granted("stop", &json!({})).last.unwrap();
    assert_eq!((stopped.file.as_deref(), stopped.error.as_ref()), (taken.to_str(), None));
    assert!(stopped.cycles > 0 && taken.exists());
}

#[test]
fn status_separates_what_is_taken_what_is_written_and_what_is_synchronised() {
    let service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "parts"}));
    service.wait_for("writing");
    let run = service.get::<Status>("status").run.unwrap();
    assert!(run.cycles <= run.cycles_written && run.cycles_written <= run.cycles_taken, "{run:?}");
    assert!(
        run.cycles > 0 && (59.9..60.1).contains(&run.backlog_limit_s) && run.disk.sync_longest_ns > 0,
        "{run:?}"
    );
    assert!(run.file.ends_with("parts.mcap.active"));
    let told = text(&service.command(&["status"]));
    for part in ["cycles on disk", "not safe on disk yet", "not written yet (at 60 s cycles are lost)"] {
        assert!(told.contains(part), "`{part}` is missing in: {told}");
    }
    let lines: Vec<CheckLine> = service.get("check");
    let disk = lines.iter().find(|line| line.subject == "disk").unwrap();
    assert!(disk.finding.contains("longest until safe on disk"), "{disk:?}");
    service.granted("stop", &json!({}));
    assert!(service.recording("parts").timing.unwrap().disk.sync_longest_ns > 0);
}

#[test]
fn runs_that_had_to_go_on_in_the_spare_place_are_listed_with_the_others() {
    let directory = tempfile::tempdir().unwrap();
    let service = service(directory.path());
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "one"}));
    service.wait_for("writing");
    let file = service.granted("stop", &json!({})).last.unwrap().file.unwrap();
    let spare = directory.path().join("spare");
    std::fs::create_dir(&spare).unwrap();
    std::fs::copy(file, spare.join("two.mcap")).unwrap();
    std::fs::write(spare.join("three.mcap.active"), "left behind").unwrap();
    let mut names: Vec<_> = service.get::<Vec<RunLine>>("runs").into_iter().map(|line| line.name).collect();
    names.sort();
    assert_eq!(names, ["one", "three", "two"]);
    let lines: Vec<CheckLine> = service.get("check");
    assert!(lines.iter().any(|line| line.finding.contains("three.mcap.active")), "{lines:?}");
}
