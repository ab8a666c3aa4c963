//! Complete runs. Programs and users request them.

use std::time::Duration;

use ballbard::control::recordings::runs::RunLine;
use ballbard::control::status::{Granted, Status};
use serde_json::json;
use shared::recording::{Recording, RunMark};

use super::rig::{Running, agent, text};
use crate::support::ballbard;

#[test]
fn many_clients_at_once_get_one_run_at_a_time_and_every_file_is_whole() {
    let service = Running::start();
    service.wait_for("waiting");
    let begun: usize = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..8)
            .map(|client| {
                let service = &service;
                scope.spawn(move || {
                    let mut begun = 0;
                    for turn in 0..6 {
                        let name = format!("c{client}-{turn}");
                        let (status, reply) = service.post("start", &json!({"name": name}));
                        assert!(status == 200 || status == 409, "{reply}");
                        begun += usize::from(reply["answer"] == "begun");
                        std::thread::sleep(Duration::from_millis(30));
                        let (status, reply) = service.post("stop", &json!({}));
                        assert_eq!(status, 200, "{reply}");
                    }
                    begun
                })
            })
            .collect();
        clients.into_iter().map(|client| client.join().unwrap()).sum()
    });
    service.wait_for("waiting");
    let lines: Vec<RunLine> = service.get("runs");
    assert!(begun > 0);
    assert_eq!(lines.len(), begun);
    for line in lines {
        let recording = Recording::open(&line.file).unwrap();
        assert_eq!((recording.cycles.len() as u64, line.recovered), (line.cycles, false));
    }
}

/// Starts a service and waits until it is ready. All sections of a test share this service, because a bring-up
/// takes longer than a section.
fn ready() -> Running {
    let service = Running::start();
    service.wait_for("waiting");
    service
}

#[test]
fn commands_say_what_they_did_and_what_the_service_knows() {
    let service = ready();
    the_commands_say_what_they_did(&service);
    what_the_service_knows_is_asked_for_by_name_and_as_json(&service);
    a_start_that_was_refused_is_no_run_for_status_and_stop(&service);
}

#[test]
fn recordings_are_deleted_restored_noted_and_marked() {
    let service = ready();
    a_deleted_run_lies_in_the_bin_until_it_is_restored_or_the_bin_is_emptied(&service);
    a_note_is_changed_after_the_run_and_the_recorded_file_is_not(&service);
    marks_are_numbered_by_the_service_and_stand_in_status_list_and_file(&service);
}

fn the_commands_say_what_they_did(service: &Running) {
    service.wait_until_ready();
    let begun = service.command(&[
        "start",
        "--name",
        "typed",
        "--note",
        "by hand",
        "--operator",
        "A",
        "--reason",
        "may be late",
    ]);
    assert!(begun.status.success() && text(&begun).contains("`typed` has begun"), "{}", text(&begun));
    assert!(text(&service.command(&["start", "--name", "typed"])).contains("was running already"));
    service.wait_for("writing");
    assert!(text(&service.command(&["mark", "a mark"])).contains("marked in run `typed`"));
    let status = service.command(&["status"]);
    let parts = [
        "RECORDING",
        "`typed`",
        "cycles on disk",
        "not safe on disk yet",
        "not written yet (at 60 s cycles are lost)",
    ];
    for part in parts {
        assert!(text(&status).contains(part), "`{part}` is missing in: {}", text(&status));
    }
    let stopped = service.command(&["stop"]);
    assert!(text(&stopped).contains("typed.mcap"), "{}", text(&stopped));
    assert!(text(&service.command(&["stop"])).contains("no run is active"));
    let runs = ballbard().arg("runs").arg(service.directory.path()).output();
    let runs = text(&runs.unwrap());
    assert!(runs.contains("typed") && runs.contains("by hand") && !runs.contains("recovered"), "{runs}");
    for simulated in [text(&begun), text(&status), text(&stopped), runs.clone()] {
        assert!(simulated.contains("SIMULATED"), "{simulated}");
    }
    // The list shows the start in local time with its time zone, as default names do.
    let started = service.recording("typed").run.started.to_datetime().with_timezone(&chrono::Local);
    assert!(runs.contains(&started.format("%Y-%m-%d %H:%M:%S %:z").to_string()), "{runs}");
}

fn a_note_is_changed_after_the_run_and_the_recorded_file_is_not(service: &Running) {
    let record = |note: &str| {
        service.granted("start", &json!({"name": "noted", "note": note}));
        service.wait_for("writing");
        let (status, refused) = service.post("note", &json!({"name": "noted", "note": "too early"}));
        assert_eq!(status, 404, "{refused}");
        service.granted("stop", &json!({}));
    };
    let listed = || service.get::<Vec<RunLine>>("runs").remove(0).note;
    let table = || text(&service.command(&["export", "--csv", "noted", "--out", "-"]));
    record("typed wrongly");
    let file = service.directory.path().join("noted.mcap");
    let recorded = std::fs::read(&file).unwrap();

    let said = service.command(&["note", "noted", "payload 12 kg"]);
    assert!(said.status.success() && text(&said).contains("`noted`"), "{}", text(&said));
    assert_eq!(listed(), "payload 12 kg");
    let csv = agent().get(service.url("runs/noted/csv")).call().unwrap().body_mut().read_to_string().unwrap();
    for table in [table(), csv] {
        assert!(table.contains("note: payload 12 kg") && !table.contains("typed wrongly"), "{table:.300}");
    }
    assert_eq!(service.granted("note", &json!({"name": "noted", "note": ""})).answer, Granted::Noted);
    assert_eq!(listed(), "");
    assert_eq!(std::fs::read(&file).unwrap(), recorded);

    for (body, expected) in [
        (json!({"name": "noted", "note": "\u{1b}[2J"}), 422),
        (json!({"name": "noted", "note": "a".repeat(5000)}), 422),
        (json!({"name": "../noted", "note": "a"}), 404),
        (json!({"name": "unknown", "note": "a"}), 404),
    ] {
        let (status, refused) = service.post("note", &body);
        assert_eq!(status, expected, "{refused}");
    }
    assert_eq!(listed(), "");

    // If a recording is deleted, its note is deleted as well. If a note has no recording, a new run of the same name does
    // not use the note.
    let beside = service.directory.path().join("noted.note.json");
    let left = std::fs::read(&beside).unwrap();
    service.granted("delete", &json!({"name": "noted"}));
    assert!(!beside.exists());
    std::fs::write(&beside, left).unwrap();
    record("another");
    assert_eq!(listed(), "another");
    std::fs::write(&beside, "torn").unwrap();
    assert!(listed().starts_with("another (a later note cannot be read"), "{}", listed());
}

fn a_deleted_run_lies_in_the_bin_until_it_is_restored_or_the_bin_is_emptied(service: &Running) {
    let record = |note: &str| {
        service.granted("start", &json!({"name": "one", "note": note}));
        service.wait_for("writing");
        service.granted("stop", &json!({}));
    };
    let names = |path: &str| {
        let lines = service.get::<Vec<RunLine>>(path).into_iter();
        lines.map(|line| (line.name, line.note)).collect::<Vec<_>>()
    };
    let named = |name: &str, note: &str| (name.to_owned(), note.to_owned());
    record("first");
    service.granted("note", &json!({"name": "one", "note": "changed"}));
    let deleted = service.command(&["delete", "one"]);
    assert!(text(&deleted).contains("ballbard restore one"), "{}", text(&deleted));
    assert_eq!((names("runs"), names("bin")), (vec![], vec![named("one", "changed")]));
    assert_eq!(service.post("delete", &json!({"name": "one"})).0, 404);
    // Another run gets the same name and is also deleted.
    record("second");
    service.granted("delete", &json!({"name": "one"}));
    assert_eq!(names("bin"), [named("one-2", "second"), named("one", "changed")]);
    let listed = text(&service.command(&["bin"]));
    assert!(listed.contains("one-2") && listed.contains("changed"), "{listed}");
    let restored = service.command(&["restore", "one"]);
    assert!(restored.status.success(), "{}", text(&restored));
    assert_eq!(names("runs"), [named("one", "changed")]);
    assert_eq!(service.recording("one").run.note, "first");
    // A run that is being recorded has no start time yet, and is nevertheless the latest.
    service.granted("start", &json!({"name": "two"}));
    service.wait_for("writing");
    assert_eq!(names("runs").iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["two", "one"]);
    service.granted("stop", &json!({}));
    service.granted("delete", &json!({"name": "two"}));
    for name in ["one", "../one-2", ""] {
        assert_eq!(service.post("restore", &json!({"name": name})).0, 404, "{name}");
    }
    let emptied = service.granted("bin/empty", &json!({}));
    assert_eq!((emptied.answer, emptied.removed), (Granted::Emptied, Some(2)));
    assert_eq!((names("runs"), names("bin")), (vec![named("one", "changed")], vec![]));
    assert_eq!(std::fs::read_dir(service.directory.path().join(".bin")).unwrap().count(), 0);
    assert!(text(&service.command(&["bin", "--empty"])).contains("recordings removed: 0"));
}

fn marks_are_numbered_by_the_service_and_stand_in_status_list_and_file(service: &Running) {
    let reason = json!({"name": "marked", "reason": "the clock is known to be off"});
    service.granted("start", &reason);
    service.wait_for("writing");
    // The page and the command share one numbering of marks.
    assert_eq!(service.granted("mark", &json!({})).mark.as_deref(), Some("mark 1"));
    assert!(text(&service.command(&["mark"])).contains("mark 2"));
    assert_eq!(service.granted("mark", &json!({"text": "here"})).mark.as_deref(), Some("here"));
    assert_eq!(service.granted("mark", &json!({"ago_ms": 0})).mark.as_deref(), Some("mark 3"));
    let texts = |marks: &[RunMark]| marks.iter().map(|mark| mark.text.clone()).collect::<Vec<_>>();
    let run = service.get::<Status>("status").run.unwrap();
    let told = texts(&run.marks);
    assert!(told[0].contains("reason: the clock is known to be off"), "{told:?}");
    assert_eq!(told[1..], ["mark 1", "mark 2", "here", "mark 3"]);
    assert_eq!(run.started_ms, run.started.0 / 1_000_000);
    let last = service.granted("stop", &json!({})).last.unwrap();
    assert!(last.next.unwrap().contains("--robot-log marked.csv "));
    let line = service.get::<Vec<RunLine>>("runs").remove(0);
    assert_eq!((texts(&line.marks), line.started_ms), (told, Some(run.started_ms)));
    assert!(line.marks.iter().zip(&run.marks).all(|(one, other)| (one.at_s - other.at_s).abs() < 0.5));
    let listed = text(&service.command(&["runs"]));
    assert!(listed.contains("the clock is known to be off") && listed.contains("[4 marks]"), "{listed}");
    service.granted("start", &json!({"name": "marked-2"}));
    service.wait_for("writing");
    assert_eq!(
        service.granted("mark", &json!({})).mark.as_deref(),
        Some("mark 1"),
        "numbered from one in each run"
    );
    service.granted("stop", &json!({}));
    assert!(text(&service.command(&["runs"])).contains("[1 mark]"));
}

#[test]
fn without_a_service_the_commands_say_what_to_type() {
    let output = ballbard().args(["status", "--port", "1"]).output().unwrap();
    assert!(!output.status.success(), "{}", text(&output));
    let expected = "start it with `ballbard run --bus INTERFACE --port 1`, or correct --port";
    assert!(text(&output).contains(expected), "{}", text(&output));
}

fn what_the_service_knows_is_asked_for_by_name_and_as_json(service: &Running) {
    let json = |arguments: &[&str]| -> serde_json::Value {
        let output = service.command(&[arguments, &["--json"]].concat());
        serde_json::from_slice(&output.stdout).map_err(|_| text(&output)).unwrap()
    };
    service.wait_until_ready();
    assert_eq!(json(&["start", "--name", "asked.v2", "--reason", "may be late"])["answer"], "begun");
    service.wait_for("writing");
    let status = json(&["status"]);
    assert_eq!((&status["run"]["name"], &status["simulated"]), (&"asked.v2".into(), &true.into()));
    assert_eq!(json(&["mark", "here"])["answer"], "marked");
    let (stopped, listed) = (json(&["stop"]), json(&["runs"]));
    assert!(stopped["verdict"]["level"].is_string(), "{stopped}");
    assert_eq!((&listed[0]["name"], &listed[0]["verdict"]), (&"asked.v2".into(), &stopped["verdict"]));
    let last = service.get::<Status>("status").last.unwrap();
    assert_eq!(json!(last.verdict), stopped["verdict"]);
    let told = text(&service.command(&["status"]));
    assert!(told.contains(&last.verdict.unwrap().to_string()), "{told}");
    assert!(stopped["last"]["simulated"] == true && listed[0]["simulated"] == true, "{stopped} {listed}");
    assert!(json(&["check"]).as_array().unwrap().len() > 5);
    // The export finds the run by its name in any working directory. The name contains a dot. A directory has the same name.
    let elsewhere = tempfile::tempdir().unwrap();
    std::fs::create_dir(elsewhere.path().join("asked.v2")).unwrap();
    let mut export = ballbard();
    export.current_dir(&elsewhere).args(["export", "--csv", "asked.v2", "--port", &service.port]);
    let output = export.output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let table = std::fs::read_to_string(elsewhere.path().join("asked.v2.csv")).unwrap();
    assert!(table.contains("mark: here"));
    // The link of the page and the command must return the same table for spreadsheets.
    let fetched =
        |query: &str| agent().get(&service.url(&format!("runs/asked.v2/csv?{query}"))).call().unwrap();
    let excel = fetched("excel=true&relative").body_mut().read_to_string().unwrap();
    assert!(excel.contains(";angle1_rad;") && excel.contains("mark: here"), "{excel:.300}");
    let typed = service.command(&["export", "asked.v2", "--excel", "--relative", "--out", "-"]);
    assert_eq!(String::from_utf8(typed.stdout).unwrap(), excel);
    assert_eq!(fetched("").body_mut().read_to_string().unwrap(), table);
    assert_eq!(fetched("xlsx").status(), 400);
    let unknown = service.command(&["export", "--csv", "unknown"]);
    assert!(!unknown.status.success() && text(&unknown).contains("`unknown`"), "{}", text(&unknown));
}

fn a_start_that_was_refused_is_no_run_for_status_and_stop(service: &Running) {
    let over = service.get::<Status>("status").runs_over;
    service.granted("start", &json!({"name": "before"}));
    service.wait_for("writing");
    let before = service.granted("stop", &json!({})).last;
    let taken = service.directory.path().join("again.mcap");
    std::fs::write(&taken, "another").unwrap();
    assert_eq!(service.post("start", &json!({"name": "again"})).0, 409);
    let status: Status = service.get("status");
    assert_eq!((status.last, status.runs_over), (before, over + 1));
    let printed = text(&service.command(&["status"]));
    assert!(printed.contains("before.mcap") && !printed.contains("again"), "{printed}");
    std::fs::remove_file(&taken).unwrap();
    service.granted("start", &json!({"name": "again"}));
    service.wait_for("writing");
    let stopped = service.granted("stop", &json!({})).last.unwrap();
    assert_eq!((stopped.file.as_deref(), stopped.error.as_ref()), (taken.to_str(), None));
    assert!(stopped.cycles > 0 && taken.exists());
}
