//! The service over HTTP on 127.0.0.1: JSON in, JSON out.
//!
//! Only programs of this machine reach it. Web pages of others do not, although a browser runs here: requests must name
//! a loopback host (no rebinding of names), come from no foreign origin, and carry JSON (no plain forms).

use std::future::Future;
use std::time::Duration;

use axum::extract::rejection::JsonRejection;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use tokio::net::TcpListener;

use super::connections::Connections;
use super::machine::Answer;
use super::runs;
use super::service::Service;
use super::status::{HomeRequest, LastRun, MarkRequest, Refusal, Reply, StartRequest, Status, StopRequest};
use crate::run::check_text;

/// How long `start` waits for the run's file, and `stop` for the finished one.
const FILE_TIMEOUT: Duration = Duration::from_secs(20);
/// After an error of the listener, such as too many open files.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Serves until `end` comes, then finishes the requests that are being answered, as far as their clients let it.
pub async fn serve(listener: TcpListener, service: Service, end: impl Future<Output = ()>) {
    let mut connections = Connections::new(router(service));
    tokio::pin!(end);
    loop {
        tokio::select! {
            () = &mut end => break,
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => connections.add(stream),
                Err(error) => {
                    tracing::warn!("a client cannot be served: {error}");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            },
        }
        // Requests that are there already are read before many new connections push theirs out.
        tokio::task::yield_now().await;
    }
    drop(listener);
    connections.finish().await;
}

/// All routes.
pub fn router(service: Service) -> Router {
    Router::new()
        .route("/status", get(status))
        .route("/check", get(check))
        .route("/runs", get(list_runs))
        .route("/start", post(start))
        .route("/stop", post(stop))
        .route("/home", post(home))
        .route("/mark", post(mark))
        .fallback(|| async { refusal(StatusCode::NOT_FOUND, "no such path") })
        .layer(middleware::from_fn(only_this_machine))
        .with_state(service)
}

type Body<T> = Result<Json<T>, JsonRejection>;

async fn status(State(service): State<Service>) -> Response {
    Json(service.status()).into_response()
}

async fn check(State(service): State<Service>) -> Response {
    match service.check().await {
        Ok(lines) => Json(lines).into_response(),
        Err(Refusal { error }) => refusal(StatusCode::SERVICE_UNAVAILABLE, &error),
    }
}

async fn list_runs(State(service): State<Service>) -> Response {
    match service.runs().await {
        Some(Ok(lines)) => Json(lines).into_response(),
        // A directory that is not there yet holds no runs.
        Some(Err(error)) if error.kind() == std::io::ErrorKind::NotFound => {
            Json(Vec::<runs::RunLine>::new()).into_response()
        }
        Some(Err(error)) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &format!("cannot list runs: {error}")),
        None => refusal(StatusCode::GATEWAY_TIMEOUT, "cannot list runs: the disk does not answer"),
    }
}

async fn start(State(service): State<Service>, body: Body<StartRequest>) -> Response {
    let request = match body {
        Ok(Json(request)) => request,
        Err(rejection) => return rejected(&rejection),
    };
    let texts = [&request.operator, &request.robot, &request.note];
    if let Err(problem) = texts.iter().try_for_each(|text| check_text(text)) {
        return refusal(StatusCode::UNPROCESSABLE_ENTITY, problem);
    }
    let named = request.name.clone();
    let Ok(answer) = tokio::time::timeout(FILE_TIMEOUT, service.begin(request)).await else {
        let why = service.status().reason.unwrap_or_default();
        let error = format!("the run waits for its file; `ballbard stop` calls it off: {why}");
        return refusal(StatusCode::GATEWAY_TIMEOUT, &error);
    };
    match answer {
        Ok(Answer::Beginning) => reply("begun", service.status().run.map(|run| run.name).or(named), None),
        Ok(Answer::Running(run)) => reply("running", Some(run), None),
        Ok(Answer::Busy(run)) => refusal(
            StatusCode::CONFLICT,
            &format!("run `{run}` goes on; stop it first, or wait until its file is finished"),
        ),
        Ok(Answer::Refused(reason)) => refusal(StatusCode::CONFLICT, &reason),
        Ok(other) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &format!("unexpected answer {other:?}")),
        Err(Refusal { error }) => refusal(StatusCode::UNPROCESSABLE_ENTITY, &error),
    }
}

async fn stop(State(service): State<Service>, body: Body<StopRequest>) -> Response {
    let cause = match body {
        Ok(Json(request)) => request.cause.unwrap_or_else(|| "stopped".into()),
        Err(rejection) => return rejected(&rejection),
    };
    if let Err(problem) = some_text(&cause) {
        return refusal(StatusCode::UNPROCESSABLE_ENTITY, problem);
    }
    match service.stop(cause).await {
        Ok((Answer::Stopping(run), runs_over)) => match finished(&service, runs_over).await {
            // A run whose file could not be finished is no success.
            Some(last) if last.error.is_some() => {
                refusal(StatusCode::INTERNAL_SERVER_ERROR, &format!("run `{run}`: {}", last.cause))
            }
            Some(last) => reply("stopped", Some(run), Some(last)),
            None => refusal(
                StatusCode::GATEWAY_TIMEOUT,
                &format!("run `{run}` is ending, but the disk has not taken it yet; ask for the status"),
            ),
        },
        Ok((Answer::Homing, _)) => reply("homing", None, None),
        Ok(_) => reply("idle", None, service.status().last),
        Err(Refusal { error }) => refusal(StatusCode::SERVICE_UNAVAILABLE, &error),
    }
}

async fn home(State(service): State<Service>, body: Body<HomeRequest>) -> Response {
    if let Err(rejection) = body {
        return rejected(&rejection);
    }
    match service.home().await {
        Ok(Answer::Beginning | Answer::Homing) => reply("homing", None, None),
        Ok(Answer::Busy(run)) => {
            refusal(StatusCode::CONFLICT, &format!("run `{run}` goes on; encoders are homed between runs"))
        }
        Ok(Answer::Refused(reason)) => refusal(StatusCode::CONFLICT, &reason),
        Ok(other) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &format!("unexpected answer {other:?}")),
        Err(Refusal { error }) => refusal(StatusCode::SERVICE_UNAVAILABLE, &error),
    }
}

async fn mark(State(service): State<Service>, body: Body<MarkRequest>) -> Response {
    let text = match body {
        Ok(Json(MarkRequest { text })) => text,
        Err(rejection) => return rejected(&rejection),
    };
    if let Err(problem) = some_text(&text) {
        return refusal(StatusCode::UNPROCESSABLE_ENTITY, problem);
    }
    match service.mark(text).await {
        Ok(Some(run)) => reply("marked", Some(run), None),
        Ok(None) => refusal(StatusCode::CONFLICT, "no run goes on, so there is nothing to mark"),
        Err(Refusal { error }) => refusal(StatusCode::SERVICE_UNAVAILABLE, &error),
    }
}

fn some_text(text: &str) -> Result<(), &'static str> {
    if text.is_empty() { Err("the text is empty; say something") } else { check_text(text) }
}

/// Waits until one more run is over than were.
async fn finished(service: &Service, runs_over: u64) -> Option<LastRun> {
    let mut status = service.watch();
    let over = |status: &Status| status.runs_over > runs_over;
    let wait = async { status.wait_for(over).await.ok().and_then(|status| status.last.clone()) };
    tokio::time::timeout(FILE_TIMEOUT, wait).await.ok().flatten()
}

/// Turns away what a foreign web page could send.
async fn only_this_machine(request: Request, next: Next) -> Response {
    if is_local(request.headers()) {
        next.run(request).await
    } else {
        refusal(StatusCode::FORBIDDEN, "only programs of this machine may use this")
    }
}

fn is_local(headers: &HeaderMap) -> bool {
    let loopback = |authority: &str| {
        let host = authority.rsplit_once(':').map_or(authority, |(host, _)| host);
        ["127.0.0.1", "localhost", "[::1]"].contains(&host)
    };
    // What one reader takes from the first of two headers another takes from the last: none may be foreign.
    let all = |name: HeaderName, is_ours: &dyn Fn(&str) -> bool| {
        headers.get_all(name).iter().all(|value| value.to_str().is_ok_and(is_ours))
    };
    headers.contains_key(header::HOST)
        && all(header::HOST, &loopback)
        && all(header::ORIGIN, &|origin| origin.strip_prefix("http://").is_some_and(loopback))
}

fn reply(answer: &str, run: Option<String>, last: Option<LastRun>) -> Response {
    Json(Reply { answer: answer.into(), run, last }).into_response()
}

fn rejected(rejection: &JsonRejection) -> Response {
    refusal(rejection.status(), &rejection.body_text())
}

pub(super) fn refusal(status: StatusCode, error: &str) -> Response {
    (status, Json(Refusal { error: error.into() })).into_response()
}
