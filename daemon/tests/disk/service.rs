//! Effects of a hanging disk in real time. The tests examine the threads that serve downloads, and a cycle that
//! advances its own virtual time.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::{Body, Bytes, to_bytes};
use axum::http::{Request, header};
use ballbard::clock::Clock;
use ballbard::control::api;
use ballbard::control::service::Service;
use ballbard::control::status::{ServiceState, Status};
use ballbard::run::{self, RunDetails, RunRequest, Setup, Stop, Storage};
use ballbard::scheduler::Threads;
use serde_json::{Value, json};
use shared::config::DaemonConfig;
use tower::ServiceExt;

use crate::support::runs::{bar, daemon_in, in_parallel, settings};
use crate::support::wall::{Call, Fault, Wall};

/// Longest time that a few answers take on a busy machine.
const SLACK: Duration = Duration::from_secs(20);
/// Duration of a hang that is longer than any client waits.
const EVER: Duration = Duration::from_secs(60);

struct Day {
    directory: tempfile::TempDir,
    wall: Arc<Wall>,
    service: Service,
    routes: Router,
}

impl Day {
    fn begin() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let daemon = DaemonConfig { sync_period_ms: 300, ..daemon_in(directory.path()) };
        let settings = settings(daemon, &[]);
        let home = &settings.daemon.directory;
        std::fs::create_dir(home).unwrap();
        let wall = Arc::new(Wall::new(home, None));
        let scheduler = Threads::on(Clock::Real);
        let storage = Storage::on(wall.clone(), &settings.daemon, &*scheduler).unwrap();
        let service = Service::start_in(scheduler, storage, settings).unwrap();
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

    /// Waits for a state of the service. Panics if the service does not reach the state.
    fn wait_for(&self, state: ServiceState) {
        let begun = Instant::now();
        let is_there = |status: &Status| status.state == state;
        while !is_there(&self.service.status()) {
            assert!(begun.elapsed() < 2 * SLACK, "{:?}", self.service.status());
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn record(&self, name: &str) {
        let start = json!({"name": name, "reason": "the disk is what is tried"});
        let (status, answer) = self.post("/start", &start);
        assert_eq!(status, 200, "{answer}");
        self.wait_for(ServiceState::Writing);
    }

    fn home(&self) -> PathBuf {
        self.directory.path().join("runs")
    }
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
}

/// Downloads the run `day` in the form `what`, while the disk hangs and another run is recorded.
fn check_download(day: &Day, what: &str) {
    day.record(&format!("besides-{what}"));
    day.wall.strike_next(Call::Read, Fault::Hangs(SLACK));
    std::thread::scope(|scope| {
        let download = scope.spawn(|| day.send("GET", &format!("/runs/day/{what}"), &json!({})));
        while day.wall.struck().is_none() {
            assert!(!download.is_finished(), "/runs/day/{what} never reached the disk");
            std::thread::sleep(Duration::from_millis(5));
        }
        let shown = || day.get("/live").1["at_ms"].as_i64().unwrap();
        let first = shown();
        while shown() == first {
            assert!(!download.is_finished(), "the page stands still");
            std::thread::sleep(Duration::from_millis(10));
        }
        let cycles = day.service.status().run.unwrap().cycles_taken;
        for (status, answer) in
            [day.get("/check"), day.get("/runs"), day.post("/mark", &json!({"text": "meanwhile"}))]
        {
            assert_eq!(status, 200, "{answer}");
        }
        assert!(day.service.status().run.unwrap().cycles_taken >= cycles);
        let (status, stopped) = day.post("/stop", &json!({}));
        assert!(status == 200 && stopped["last"]["cycles_lost"] == 0, "{stopped}");
        assert!(!download.is_finished(), "the run waited for the download");
        day.wall.release();
        let (status, bytes) = download.join().unwrap();
        assert!(status == 200 && !bytes.is_empty());
        assert!(what != "mcap" || bytes == std::fs::read(day.home().join("day.mcap")).unwrap());
    });
}

#[test]
fn a_download_that_waits_for_the_disk_holds_up_nobody_else() {
    let day = Day::begin();
    day.wait_for(ServiceState::Waiting);
    day.record("day");
    assert_eq!(day.post("/stop", &json!({})).0, 200);
    for what in ["mcap", "csv", "plot"] {
        check_download(&day, what);
    }
    day.service.shutdown("test over");
    day.service.join().unwrap();
}

/// Runs `ballbard record` in virtual time of its own. Interrupts the command while the disk hangs at `call`, before the run
/// has a file. The command must end soon, and must report both the interruption and the disk.
fn check_record(call: Call) {
    let directory = tempfile::tempdir().unwrap();
    let daemon = daemon_in(directory.path());
    let wall = Arc::new(Wall::new(&daemon.directory, Some((call, 0, Fault::Hangs(EVER)))));
    let duration = Some(Duration::from_secs(3600));
    let run = RunDetails { name: "day".into(), duration, ..RunDetails::default() };
    let request = RunRequest { run, fast: true, ..RunRequest::default() };
    let stop = Stop::default();
    std::thread::scope(|scope| {
        let recording = scope.spawn(|| {
            let scheduler = Threads::on(Clock::Real);
            let storage = Storage::on(wall.clone(), &daemon, &*scheduler).unwrap();
            let setup = Setup { scheduler, storage, daemon: daemon.clone(), bar: bar() };
            (runtime().block_on(run::record(&setup, &request, &stop)), Instant::now())
        });
        while wall.struck().is_none() {
            assert!(!recording.is_finished(), "it never came to {call:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(Duration::from_millis(800));
        let asked = Instant::now();
        stop.stop("stopped by SIGTERM");
        let (outcome, ended) = recording.join().unwrap();
        assert!(ended - asked < SLACK, "{call:?}: ended after {:?}", ended - asked);
        let error = outcome.unwrap_err().to_string();
        for word in ["stopped by SIGTERM", "nothing was recorded", "disk"] {
            assert!(error.contains(word), "`{word}` is missing in: {error}");
        }
    });
}

#[test]
fn a_fast_command_that_is_asked_to_end_before_the_disk_gave_its_run_a_file_does_not_wait_for_the_disk() {
    in_parallel(&[Call::Create, Call::List], 2, |call| check_record(*call));
}
