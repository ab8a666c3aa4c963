//! Reports and reactions of the service when directories and files are changed by other programs.

use std::path::Path;
use std::time::Duration;

use ballbard::control::status::{ServiceState, Status};
use serde_json::json;
use shared::recording::Recording;

use super::bus::line;
use super::rig::live;
use crate::support::runs::leave;
use crate::support::wall::{Call, Fault};
use crate::support::world::sleep;

#[test]
fn a_directory_removed_in_mid_run_is_reported_and_stop_names_a_file_that_is_there() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.start_run("moved").await;
        let before = day.service.status().run.unwrap();
        std::fs::remove_dir_all(day.home()).unwrap();
        day.wait_for_reason("not there any more").await;
        let (_, lines) = day.get("/check").await;
        assert!(line(&lines, "disk")["remedy"].is_string(), "{lines}");
        let stopped = day.granted("/stop", &json!({})).await.last.unwrap();
        let recording = Recording::open(Path::new(&stopped.file.unwrap())).unwrap();
        assert_eq!(recording.cycles.len() as u64, stopped.cycles);
        assert!(stopped.cycles > before.cycles && stopped.cycles_lost == 0);
        day.end().await;
    });
}

#[test]
fn a_file_that_was_missed_once_is_safe_again_when_it_is_in_its_place() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.start_run("missed").await;
        // The next check of the file by the storage fails. The recorder then checks the file, too, and still finds it.
        day.wall.strike_next(Call::IdAt, Fault::Fails);
        day.wait_until_struck().await;
        sleep(Duration::from_secs(3)).await;
        let status = day.service.status();
        let run = status.run.unwrap();
        assert!(run.cycles > 0 && Path::new(&run.file).starts_with(day.home()), "{run:?}");
        day.granted("/stop", &json!({})).await;
        assert_eq!(day.recording("missed").cycles.len() as u64, day.service.status().last.unwrap().cycles);
        day.end().await;
    });
}

#[test]
fn a_run_that_has_no_place_left_is_no_success_for_whoever_stops_it() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.start_run("lost").await;
        // Replaces both directories by files, so that neither accepts a recording any more.
        std::fs::write(day.spare(), "in the way").unwrap();
        std::fs::remove_dir_all(day.home()).unwrap();
        std::fs::write(day.home(), "in the way").unwrap();
        let status = day.wait(Duration::from_secs(40), |status| status.last.is_some()).await;
        let last = status.last.unwrap();
        assert!(last.error.as_ref().unwrap().contains("no part of the run is saved"), "{last:?}");
        assert_eq!((last.file, last.cycles), (None, 0));
        // The directory accepts no files, so no later run uses it, even after this run has been recovered.
        day.wait_for(ServiceState::Waiting).await;
        let (status, refused) = day.post("/start", &json!({"name": "next"})).await;
        assert_eq!(status, 409);
        assert!(refused["error"].as_str().unwrap().contains("cannot be written"), "{refused}");
        day.end().await;
    });
}

#[test]
fn a_run_left_behind_while_the_service_goes_on_is_recovered_when_the_next_one_starts() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        leave(&day.home(), "behind", 40, false);
        std::fs::write(day.home().join("empty.mcap.active"), "").unwrap();
        // The file that a crash left keeps its name when it is recovered. The recovery takes place before the new run, and
        // the answer reports it.
        let (status, refused) = day.post("/start", &json!({"name": "behind"})).await;
        let error = refused["error"].as_str().unwrap();
        assert!(
            status == 409 && error.contains("behind.mcap") && error.contains("just been recovered"),
            "{refused}"
        );
        let recording = day.recording("behind");
        assert!(recording.end.recovered && !recording.cycles.is_empty());
        // An empty file does not prevent a run of the same name.
        day.start_run("empty").await;
        day.granted("/stop", &json!({})).await;
        assert!(!day.recording("empty").cycles.is_empty());
        day.end().await;
    });
}

#[test]
fn status_separates_what_is_taken_what_is_written_and_what_is_synchronised() {
    const SYNC_TAKES: Duration = Duration::from_millis(20);
    let sync_ns = SYNC_TAKES.as_nanos() as u64;
    live(None, async move |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.start_run("parts").await;
        day.wall.strike_next(Call::Sync, Fault::Hangs(SYNC_TAKES));
        let is_measured =
            |status: &Status| status.run.as_ref().is_some_and(|run| run.disk.sync_longest_ns >= sync_ns);
        let run = day.wait(Duration::from_secs(5), is_measured).await.run.unwrap();
        assert!(run.cycles <= run.cycles_written && run.cycles_written <= run.cycles_taken, "{run:?}");
        assert!((59.9..60.1).contains(&run.backlog_limit_s) && run.cycles > 0, "{run:?}");
        assert!(run.disk.sync_longest_ns >= sync_ns, "{run:?}");
        assert!(run.file.ends_with("parts.mcap.active"));
        let (_, lines) = day.get("/check").await;
        let finding = line(&lines, "disk")["finding"].as_str().unwrap();
        assert!(finding.contains("longest until safe on disk"), "{finding}");
        day.granted("/stop", &json!({})).await;
        assert!(day.recording("parts").timing.unwrap().disk.sync_longest_ns >= sync_ns);
        day.end().await;
    });
}

#[test]
fn runs_that_had_to_go_on_in_the_spare_place_are_listed_with_the_others() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.start_run("one").await;
        let file = day.granted("/stop", &json!({})).await.last.unwrap().file.unwrap();
        std::fs::create_dir(day.spare()).unwrap();
        std::fs::copy(file, day.spare().join("two.mcap")).unwrap();
        std::fs::write(day.spare().join("three.mcap.active"), "left behind").unwrap();
        let mut names: Vec<_> = day.runs().await.into_iter().map(|line| line.name).collect();
        names.sort();
        assert_eq!(names, ["left", "one", "three", "two"]);
        let (_, lines) = day.get("/check").await;
        let finding = line(&lines, "left-over files")["finding"].as_str().unwrap();
        assert!(finding.contains("three.mcap.active"), "{finding}");
        // A request names a recording, so no other run may get the name.
        let (_, asked) = day.post("/name", &json!({"name": "two"})).await;
        assert!(asked["problem"].as_str().unwrap().contains("choose another name"), "{asked}");
        let (status, refused) = day.post("/start", &json!({"name": "two"})).await;
        let error = refused["error"].as_str().unwrap();
        assert!(status == 409 && error.contains("spare/two.mcap exists already"), "{refused}");
        day.end().await;
    });
}

#[test]
fn a_directory_that_is_a_file_is_a_problem_before_a_run() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        std::fs::remove_dir_all(day.home()).unwrap();
        std::fs::write(day.home(), "a file").unwrap();
        // The service checks the disk every tenth of a second.
        sleep(Duration::from_secs(1)).await;
        let (_, lines) = day.get("/check").await;
        let disk = line(&lines, "disk");
        assert!(disk["finding"].as_str().unwrap().contains("is not a directory"), "{disk}");
        assert!(disk["remedy"].is_string(), "{disk}");
        day.end().await;
    });
}
