//! Every call that a service puts to the disk on a whole day fails, hangs, or is the last that the disk answers: it recovers
//! what was left behind, lists, checks, records, and ends.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::{Request, header};
use ballbard::control::api;
use ballbard::control::service::{Service, Settings};
use ballbard::control::status::Status;
use ballbard::run::BusChoice;
use serde_json::{Value, json};
use shared::config::{self, BallBarConfig, DaemonConfig};
use shared::recording::schema::EventKind;
use shared::recording::{Recording, recover_leftovers};
use tower::ServiceExt;

use super::rig::{in_parallel, leave};
use super::wall::{Call, Fault, Wall};

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
            homing_file: home.join("homing.toml"),
        };
        let wall = Arc::new(Wall::new(&home, fault));
        let service = Service::start_on(wall.clone(), settings).unwrap();
        let routes = api::router(service.clone());
        Self { directory, wall, service, routes }
    }

    fn ask(&self, method: &str, path: &str, body: &Value) -> (u16, Value) {
        let path = format!("/api{path}");
        let request = Request::builder().method(method).uri(path).header(header::HOST, "127.0.0.1");
        let request = request.header(header::CONTENT_TYPE, "application/json");
        let request = request.body(Body::from(body.to_string())).unwrap();
        let answered = runtime().block_on(async {
            let response = self.routes.clone().oneshot(request).await.unwrap();
            let status = response.status().as_u16();
            (status, to_bytes(response.into_body(), 1 << 20).await.unwrap())
        });
        (answered.0, serde_json::from_slice(&answered.1).unwrap())
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
        self.wait(Duration::from_secs(15), |status| status.state == "waiting");
        answers.insert("check", self.get("/check"));
        // Encoders that the busy machine has just now no sample of are no matter here.
        let start = json!({"name": "day", "reason": "the disk is what is tried"});
        answers.insert("start", self.post("/start", &start));
        if answers["start"].0 != 200 {
            self.wait(Duration::from_secs(5), |status| status.state == "waiting" && status.reason.is_none());
            answers.insert("second start", self.post("/start", &start));
        }
        self.wait(Duration::from_secs(5), |status| status.state == "writing" || status.last.is_some());
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
        assert!(status.state == "waiting" || status.reason.is_some(), "nobody is told: {status:?}");
        day.service.shutdown("test over");
        let has_ended = day.has_ended(Duration::from_secs(2) + SLACK);
        let status = day.service.status();
        assert!(has_ended || (status.run.is_some() && status.reason.is_some()), "{status:?}");
    });
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
    let mut cases = Vec::new();
    for (&call, &count) in &calls {
        for (nth, &fault) in (0..count).flat_map(|nth| faults.iter().map(move |fault| (nth, fault))) {
            // Hanging takes seconds each time: the first and the last call of a kind do.
            let is_tried = match fault {
                Fault::CutsShort => call.moves_bytes(),
                Fault::Hangs(_) => nth == 0 || nth + 1 == count,
                _ => true,
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
fn whichever_call_of_a_service_fails_what_it_answers_is_true_and_it_ends() {
    check_all(&[Fault::Fails]);
}

#[test]
#[ignore = "takes minutes: dying, cut short and hanging calls"]
fn whatever_becomes_of_any_call_of_a_service_what_it_answers_is_true_and_it_ends() {
    check_all(&[Fault::DiesEverywhere, Fault::CutsShort, Fault::Hangs(HANG), Fault::Hangs(EVER)]);
}
