//! While the disk hangs, the service answers every request, and each answer is true.

use std::cell::Cell;
use std::io::{self, Write};
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::control::status::{ServiceState, Status};
use ballbard::record::{self, Limits, RunProgress, Stop, Storage};
use serde_json::{Value, json};
use shared::config::DaemonConfig;
use shared::recording::{Recording, RecordingWriter};
use shared::time::UtcNs;

use super::rig::{Day, live};
use crate::support::runs::{daemon_in, in_parallel, metadata};
use crate::support::wall::{Call, Fault, Wall};
use crate::support::world::{World, now, since, sleep};

const HANG: Duration = Duration::from_secs(3);

#[test]
fn a_marker_that_is_set_while_the_disk_hangs_is_answered_at_once_and_has_its_instant() {
    // Calls of the recorder. The test must pass with a hang of either call.
    let cases = [Call::Write, Call::Sync];
    in_parallel(&cases, cases.len(), |call| {
        let call = *call;
        live(None, async move |day| {
            day.begin_run().await;
            day.wall.strike_next(call, Fault::Hangs(HANG));
            day.wait_until_struck().await;
            sleep(Duration::from_millis(500)).await;
            let before = now();
            assert_eq!(day.post("/mark", &json!({"text": "noon"})).await.0, 200);
            let after = now();
            assert!(since(before) < Duration::from_millis(200), "{call:?}: after {:?}", since(before));
            assert_eq!(day.post("/stop", &json!({})).await.0, 200);
            let recording = Recording::open(&day.home().join("day.mcap")).unwrap();
            let mark = recording.events.iter().find(|event| event.text == "noon").unwrap();
            let offset_ns = recording.run.utc_minus_monotonic_ns;
            let [before, after] = [before, after].map(|at| UtcNs(at.0 + offset_ns));
            assert!(before <= mark.time && mark.time <= after, "{call:?}: {before:?} {mark:?} {after:?}");
            let of_mark = recording.cycles.iter().rfind(|cycle| cycle.sample_time <= mark.time).unwrap();
            assert!(of_mark.cycle.abs_diff(mark.cycle) <= 1, "{mark:?}, in cycle {}", of_mark.cycle);
            day.end().await;
        });
    });
}

#[test]
fn cycles_that_are_not_synchronised_are_not_said_to_be_on_disk() {
    live(None, async |day| {
        day.begin_run().await;
        day.wall.strike_next(Call::Sync, Fault::Hangs(HANG));
        day.wait_until_struck().await;
        let before = day.service.status().run.unwrap();
        sleep(Duration::from_secs(1)).await;
        let meanwhile = day.service.status().run.unwrap();
        assert_eq!(meanwhile.cycles, before.cycles);
        assert!(meanwhile.cycles_written > before.cycles && meanwhile.cycles_taken > before.cycles_taken);
    });
}

#[test]
fn a_run_whose_file_cannot_be_finished_is_no_success_for_who_stops_it() {
    live(None, async |day| {
        day.begin_run().await;
        day.wall.strike_next(Call::Rename, Fault::DiesEverywhere);
        let (status, answer) = day.post("/stop", &json!({})).await;
        assert!(
            status == 500 && answer["error"].as_str().unwrap().contains("run `day`"),
            "{status} {answer}"
        );
        day.end().await;
    });
}

#[test]
fn a_download_whose_file_the_disk_does_not_open_is_refused_and_holds_up_nobody_else() {
    let cases = [Call::Open, Call::Length];
    in_parallel(&cases, cases.len(), |call| {
        let call = *call;
        live(None, async move |day| {
            day.begin_run().await;
            day.granted("/stop", &json!({})).await;
            day.start_run("next").await;
            day.wall.strike_next(call, Fault::Hangs(Duration::from_secs(20)));
            let asking = Rc::clone(&day);
            let answered = Rc::<Cell<Option<u16>>>::default();
            let told = Rc::clone(&answered);
            World::here().unwrap().spawn(async move {
                told.set(Some(asking.get("/runs/day/mcap").await.0));
            });
            day.wait_until_struck().await;
            let (_, first) = day.get("/live").await;
            sleep(Duration::from_millis(200)).await;
            assert_ne!(day.get("/live").await.1["at_ms"], first["at_ms"], "the page stands still");
            for (status, answer) in [
                day.get("/check").await,
                day.get("/runs").await,
                day.post("/mark", &json!({"text": "meanwhile"})).await,
            ] {
                assert_eq!(status, 200, "{answer}");
            }
            let stopped = day.granted("/stop", &json!({})).await.last.unwrap();
            assert_eq!(stopped.cycles_lost, 0);
            assert_eq!(answered.get(), None, "the run waited for the download");
            day.wait(Duration::from_secs(15), |_| answered.get().is_some()).await;
            assert_eq!(answered.get(), Some(504));
            day.end().await;
        });
    });
}

#[test]
fn a_disk_that_does_not_take_reference_marks_holds_up_nobody() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.wall.strike_next(Call::Replace, Fault::Hangs(Duration::from_secs(60)));
        assert_eq!(day.post("/home", &json!({})).await.0, 200);
        day.wait_until_struck().await;
        let status = day.service.status();
        assert!(status.homing.is_some_and(|homing| !homing.is_over), "nothing was kept");
        assert_eq!(day.get("/check").await.0, 200);
        assert_eq!(day.post("/start", &json!({})).await.0, 409);
        day.end().await;
        assert!(!day.home().join("homing.toml").exists());
    });
}

#[test]
fn marks_that_the_disk_refuses_were_found_but_are_not_kept() {
    live(None, async |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.wall.strike_next(Call::Replace, Fault::Fails);
        assert_eq!(day.post("/home", &json!({})).await.0, 200);
        let is_over = |status: &Status| status.homing.as_ref().is_some_and(|homing| homing.is_over);
        let status = day.wait(Duration::from_secs(600), is_over).await;
        let error = status.homing.unwrap().error.unwrap();
        for part in ["of all joints were found, but not saved", "homing.toml", "free space", "home again"] {
            assert!(error.contains(part), "`{part}` is missing in: {error}");
        }
        day.end().await;
    });
}

/// Runs a day in which creating the next file hangs for the duration `hang`, and then calls `then`. A run that `then` starts
/// has no file until the hang ends.
fn without_file<T: 'static>(hang: Duration, then: impl AsyncFnOnce(Rc<Day>) -> T + 'static) -> T {
    live(None, async move |day| {
        day.wait_for(ServiceState::Waiting).await;
        day.wall.strike_next(Call::Create, Fault::Hangs(hang));
        then(day).await
    })
}

#[test]
fn while_the_disk_makes_no_file_everybody_is_answered_and_no_cycle_is_lost() {
    without_file(HANG, async |day| {
        let begun = now();
        let asking = Rc::clone(&day);
        let answered = Rc::<Cell<Option<Duration>>>::default();
        let told = Rc::clone(&answered);
        World::here().unwrap().spawn(async move {
            assert_eq!(asking.post("/start", &json!({"name": "late"})).await.0, 200);
            told.set(Some(since(begun)));
        });
        let has_reason = |status: &Status| {
            status.reason.as_ref().is_some_and(|reason| reason.contains("the disk has been creating it"))
        };
        let status = day.wait(Duration::from_secs(5), has_reason).await;
        assert!(has_reason(&status) && status.state == ServiceState::Opening, "{status:?}");
        let asked = now();
        let (_, lines) = day.get("/check").await;
        assert!(since(asked) < Duration::from_millis(1200), "{:?}", since(asked));
        let is_told = |line: &Value| {
            line["subject"] == "disk" && line["finding"].as_str().unwrap().contains("no file yet")
        };
        assert!(lines.as_array().unwrap().iter().any(is_told), "{lines}");
        assert_eq!(answered.get(), None);
        day.wait_for(ServiceState::Writing).await;
        assert!(answered.get().is_some_and(|after| after >= HANG), "{answered:?}");
        day.end().await;
        let recording = Recording::open(&day.home().join("late.mcap")).unwrap();
        // The run begins with its request, seconds before the file existed. Its cycles are counted from that time.
        assert!(recording.cycles.len() > 300 && recording.end.cycles_lost == 0, "{:?}", recording.end);
        assert!(recording.cycles.iter().all(|cycle| cycle.is_valid()));
    });
}

#[test]
fn a_run_that_is_called_off_before_it_has_its_file_ends_with_the_file() {
    without_file(HANG, async |day| {
        let asking = Rc::clone(&day);
        World::here().unwrap().spawn(async move {
            assert_eq!(asking.post("/start", &json!({"name": "late"})).await.0, 200);
        });
        day.wait_until_struck().await;
        let (status, stopped) = day.post("/stop", &json!({"cause": "called off"})).await;
        assert!(status == 200 && stopped["last"]["cause"] == "called off", "{stopped}");
        assert_eq!(stopped["last"]["error"], Value::Null);
        day.end().await;
    });
}

#[test]
fn a_disk_that_makes_no_file_keeps_no_service_from_its_end() {
    without_file(Duration::from_secs(60), async |day| {
        let asking = Rc::clone(&day);
        World::here().unwrap().spawn(async move {
            assert_ne!(asking.post("/start", &json!({"name": "late"})).await.0, 200, "the run has begun");
        });
        day.wait_until_struck().await;
        day.end().await;
    });
}

#[test]
fn a_disk_that_does_not_answer_is_reported_within_a_second_to_who_asks_and_in_the_log() {
    let log = Arc::<Mutex<Vec<u8>>>::default();
    let lines = Arc::clone(&log);
    let subscriber = tracing_subscriber::fmt().with_writer(move || Log(Arc::clone(&lines))).finish();
    let _logging = tracing::subscriber::set_default(subscriber);
    World::live(async move {
        let directory = tempfile::tempdir().unwrap();
        let daemon = DaemonConfig { directory: directory.path().to_owned(), ..DaemonConfig::default() };
        let wall = Arc::new(Wall::new(directory.path(), Some((Call::Space, 3, Fault::Hangs(HANG)))));
        let scheduler = World::here().unwrap().scheduler();
        let storage = Storage::on(wall.clone(), &daemon, &*scheduler).unwrap();
        while wall.struck_at().is_none() {
            sleep(Duration::from_millis(5)).await;
        }
        let text = format!("the disk of {} has not answered for", directory.path().display());
        let is_logged = || String::from_utf8_lossy(&log.lock().unwrap()).contains(&text);
        let is_told = || storage.problem().is_some_and(|problem| problem.text.contains(&text));
        let struck = wall.struck_at().unwrap();
        while !is_logged() || !is_told() {
            assert!(since(struck) < Duration::from_secs(1), "not reported");
            sleep(Duration::from_millis(5)).await;
        }
    });
}

#[test]
fn while_a_run_is_at_its_spare_place_the_disk_of_that_one_does_not_answer() {
    World::live(async move {
        let directory = tempfile::tempdir().unwrap();
        let daemon = daemon_in(directory.path());
        let wall = Arc::new(Wall::new(&daemon.directory, None));
        let world = World::here().unwrap();
        let storage = Storage::on(wall.clone(), &daemon, &*world.scheduler()).unwrap();
        let period = Duration::from_millis(10);
        let writer = RecordingWriter::create_on(storage.disk(), storage.spare(), &metadata(period)).unwrap();
        let (_sink, source) = record::ring(100, record::FullRing::Drops);
        let limits = Limits {
            cycle_period: period,
            sync_period: daemon.sync_period(),
            ring_cycles: 100,
            cycle_waits: false,
        };
        let progress = Arc::new(RunProgress::new(Arc::clone(source.handed()), limits, world.clock.clone()));
        progress.opened(writer.sink().place().clone());
        storage.watch(&progress, &Stop::default());
        wall.strike_next(Call::Space, Fault::Hangs(HANG));
        while wall.struck_at().is_none() {
            sleep(Duration::from_millis(5)).await;
        }
        sleep(Duration::from_secs(1)).await;
        let text = storage.problem().unwrap().text;
        let expected = format!("the disk of {} has not answered for", storage.spare().display());
        assert!(text.contains(&expected), "{text}");
    });
}

/// A writer that collects the log in memory.
struct Log(Arc<Mutex<Vec<u8>>>);

impl Write for Log {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(line)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
