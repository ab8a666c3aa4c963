//! Every call that a service puts to the disk on a whole day fails, hangs, or is the last that the disk answers: it recovers
//! what was left behind, lists, checks, records, and ends.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::{Body, Bytes, to_bytes};
use axum::http::{Request, header};
use ballbard::control::api;
use ballbard::control::service::{Service, Settings};
use ballbard::control::status::{ServiceState, Status};
use ballbard::homing::MarksFile;
use ballbard::run::{BusChoice, RunRequest, Stop, Storage, record_on};
use serde_json::{Value, json};
use shared::config::{self, BallBarConfig, DaemonConfig};
use shared::recording::schema::EventKind;
use shared::recording::{Recording, recover_leftovers};
use shared::time::UtcNs;
use tower::ServiceExt;

use crate::support::runs::{in_parallel, leave};
use crate::support::wall::{Call, Fault, Wall};

/// Longer than a look at the disk may take.
const HANG: Duration = Duration::from_millis(1300);
/// Longer than anybody waits.
const EVER: Duration = Duration::from_secs(8);
/// What a busy machine adds to anything.
const SLACK: Duration = Duration::from_secs(2);
/// Services at once: they mostly wait for the disk and the clock, but more of them keep two processors from answering in time.
const AT_ONCE: usize = 8;
const LEFT_CYCLES: u64 = 40;

struct Day {
    directory: tempfile::TempDir,
    wall: Arc<Wall>,
    service: Service,
    routes: Router,
}

impl Day {
    fn begin(fault: Option<(Call, usize, Fault)>) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let home = directory.path().join("runs");
        std::fs::create_dir(&home).unwrap();
        leave(&home, "left", LEFT_CYCLES, false);
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
        let daemon: DaemonConfig = config::load(&shipped.join("daemon.toml")).unwrap();
        let bar: BallBarConfig = config::load(&shipped.join("ball_bar.toml")).unwrap();
        let daemon = DaemonConfig {
            directory: home.clone(),
            spare_directory: directory.path().join("spare"),
            disk_floor_mb: 0,
            sync_period_ms: 200,
            ..daemon
        };
        let settings = Settings {
            bus: BusChoice::Simulated,
            faults: Vec::new(),
            daemon,
            bar,
            marks: MarksFile::new(home.clone(), None),
            live_tap: None,
        };
        let wall = Arc::new(Wall::new(&home, fault));
        let service = Service::start_on(wall.clone(), settings).unwrap();
        let routes = api::router(service.clone());
        Self { directory, wall, service, routes }
    }

    fn ask(&self, method: &str, path: &str, body: &Value) -> (u16, Value) {
        let (status, answer) = self.send(method, path, body);
        (status, serde_json::from_slice(&answer).unwrap())
    }

    fn send(&self, method: &str, path: &str, body: &Value) -> (u16, Bytes) {
        let path = format!("/api{path}");
        let request = Request::builder().method(method).uri(path).header(header::HOST, "127.0.0.1");
        let request = request.header(header::CONTENT_TYPE, "application/json");
        let request = request.body(Body::from(body.to_string())).unwrap();
        runtime().block_on(async {
            let response = self.routes.clone().oneshot(request).await.unwrap();
            let status = response.status().as_u16();
            (status, to_bytes(response.into_body(), 1 << 20).await.unwrap())
        })
    }

    fn get(&self, path: &str) -> (u16, Value) {
        self.ask("GET", path, &json!({}))
    }

    fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        self.ask("POST", path, body)
    }

    /// Waits for it, or until it is too late for it.
    fn wait(&self, within: Duration, is_it: impl Fn(&Status) -> bool) -> Status {
        let begun = Instant::now();
        loop {
            let status = self.service.status();
            if is_it(&status) || begun.elapsed() > within || self.has_ended(Duration::ZERO) {
                return status;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn has_ended(&self, within: Duration) -> bool {
        runtime().block_on(async { tokio::time::timeout(within, self.service.ended()).await.is_ok() })
    }

    fn home(&self) -> PathBuf {
        self.directory.path().join("runs")
    }

    /// What a person does; what was answered, by path.
    fn live(&self) -> BTreeMap<&'static str, (u16, Value)> {
        let mut answers = BTreeMap::new();
        self.wait(Duration::from_secs(15), |status| status.state == ServiceState::Waiting);
        answers.insert("check", self.get("/check"));
        // Encoders that the busy machine has just now no sample of are no matter here.
        let start = json!({"name": "day", "reason": "the disk is what is tried"});
        answers.insert("start", self.post("/start", &start));
        if answers["start"].0 != 200 {
            self.wait(Duration::from_secs(5), |status| {
                status.state == ServiceState::Waiting && status.reason.is_none()
            });
            answers.insert("second start", self.post("/start", &start));
        }
        self.wait(Duration::from_secs(5), |status| {
            status.state == ServiceState::Writing || status.last.is_some()
        });
        answers.insert("mark", self.post("/mark", &json!({"text": "noon"})));
        std::thread::sleep(Duration::from_millis(250));
        answers.insert("stop", self.post("/stop", &json!({})));
        answers.insert("runs", self.get("/runs"));
        answers
    }

    /// Everything that was left is there once a disk without faults has been asked for it.
    fn check_files(&self) {
        for place in [self.home(), self.directory.path().join("spare")] {
            for leftover in recover_leftovers(&place) {
                // A run whose disk died before its first bytes were whole has none.
                let is_begun = leftover.file.file_stem().is_some_and(|name| name == "day.mcap");
                let error = leftover.outcome.err().map_or(String::new(), |error| error.to_string());
                assert!(
                    error.is_empty() || is_begun && error.contains("nothing can be recovered"),
                    "{error}"
                );
            }
        }
        let left = Recording::open(&self.home().join("left.mcap")).unwrap();
        assert_eq!(left.cycles.len() as u64, LEFT_CYCLES);
    }
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
}

/// What is answered is true, and the service ends.
fn check(call: Call, nth: usize, fault: Fault) {
    let day = Day::begin(Some((call, nth, fault)));
    let answers = day.live();
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
        let is_marked = recording.events.iter().any(|event| event.kind == EventKind::Marker);
        assert_eq!(is_marked, answers["mark"].0 == 200, "{answers:?}");
    } else {
        assert_ne!(fault, Fault::Fails, "the run was lost with one refusal: {answers:?}");
    }
    if answers["runs"].0 == 200 {
        let listed = answers["runs"].1.as_array().unwrap().iter().any(|line| line["name"] == "left");
        assert!(listed || fault == Fault::DiesEverywhere, "{answers:?}");
    }
    day.service.shutdown("test over");
    assert!(day.has_ended(Duration::from_secs(2) + HANG + SLACK), "{:?}", day.service.status());
    // Its claim goes with it: another directory may have this inode next.
    day.service.join().unwrap();
    day.check_files();
}

/// A call that never returns is told, keeps nobody from an answer, and the service from its end only where cycles wait.
fn check_for_ever(call: Call, nth: usize) {
    let day = Day::begin(Some((call, nth, Fault::Hangs(EVER))));
    std::thread::scope(|scope| {
        scope.spawn(|| day.live());
        while day.wall.struck().is_none() {
            if day.service.status().runs_over > 0 {
                // Fewer calls than at the time of counting.
                day.service.shutdown("test over");
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        std::thread::sleep(Duration::from_millis(1200));
        let asked = Instant::now();
        let lines = day.get("/check");
        assert!(asked.elapsed() < Duration::from_secs(1) + SLACK, "check took {:?}", asked.elapsed());
        assert_eq!(lines.0, 200, "{lines:?}");
        let status = day.service.status();
        assert!(
            status.state == ServiceState::Waiting || status.reason.is_some(),
            "nobody is told: {status:?}"
        );
        day.service.shutdown("test over");
        let has_ended = day.has_ended(Duration::from_secs(2) + SLACK);
        let status = day.service.status();
        assert!(has_ended || (status.run.is_some() && status.reason.is_some()), "{status:?}");
    });
}

/// Somebody downloads one run while another goes on.
fn check_download(call: Call, what: &str) {
    const HANG: Duration = Duration::from_secs(3);
    let day = Day::begin(None);
    assert_eq!(day.live()["stop"].0, 200);
    let start = json!({"name": "next", "reason": "the disk is what is tried"});
    assert_eq!(day.post("/start", &start).0, 200);
    day.wait(Duration::from_secs(5), |status| status.state == ServiceState::Writing);
    day.wall.strike_next(call, Fault::Hangs(HANG));
    std::thread::scope(|scope| {
        let download = scope.spawn(|| day.send("GET", &format!("/runs/day/{what}"), &json!({})));
        while day.wall.struck().is_none() {
            assert!(!download.is_finished(), "{call:?} of /runs/day/{what} never reached the disk");
            std::thread::sleep(Duration::from_millis(5));
        }
        let asked = Instant::now();
        let shown = [(); 2].map(|()| {
            std::thread::sleep(Duration::from_millis(300));
            day.get("/live").1["at_ms"].as_i64().unwrap()
        });
        assert!(shown[1] > shown[0], "the page stands still");
        let cycles = day.service.status().run.unwrap().cycles_taken;
        for (status, answer) in
            [day.get("/check"), day.get("/runs"), day.post("/mark", &json!({"text": "meanwhile"}))]
        {
            assert_eq!(status, 200, "{answer}");
        }
        assert!(day.service.status().run.unwrap().cycles_taken >= cycles);
        let (status, stopped) = day.post("/stop", &json!({}));
        assert!(status == 200 && stopped["last"]["cycles_lost"] == 0, "{stopped}");
        assert!(asked.elapsed() < HANG && !download.is_finished(), "somebody waited for the download");
        let (status, bytes) = download.join().unwrap();
        assert!(status == 200 && !bytes.is_empty());
        assert!(what != "mcap" || bytes == std::fs::read(day.home().join("day.mcap")).unwrap());
    });
    day.service.shutdown("test over");
    day.service.join().unwrap();
}

#[test]
fn a_download_that_waits_for_the_disk_holds_up_nobody_else() {
    let of_file = [Call::Open, Call::Length, Call::Read].map(|call| (call, "mcap"));
    let of_content = [(Call::Read, "csv"), (Call::Read, "plot")];
    let cases: Vec<_> = of_file.into_iter().chain(of_content).collect();
    in_parallel(&cases, cases.len(), |(call, what)| check_download(*call, what));
}

/// A day on which a run is being written.
fn recording() -> Day {
    let day = Day::begin(None);
    day.wait(Duration::from_secs(15), |status| status.state == ServiceState::Waiting);
    let start = json!({"name": "day", "reason": "the disk is what is tried"});
    assert_eq!(day.post("/start", &start).0, 200);
    assert_eq!(
        day.wait(Duration::from_secs(10), |status| status.state == ServiceState::Writing).state,
        ServiceState::Writing
    );
    day
}

fn wait_until_struck(day: &Day) {
    while day.wall.struck().is_none() {
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_marker_that_is_set_while_the_disk_hangs_is_answered_at_once_and_has_its_instant() {
    const HANG: Duration = Duration::from_secs(3);
    // However the disk keeps the recorder waiting.
    let cases = [Call::Write, Call::Sync];
    in_parallel(&cases, cases.len(), |call| {
        let day = recording();
        day.wall.strike_next(*call, Fault::Hangs(HANG));
        wait_until_struck(&day);
        std::thread::sleep(Duration::from_millis(500));
        let now = || UtcNs::from_datetime(chrono::Utc::now());
        let (before, asked) = (now(), Instant::now());
        assert_eq!(day.post("/mark", &json!({"text": "noon"})).0, 200);
        assert!(asked.elapsed() < HANG / 2, "{call:?}: answered after {:?}", asked.elapsed());
        let after = now();
        assert_eq!(day.post("/stop", &json!({})).0, 200);
        let recording = Recording::open(&day.home().join("day.mcap")).unwrap();
        let mark = recording.events.iter().find(|event| event.text == "noon").unwrap();
        // Its time keeps to the run's first offset, which the host's may have left meanwhile.
        let slack_ns = 5_000_000;
        let is_then = before.plus_ns(-slack_ns) <= mark.time && mark.time <= after.plus_ns(slack_ns);
        assert!(is_then, "{call:?}: {before:?} {mark:?} {after:?}");
        let of_mark = recording.cycles.iter().rfind(|cycle| cycle.sample_time <= mark.time).unwrap();
        assert!(of_mark.cycle.abs_diff(mark.cycle) <= 1, "{mark:?}, in cycle {}", of_mark.cycle);
        day.service.shutdown("test over");
        day.service.join().unwrap();
    });
}

#[test]
fn cycles_that_are_not_synchronised_are_not_said_to_be_on_disk() {
    let day = recording();
    day.wall.strike_next(Call::Sync, Fault::Hangs(Duration::from_secs(3)));
    wait_until_struck(&day);
    let run = || day.service.status().run.unwrap();
    let before = run();
    std::thread::sleep(Duration::from_secs(1));
    let meanwhile = run();
    assert_eq!(meanwhile.cycles, before.cycles);
    assert!(meanwhile.cycles_written > before.cycles && meanwhile.cycles_taken > before.cycles_taken);
    day.service.shutdown("test over");
    day.service.join().unwrap();
}

#[test]
fn a_run_whose_file_cannot_be_finished_is_no_success_for_who_stops_it() {
    let day = recording();
    day.wall.strike_next(Call::Rename, Fault::DiesEverywhere);
    let (status, answer) = day.post("/stop", &json!({}));
    assert!(status == 500 && answer["error"].as_str().unwrap().contains("run `day`"), "{status} {answer}");
    day.service.shutdown("test over");
    day.service.join().unwrap();
}

#[test]
#[ignore = "takes a quarter of a minute"]
fn a_disk_that_does_not_take_reference_marks_holds_up_nobody() {
    let day = Day::begin(None);
    day.wait(Duration::from_secs(15), |status| status.state == ServiceState::Waiting);
    day.wall.strike_next(Call::Replace, Fault::Hangs(EVER));
    assert_eq!(day.post("/home", &json!({})).0, 200);
    while day.wall.struck().is_none() {
        let status = day.service.status();
        assert!(status.homing.is_some_and(|homing| !homing.is_over), "nothing was kept");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(day.get("/check").0, 200);
    assert_eq!(day.post("/start", &json!({})).0, 409);
    day.service.shutdown("test over");
    assert!(day.has_ended(Duration::from_secs(2) + SLACK), "{:?}", day.service.status());
    assert!(!day.home().join("homing.toml").exists());
    day.service.join().unwrap();
}

#[test]
fn marks_that_the_disk_refuses_were_found_but_are_not_kept() {
    let day = Day::begin(None);
    day.wait(Duration::from_secs(15), |status| status.state == ServiceState::Waiting);
    day.wall.strike_next(Call::Replace, Fault::Fails);
    let home = || {
        assert_eq!(day.post("/home", &json!({})).0, 200);
        let is_over = |status: &Status| status.homing.as_ref().is_some_and(|homing| homing.is_over);
        day.wait(Duration::from_secs(40), is_over).homing.unwrap().error.unwrap()
    };
    // A second without an answer from emulated terminals ends a homing; a busy machine gives such seconds.
    let error = std::iter::repeat_with(home).find(|error| !error.contains("no valid counts")).unwrap();
    for told in ["of all joints were found, but not kept", "homing.toml", "free space", "home again"] {
        assert!(error.contains(told), "`{told}` is missing in: {error}");
    }
    day.service.shutdown("test over");
    day.service.join().unwrap();
}

/// What a command that records one run answers, asked to end while the disk hangs at `call` before the run has a file.
fn check_record(call: Call, nth: usize, is_fast: bool) {
    let directory = tempfile::tempdir().unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
    let bar: BallBarConfig = config::load(&shipped.join("ball_bar.toml")).unwrap();
    let daemon = DaemonConfig {
        directory: directory.path().join("runs"),
        spare_directory: directory.path().join("spare"),
        disk_floor_mb: 0,
        ..DaemonConfig::default()
    };
    let wall = Arc::new(Wall::new(&daemon.directory, Some((call, nth, Fault::Hangs(EVER)))));
    let storage = Storage::on(wall.clone(), &daemon).unwrap();
    let request = RunRequest { name: "day".into(), duration: None, fast: is_fast, ..RunRequest::default() };
    // A busy machine may keep an emulated terminal from answering in time: then it is tried again.
    let request =
        RunRequest { duration: is_fast.then_some(Duration::from_secs(3600)), wait: !is_fast, ..request };
    let stop = Stop::default();
    std::thread::scope(|scope| {
        let recording = scope.spawn(|| {
            let outcome = record_on(&storage, &request, &daemon, &bar, &stop);
            (outcome, Instant::now())
        });
        while wall.struck().is_none() {
            assert!(!recording.is_finished(), "it never came to {call:?} number {nth}");
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(Duration::from_millis(800));
        let asked = Instant::now();
        stop.stop("stopped by SIGTERM");
        let (outcome, ended) = recording.join().unwrap();
        assert!(ended - asked < Duration::from_secs(2), "{call:?}: ended after {:?}", ended - asked);
        let error = outcome.unwrap_err().to_string();
        for word in ["stopped by SIGTERM", "nothing was recorded", "disk"] {
            assert!(error.contains(word), "`{word}` is missing in: {error}");
        }
    });
}

#[test]
fn a_command_that_is_asked_to_end_before_the_disk_gave_its_run_a_file_ends_within_two_seconds() {
    // Before the claim, its lock, and what gives the run its file.
    let calls = [Call::MakeDirectory, Call::Lock, Call::List, Call::Rename, Call::SyncDirectory];
    let mut cases: Vec<_> = calls.map(|call| (call, 0, false)).into();
    cases.extend([(Call::Create, 0, false), (Call::Create, 0, true), (Call::List, 0, true)]);
    in_parallel(&cases, cases.len(), |(call, nth, is_fast)| check_record(*call, *nth, *is_fast));
}

fn check_all(faults: &[Fault]) {
    let clean = Day::begin(None);
    let answers = clean.live();
    assert!(answers.values().all(|(status, _)| *status == 200), "{answers:?}");
    clean.service.shutdown("test over");
    assert!(clean.has_ended(Duration::from_secs(2) + SLACK));
    clean.service.join().unwrap();
    clean.check_files();
    let calls = clean.wall.calls();
    let each: usize = std::env::var("CALLS_EACH").map_or(1, |each| each.parse().unwrap());
    let mut cases = Vec::new();
    for (&call, &count) in &calls {
        for (nth, &fault) in (0..count).flat_map(|nth| faults.iter().map(move |fault| (nth, fault))) {
            // Hanging takes seconds each time: the first and the last call of a kind do.
            let is_tried = match fault {
                Fault::CutsShort => call.moves_bytes() && nth % each == 0,
                Fault::Hangs(_) => nth == 0 || nth + 1 == count,
                Fault::Fails => true,
                _ => nth % each == 0,
            };
            if is_tried {
                cases.push((call, nth, fault));
            }
        }
    }
    in_parallel(&cases, AT_ONCE, |(call, nth, fault)| match fault {
        Fault::Hangs(EVER) => check_for_ever(*call, *nth),
        fault => check(*call, *nth, *fault),
    });
    println!("{} calls, {} cases, 0 failures: {calls:?}", calls.values().sum::<usize>(), cases.len());
}

#[test]
#[ignore = "takes a minute"]
fn whichever_call_of_a_service_fails_what_it_answers_is_true_and_it_ends() {
    check_all(&[Fault::Fails]);
}

#[test]
#[ignore = "takes minutes: dying, cut short and hanging calls; CALLS_EACH=3 takes a third of the former two"]
fn whatever_becomes_of_any_call_of_a_service_what_it_answers_is_true_and_it_ends() {
    check_all(&[Fault::DiesEverywhere, Fault::CutsShort, Fault::Hangs(HANG), Fault::Hangs(EVER)]);
}
