//! A service with its API and a client. All of them run in one thread, in virtual time.

use std::collections::BTreeMap;
use std::future::Future;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::{Request, header};
use ballbard::control::api;
use ballbard::control::recordings::runs::RunLine;
use ballbard::control::service::Service;
use ballbard::control::status::{Reply, ServiceState, Status};
use ballbard::record::Storage;
use serde_json::{Value, json};
use shared::config::DaemonConfig;
use shared::recording::{Recording, recover_leftovers};
use tower::ServiceExt;

use crate::support::runs::{daemon_in, leave, settings};
use crate::support::wall::{Call, Fault, Wall};
use crate::support::world::{World, now, since, sleep};

/// Number of cycles in the unfinished run that an earlier service left.
const LEFT_CYCLES: u64 = 40;
/// Interval at which a client polls the service.
const POLL_PERIOD: Duration = Duration::from_millis(10);
/// Longest time that the shutdown of a service takes, if no run waits for the disk.
pub const ENDS_WITHIN: Duration = Duration::from_secs(2);

/// Status code and answer of each request, by the name of the request.
pub type Answers = BTreeMap<&'static str, (u16, Value)>;

pub struct Day {
    directory: tempfile::TempDir,
    pub wall: Arc<Wall>,
    pub service: Service,
    routes: Router,
}

/// Simulates a day in virtual time. The disk has the given fault.
pub fn live<T: 'static, F: Future<Output = T> + 'static>(
    fault: Option<(Call, usize, Fault)>,
    day: impl FnOnce(Rc<Day>) -> F + 'static,
) -> T {
    World::live(async move { day(Rc::new(Day::begin(fault, &[]))).await })
}

/// Simulates a day in virtual time. The bus has the given faults. A run ends after three seconds without a valid sample.
pub fn live_on_bus<T: 'static, F: Future<Output = T> + 'static>(
    faults: &'static [&'static str],
    day: impl FnOnce(Rc<Day>) -> F + 'static,
) -> T {
    World::live(async move { day(Rc::new(Day::begin(None, faults))).await })
}

impl Day {
    fn begin(fault: Option<(Call, usize, Fault)>, faults: &[&str]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let daemon = DaemonConfig { sync_period_ms: 200, full_fault_s: 3, ..daemon_in(directory.path()) };
        let settings = settings(daemon, faults);
        let home = &settings.daemon.directory;
        std::fs::create_dir(home).unwrap();
        leave(home, "left", LEFT_CYCLES, false);
        let wall = Arc::new(Wall::new(home, fault));
        let scheduler = World::here().unwrap().scheduler();
        let storage = Storage::on(wall.clone(), &settings.daemon, &*scheduler).unwrap();
        let service = Service::start_in(scheduler, storage, settings).unwrap();
        let routes = api::router(service.clone());
        Self { directory, wall, service, routes }
    }

    async fn ask(&self, method: &str, path: &str, body: &Value) -> (u16, String) {
        let request = Request::builder().method(method).uri(path).header(header::HOST, "127.0.0.1");
        let request = request.header(header::CONTENT_TYPE, "application/json");
        let request = request.body(Body::from(body.to_string())).unwrap();
        let response = self.routes.clone().oneshot(request).await.unwrap();
        let status = response.status().as_u16();
        let answer = to_bytes(response.into_body(), 1 << 20).await.unwrap();
        (status, String::from_utf8(answer.into()).unwrap())
    }

    /// Content of a path of the service as text. It may not be JSON.
    pub async fn text(&self, path: &str) -> String {
        self.ask("GET", path, &json!({})).await.1
    }

    pub async fn get(&self, path: &str) -> (u16, Value) {
        let (status, answer) = self.ask("GET", &format!("/api{path}"), &json!({})).await;
        (status, serde_json::from_str(&answer).unwrap())
    }

    pub async fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        let (status, answer) = self.ask("POST", &format!("/api{path}"), body).await;
        (status, serde_json::from_str(&answer).unwrap())
    }

    /// Posts a request that the service must grant. Returns its reply.
    pub async fn granted(&self, path: &str, body: &Value) -> Reply {
        let (status, reply) = self.post(path, body).await;
        assert_eq!(status, 200, "{path}: {reply}");
        serde_json::from_value(reply).unwrap()
    }

    /// The recordings that the service lists, the latest first.
    pub async fn runs(&self) -> Vec<RunLine> {
        serde_json::from_value(self.get("/runs").await.1).unwrap()
    }

    /// Waits until the condition is true, the service ends, or the time `within` has passed. Returns the last status.
    pub async fn wait(&self, within: Duration, is_it: impl Fn(&Status) -> bool) -> Status {
        let begun = now();
        loop {
            let status = self.service.status();
            if is_it(&status) || since(begun) > within || self.has_ended() {
                return status;
            }
            sleep(POLL_PERIOD).await;
        }
    }

    /// Waits for a state of the service. Panics if the service does not reach the state.
    pub async fn wait_for(&self, state: ServiceState) -> Status {
        let status = self.wait(Duration::from_secs(40), |status| status.state == state).await;
        assert_eq!(status.state, state, "{status:?}");
        status
    }

    /// Waits until the reason in the status contains this text. Panics if it never does.
    pub async fn wait_for_reason(&self, part: &str) -> Status {
        let has_it = |status: &Status| status.reason.as_ref().is_some_and(|reason| reason.contains(part));
        let status = self.wait(Duration::from_secs(40), has_it).await;
        assert!(has_it(&status), "{status:?}");
        status
    }

    pub async fn wait_until_struck(&self) {
        while self.wall.struck_at().is_none() {
            sleep(POLL_PERIOD).await;
        }
    }

    fn has_ended(&self) -> bool {
        self.service.watch().has_changed().is_err()
    }

    pub async fn has_ended_within(&self, within: Duration) -> bool {
        self.wait(within, |_| false).await;
        self.has_ended()
    }

    /// Shuts the service down and waits until it has ended.
    pub async fn end(&self) {
        self.service.shutdown("test over");
        assert!(self.has_ended_within(ENDS_WITHIN).await, "{:?}", self.service.status());
        self.service.join().unwrap();
    }

    pub fn home(&self) -> PathBuf {
        self.directory.path().join("runs")
    }

    pub fn spare(&self) -> PathBuf {
        self.directory.path().join("spare")
    }

    /// Performs all requests of a complete run: check, start, mark, stop and list. Returns the answers.
    pub async fn record(&self) -> Answers {
        let mut answers = BTreeMap::new();
        self.wait(Duration::from_secs(15), |status| status.state == ServiceState::Waiting).await;
        answers.insert("check", self.get("/check").await);
        let start = json!({"name": "day", "reason": "the disk is what is tried"});
        answers.insert("start", self.post("/start", &start).await);
        if answers["start"].0 != 200 {
            let is_ready = |status: &Status| status.state == ServiceState::Waiting && status.reason.is_none();
            self.wait(Duration::from_secs(5), is_ready).await;
            answers.insert("second start", self.post("/start", &start).await);
        }
        let is_written = |status: &Status| status.state == ServiceState::Writing || status.last.is_some();
        self.wait(Duration::from_secs(5), is_written).await;
        answers.insert("mark", self.post("/mark", &json!({"text": "noon"})).await);
        sleep(Duration::from_millis(250)).await;
        answers.insert("stop", self.post("/stop", &json!({})).await);
        answers.insert("runs", self.get("/runs").await);
        answers
    }

    /// Starts a run of this name and waits until its file is being written.
    pub async fn start_run(&self, name: &str) {
        self.granted("/start", &json!({"name": name})).await;
        self.wait_for(ServiceState::Writing).await;
    }

    /// Starts the run `day` and waits until its file is being written.
    pub async fn begin_run(&self) {
        self.wait_for(ServiceState::Waiting).await;
        let start = json!({"name": "day", "reason": "the disk is what is tried"});
        let begun = self.post("/start", &start).await;
        assert_eq!(begun.0, 200, "{begun:?}");
        self.wait_for(ServiceState::Writing).await;
    }

    pub fn recording(&self, name: &str) -> Recording {
        Recording::open(&self.home().join(format!("{name}.mcap"))).unwrap()
    }

    /// Recovers all unfinished files on a disk without faults. Each file must be recovered exactly once.
    pub fn check_files(&self) {
        for place in [self.home(), self.spare()] {
            for leftover in recover_leftovers(&place) {
                // If the disk failed while the first bytes were written, the file of the run contains nothing to recover.
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
