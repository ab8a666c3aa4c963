//! Fuzz target: the HTTP interface of the service gets arbitrary requests.

use std::path::Path;
use std::sync::LazyLock;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::{Method, Request, header};
use ballbard::control::api;
use ballbard::control::service::{Service, Settings};
use ballbard::homing::MarksFile;
use ballbard::run::BusChoice;
use tower::ServiceExt;

/// Longest accepted answer \[bytes\].
const ANSWER_BYTES_MAX: usize = 1 << 20;

/// A service without a bus, so that no request starts a thread or creates a file.
struct Served {
    router: Router,
    runtime: tokio::runtime::Runtime,
}

static SERVED: LazyLock<Served> = LazyLock::new(|| {
    let directory = std::env::temp_dir().join(format!("ballbard-fuzz-{}", std::process::id()));
    let settings = Settings {
        bus: BusChoice::Interface("none-such".into()),
        faults: Vec::new(),
        daemon: crate::daemon(Path::new(&directory)),
        bar: crate::ball_bar(),
        marks_file: MarksFile::new(directory.clone(), None),
        live_tap: None,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    Served { router: api::router(Service::start(settings).expect("a service")), runtime }
});

/// Sends requests to the service, one request per line: `METHOD PATH CONTENT-TYPE HOST BODY`. Each answer must be JSON. If
/// the service refuses a request, the answer must contain a reason.
pub fn any_requests(bytes: &[u8]) {
    for line in bytes.split(|byte| *byte == b'\n') {
        let mut parts = line.splitn(5, |byte| *byte == b' ');
        let mut part = || parts.next().unwrap_or_default();
        let (method, path, kind, host) = (part(), part(), part(), part());
        let request = Request::builder()
            .method(Method::from_bytes(method).unwrap_or(Method::POST))
            .uri(path)
            .header(header::CONTENT_TYPE, kind)
            .header(header::HOST, host)
            .body(Body::from(part().to_vec()));
        if let Ok(request) = request {
            answered(request);
        }
    }
}

fn answered(request: Request<Body>) {
    let head = request.method() == Method::HEAD;
    let answer =
        SERVED.runtime.block_on(SERVED.router.clone().oneshot(request)).expect("a router never fails");
    let kind = answer.headers().get(header::CONTENT_TYPE);
    // The page is not JSON. The event stream has no end, so it cannot be read completely. Both are excluded.
    if answer.status().is_success() && kind.is_none_or(|kind| kind != "application/json") {
        return;
    }
    let (status, body) = (answer.status(), to_bytes(answer.into_body(), ANSWER_BYTES_MAX));
    let body = SERVED.runtime.block_on(body).expect("a body in memory");
    assert!(!status.is_server_error(), "{status}: {}", String::from_utf8_lossy(&body));
    // If a method is not supported, the answer has only a status. The answer to HEAD has no body. Both are excluded.
    if status.as_u16() != 405 && !head {
        let answer: serde_json::Value = serde_json::from_slice(&body).expect("JSON");
        let reason = answer.get("error").and_then(|error| error.as_str());
        assert!(status.is_success() || reason.is_some_and(|reason| !reason.is_empty()), "{status}: {answer}");
    }
}

/// Seeds: requests that the commands of the program send, and invalid requests.
pub fn requests() -> Vec<Vec<u8>> {
    let json = "application/json 127.0.0.1:7311";
    let bodies = [
        format!("POST /api/start {json} {{\"name\":\"monday-1\",\"note\":\"n\",\"duration_s\":12.5}}"),
        format!("POST /api/start {json} {{\"name\":\"../up\",\"operator\":\"\",\"duration_s\":-1e400}}"),
        format!("POST /api/stop {json} {{\"cause\":\"enough\"}}"),
        format!("POST /api/mark {json} {{\"text\":\"second half\"}}"),
        format!("POST /api/note {json} {{\"name\":\"monday-1\",\"note\":\"ball reseated\\nat 10:30\"}}"),
        format!("POST /api/delete {json} {{\"name\":\"../monday-1\"}}"),
        format!(
            "GET /api/runs/monday-1/mcap {json} \nGET /api/runs/%ff/csv {json} \nGET /api/runs/..%2Fmonday-1/csv {json} \nGET /api/live {json} "
        ),
        format!("GET /api/status {json} \nGET /api/check {json} \nGET /api/runs {json} "),
        "POST /api/stop text/plain evil.example {}".to_owned(),
    ];
    bodies.into_iter().map(String::into_bytes).collect()
}
