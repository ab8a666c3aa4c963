//! The service over HTTP on 127.0.0.1: a page for people, JSON for programs. If configured, other machines have access over
//! TLS or through a reverse proxy.
//!
//! Programs of this machine need no token. Web pages of other sites have no access through a browser of this machine, because
//! each request is checked: it must name a loopback host (against DNS rebinding), must have no foreign origin, and must carry
//! JSON (no plain forms). Requests from other machines need the token ([`remote`]).

mod bin;
mod connections;
mod downloads;
mod fingerprint;
mod foxglove;
mod metrics;
mod openapi;
mod pairing;
mod peer;
mod remote;

use std::convert::Infallible;
use std::future::Future;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::rejection::PathRejection;
use axum::extract::{self, FromRef, FromRequest, RawQuery, Request, State};
use axum::http::{HeaderMap, HeaderName, StatusCode, Version, header};
use axum::middleware::{self, Next};
use axum::response::sse::{self, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get, post};
use axum::{Extension, Json, Router};
use futures_util::future::OptionFuture;
use futures_util::{StreamExt, stream};
use serde::de::DeserializeOwned;
use shared::recording::Disk;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use self::connections::{Client, Connections};
use self::downloads::{DOWNLOADS_MAX, Download, Downloads};
pub use self::fingerprint::Fingerprint;
use self::openapi::Operation;
use self::pairing::Pairing;
use self::peer::Peer;
use self::remote::Gate;
pub use self::remote::{Remote, RemoteError, RemoteSettings, token_in};
use super::live::Live;
use super::machine::Answer;
use super::recordings::note;
use super::recordings::runs::{self, Curves, RunLine};
use super::recordings::table::{Layout, write_csv};
use super::recordings::verdict::Verdict;
use super::service::{LIST_TIMEOUT, Service};
use super::status::{
    CheckLine, DeleteRequest, EmptyBinRequest, Granted, HomeRequest, HomingStatus, IN_SPITE_OF, LastRun,
    MarkRequest, NameReply, NameRequest, NoteRequest, PairReply, PairRequest, Refusal, Reply, ServiceState,
    StartRequest, Status, StopRequest,
};
use crate::page;
use crate::problem::{Fact, Problem};
use crate::run::check_text;

/// How long `start` waits until the file of the run has been created, and `stop` until the file is finished.
const FILE_TIMEOUT: Duration = Duration::from_secs(20);
/// Largest number of pages that receive every moment; further pages can poll. The number is below the largest number of
/// connections, so that a request to stop a run always finds a free connection.
const VIEWERS_MAX: usize = 32;
/// Largest time between a marked event and the request \[ms\]. Earlier markers are refused, because
/// their time would be inaccurate.
const AGO_MS_MAX: u32 = 600_000;
/// Length limit of a refusal in the log \[characters\].
const REFUSAL_CHARS_MAX: usize = 300;
/// Pause after an error of the listener, for example if too many files are open.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Serves clients until `end` completes, then finishes the replies that are being sent. If `remote` is
/// given, other machines have access, too.
pub async fn serve(
    listener: TcpListener,
    remote: Option<Remote>,
    service: Service,
    end: impl Future<Output = ()>,
) {
    let (gate, words, tls, proxy) = match remote {
        Some(Remote { gate, words, tls, proxy }) => (Some(gate), Some(words), tls, proxy),
        None => (None, None, None, None),
    };
    let mut connections = Connections::new(routes(service, gate, words));
    tokio::pin!(end);
    loop {
        let over_tls = OptionFuture::from(tls.as_ref().map(|door| async move {
            door.listener.accept().await.map(|(stream, _)| Client::Tls(stream, &door.acceptor))
        }));
        let by_proxy = OptionFuture::from(proxy.as_ref().map(|door| door.listener.accept()));
        let accepted = tokio::select! {
            () = &mut end => break,
            accepted = listener.accept() => accepted.map(|(stream, _)| Client::Local(stream)),
            Some(accepted) = over_tls => accepted,
            Some(accepted) = by_proxy => accepted.map(|(stream, _)| Client::Proxy(stream)),
        };
        match accepted {
            Ok(client) => connections.add(client),
            Err(error) => {
                tracing::warn!("a client cannot be served: {error}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
        // Read the requests of open connections before many new connections displace them.
        tokio::task::yield_now().await;
    }
    drop((listener, tls, proxy));
    connections.finish().await;
}

/// State shared by all requests.
#[derive(Clone)]
struct ApiState {
    service: Service,
    downloads: Downloads,
    /// Limits the number of pages that receive every moment.
    viewers: Arc<Semaphore>,
    /// Limits the number of clients of Foxglove's WebSocket.
    foxgloves: Arc<Semaphore>,
    /// Text that describes how other machines reach the service.
    remote: Option<String>,
    pairing: Option<Arc<Pairing>>,
}

impl FromRef<ApiState> for Service {
    fn from_ref(shared: &ApiState) -> Self {
        shared.service.clone()
    }
}

/// The routes below `/api`, each with its description.
fn operations() -> Vec<(Operation, MethodRouter<ApiState>)> {
    vec![
        (
            Operation::get::<Status>("/status", "State of the service, its bus and the current run."),
            get(status),
        ),
        (Operation::get::<Live>("/live", "Current content of the web page."), get(live)),
        (
            Operation::get_other(
                "/events",
                "text/event-stream",
                "Server-sent events: first one named `minute` with the angles of the last minute, then ten each second, each \
                 with the same data as `/live`.",
            ),
            get(events),
        ),
        (
            Operation::get::<Vec<CheckLine>>("/check", "Runs the pre-flight check."),
            get(check),
        ),
        (
            Operation::get::<Vec<RunLine>>(
                "/runs",
                "Lists the recordings: unfinished ones first, then the latest.",
            ),
            get(list_runs),
        ),
        (
            Operation::get_other(
                "/runs/{name}/mcap",
                "application/octet-stream",
                "The file of a finished recording.",
            ),
            get(download_mcap),
        ),
        (
            Operation::get_other("/runs/{name}/csv", "text/csv", "A finished recording as a table.").with_options(&[
                ("relative", "Column `t_s` (seconds since the first cycle) instead of `time_utc`."),
                ("excel", "Format for spreadsheets in continental Europe: semicolons between columns, decimal commas."),
            ]),
            get(download_csv),
        ),
        (
            Operation::get::<Curves>(
                "/runs/{name}/plot",
                "Angles of a recording for a plot, at reduced resolution.",
            ),
            get(curves),
        ),
        (
            Operation::post::<StartRequest, Reply>(
                "/start",
                "Begins a run; the reply is sent when the file of the run has been created.",
            ),
            post(start),
        ),
        (
            Operation::post::<StopRequest, Reply>(
                "/stop",
                "Ends the run or the homing; the reply has the finished run, or the result of the homing.",
            ),
            post(stop),
        ),
        (
            Operation::post::<HomeRequest, Reply>(
                "/home",
                "Begins a homing; `/status` contains its progress and result.",
            ),
            post(home),
        ),
        (Operation::post::<MarkRequest, Reply>("/mark", "Adds a marker to the current run."), post(mark)),
        (
            Operation::post::<NoteRequest, Reply>(
                "/note",
                "Changes the note of a finished recording; the file of the recording is not changed.",
            ),
            post(change_note),
        ),
        (
            Operation::post::<NameRequest, NameReply>(
                "/name",
                "Returns the name that a run with this input would get, and whether the name is valid; changes nothing.",
            ),
            post(name),
        ),
        (
            Operation::post::<DeleteRequest, Reply>("/delete", "Moves a finished recording into the bin."),
            post(bin::delete),
        ),
        (
            Operation::post::<PairRequest, PairReply>(
                "/pair",
                "Returns links and QR codes with which a phone opens the page without the token; the code in them works once.",
            ),
            post(pairing::pair),
        ),
        (Operation::get::<Vec<RunLine>>("/bin", "Lists the recordings in the bin, the latest first."), get(bin::list)),
        (
            Operation::post::<DeleteRequest, Reply>(
                "/restore",
                "Moves a recording out of the bin; the reply has the name that the recording has now.",
            ),
            post(bin::restore),
        ),
        (
            Operation::post::<EmptyBinRequest, Reply>(
                "/bin/empty",
                "Removes every recording in the bin from the disk.",
            ),
            post(bin::empty),
        ),
    ]
}

/// The OpenAPI document of the service.
pub fn document() -> serde_json::Value {
    let (described, _): (Vec<_>, Vec<_>) = operations().into_iter().unzip();
    openapi::document(&described)
}

/// Returns all routes, for programs of this machine.
pub fn router(service: Service) -> Router {
    routes(service, None, None)
}

fn routes(service: Service, gate: Option<Gate>, remote: Option<String>) -> Router {
    let pairing = gate.as_ref().and_then(|gate| gate.pairing.clone());
    let places = |limit| Arc::new(Semaphore::new(limit));
    let (viewers, foxgloves) = (places(VIEWERS_MAX), places(foxglove::CLIENTS_MAX));
    let downloads = Downloads(places(DOWNLOADS_MAX));
    let origins = service.settings().live_tap.as_ref().map_or_else(Vec::new, |tap| tap.origins().to_vec());
    let admission = Arc::new(Admission { gate, service: service.clone(), origins });
    let page = page::routes(&service.settings().bar);
    let shared = ApiState { service, downloads, viewers, foxgloves, remote, pairing };
    let operations = operations();
    let (described, handlers): (Vec<_>, Vec<_>) = operations.into_iter().unzip();
    let document = openapi::document(&described);
    let api = described
        .iter()
        .zip(handlers)
        .fold(Router::new(), |api, (operation, handler)| api.route(operation.path, handler));
    let api = api.route("/openapi.json", get(move || async move { Json(document) }));
    Router::new()
        .nest("/api", api)
        .route(metrics::PATH, get(prometheus))
        .route(foxglove::PATH, get(foxglove::connect))
        .merge(page)
        .fallback(|| async {
            refusal(StatusCode::NOT_FOUND, "not found; the web page is /, the API is under /api/")
        })
        .layer(middleware::from_fn_with_state(admission, admitted))
        .layer(middleware::from_fn(logged))
        .with_state(shared)
}

/// The body of a request, parsed as JSON of type `T`.
struct JsonBody<T>(T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for JsonBody<T> {
    type Rejection = Response;

    async fn from_request(request: Request, state: &S) -> Result<Self, Response> {
        match Json::from_request(request, state).await {
            Ok(Json(body)) => Ok(Self(body)),
            Err(error) => Err(refusal(error.status(), &error.body_text())),
        }
    }
}

async fn status(State(ApiState { service, remote, .. }): State<ApiState>) -> Json<Status> {
    Json(Status { remote, ..service.status() })
}

async fn check(State(service): State<Service>) -> Result<Json<Vec<CheckLine>>, Response> {
    service.check().await.map(Json).map_err(unavailable)
}

/// The current moment, for clients without an event stream.
async fn live(State(service): State<Service>) -> Response {
    let moment = Arc::clone(&service.live().borrow());
    ([(header::CONTENT_TYPE, "application/json")], moment.json.clone()).into_response()
}

async fn prometheus(State(service): State<Service>) -> Response {
    let moment = Arc::clone(&service.live().borrow());
    match metrics::text(&moment.live) {
        Ok(text) => ([(header::CONTENT_TYPE, metrics::MEDIA_TYPE)], text).into_response(),
        Err(error) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &format!("no metrics: {error}")),
    }
}

/// Sends the last minute, then every moment. A slow client misses moments and does not delay other clients.
async fn events(State(ApiState { service, viewers, .. }): State<ApiState>) -> Response {
    let Ok(permit) = viewers.try_acquire_owned() else {
        return refusal(
            StatusCode::SERVICE_UNAVAILABLE,
            "too many pages are open; poll /api/live, or close one of them",
        );
    };
    let minute = sse::Event::default().event("minute").json_data(service.minute());
    let minute = stream::iter(minute.ok().map(Ok::<_, Infallible>));
    // The stream ends when the service ends, and the connection ends with the stream.
    let moments = stream::unfold((service.live(), permit), async |(mut latest, permit)| {
        latest.changed().await.ok()?;
        let moment = Arc::clone(&latest.borrow_and_update());
        Some((Ok(sse::Event::default().data(&moment.json)), (latest, permit)))
    });
    Sse::new(minute.chain(moments)).into_response()
}

/// Runs `work` in a task that may wait for the disk, and converts an error into a reply.
async fn on_disk<T: Send + 'static>(
    service: &Service,
    work: impl FnOnce(&dyn Disk) -> std::io::Result<T> + Send + 'static,
) -> Result<T, Response> {
    match service.ask_disk(LIST_TIMEOUT, move |_, disk| work(disk)).await {
        Some(Ok(found)) => Ok(found),
        Some(Err(error)) => Err(refusal(
            StatusCode::INTERNAL_SERVER_ERROR,
            &format!("the disk refused: {error}; check the directory of the recordings"),
        )),
        None => Err(disk_silent()),
    }
}

fn disk_silent() -> Response {
    refusal(StatusCode::GATEWAY_TIMEOUT, "the disk does not answer; `ballbard status` shows its state")
}

async fn list_runs(State(service): State<Service>) -> Result<Json<Vec<RunLine>>, Response> {
    let directories = service.settings().daemon.directories();
    on_disk(&service, move |disk| runs::list(disk, &directories)).await.map(Json)
}

/// Name of a run in the path of a request.
type Name = Result<extract::Path<String>, PathRejection>;

/// Finds a finished recording. Returns its path and its name.
async fn find_run(service: &Service, name: Name) -> Result<(PathBuf, String), Response> {
    let unknown =
        || refusal(StatusCode::NOT_FOUND, "no finished recording of that name; `ballbard runs` lists all");
    let extract::Path(name) = name.map_err(|_| unknown())?;
    let (directories, wanted) = (service.settings().daemon.directories(), name.clone());
    let file = on_disk(service, move |disk| runs::find(disk, &directories, &wanted)).await?;
    file.map(|file| (file, name)).ok_or_else(unknown)
}

async fn download_mcap(
    State(ApiState { service, downloads, .. }): State<ApiState>,
    name: Name,
) -> Result<Response, Response> {
    let (file, name) = find_run(&service, name).await?;
    let open = move |disk: &dyn Disk| {
        let opened = disk.open(&file)?;
        Ok((disk.length(&opened)?, opened))
    };
    let (length, opened) = on_disk(&service, open).await?;
    Ok(downloads.send_file(service.disk(), opened, format!("{name}.mcap"), length))
}

async fn download_csv(
    State(ApiState { service, downloads, .. }): State<ApiState>,
    name: Name,
    RawQuery(query): RawQuery,
) -> Result<Response, Response> {
    let layout = Layout::from_query(query.as_deref().unwrap_or_default())
        .map_err(|problem| refusal(StatusCode::BAD_REQUEST, &problem))?;
    let (file, name) = find_run(&service, name).await?;
    let what =
        Download { file_name: format!("{name}.csv"), media_type: "text/csv; charset=utf-8", length: None };
    let disk = service.disk();
    Ok(downloads.send(&what, move |sink| write_csv(&*disk, &file, layout, sink).map(drop)))
}

async fn curves(
    State(ApiState { service, downloads, .. }): State<ApiState>,
    name: Name,
) -> Result<Response, Response> {
    let (file, name) = find_run(&service, name).await?;
    let what = Download { file_name: format!("{name}.json"), media_type: "application/json", length: None };
    let disk = service.disk();
    Ok(downloads.send(&what, move |sink| Ok(serde_json::to_writer(sink, &runs::curves(&*disk, &file)?)?)))
}

async fn change_note(
    State(service): State<Service>,
    JsonBody(NoteRequest { name, note }): JsonBody<NoteRequest>,
) -> Result<Response, Response> {
    check_text(&note).map_err(unusable)?;
    let (file, name) = find_run(&service, Ok(extract::Path(name))).await?;
    on_disk(&service, move |disk| note::keep(disk, &file, note)).await?;
    Ok(reply(&service, Reply { answer: Granted::Noted, run: Some(name), ..Reply::default() }))
}

/// Runs the pre-flight check. Returns the lines that prevent a run.
async fn stopping_lines(service: &Service) -> Result<Vec<CheckLine>, Refusal> {
    let lines = service.check().await?;
    Ok(lines.into_iter().filter(|line| line.stops).collect())
}

async fn name(
    State(service): State<Service>,
    JsonBody(request): JsonBody<NameRequest>,
) -> Result<Json<NameReply>, Response> {
    service.name(request).await.map(Json).ok_or_else(disk_silent)
}

async fn start(
    State(service): State<Service>,
    JsonBody(request): JsonBody<StartRequest>,
) -> Result<Response, Response> {
    // Refuse invalid texts.
    request.about().check().map_err(unusable)?;
    request.reason.as_deref().map_or(Ok(()), check_some_text).map_err(unusable)?;
    let (named, reason) = (request.name.clone(), request.reason.clone());
    // Only the state `Waiting` needs the check. In any other state a run is active or none can begin, so the reply does
    // not depend on the check.
    let stopping = if service.status().state == ServiceState::Waiting {
        stopping_lines(&service).await.unwrap_or_default()
    } else {
        Vec::new()
    };
    // Refuse the run if the check found a severe problem and the request contains no reason to begin regardless.
    let findings: Vec<_> =
        stopping.iter().map(|line| format!("{}: {}", line.subject, line.finding)).collect();
    let findings = findings.join("; ");
    if !stopping.is_empty() && reason.is_none() {
        let remedies: Vec<_> = stopping.iter().filter_map(|line| line.remedy.as_deref()).collect();
        let suffices = stopping.iter().all(|line| line.reason_suffices);
        let otherwise = if suffices { ", or give a `reason` (--reason) to begin regardless" } else { "" };
        let error = format!("{findings}; {}{otherwise}", remedies.join("; "));
        let problems = stopping.into_iter().flat_map(|line| line.problems).collect();
        return Err(refused(StatusCode::CONFLICT, Refusal { error, problems }));
    }
    let task_service = service.clone();
    // The task continues if the client disconnects or the time is over, so that the file always contains
    // the reason of the run.
    let begun = service.spawn(async move {
        let answer = task_service.begin(request).await;
        if let (Ok(Answer::Beginning), Some(reason)) = (&answer, reason) {
            let findings = if findings.is_empty() { "nothing that stops a run" } else { &findings };
            let _ = task_service.mark(Some(format!("{IN_SPITE_OF}: {findings}; reason: {reason}")), 0).await;
        }
        answer
    });
    // Wait for the file, and reply.
    let Some(answer) = service.within(FILE_TIMEOUT, begun).await else {
        let why = service.status().reason.unwrap_or_default();
        let error = format!("the run waits for its file; `ballbard stop` cancels it: {why}");
        return Err(refusal(StatusCode::GATEWAY_TIMEOUT, &error));
    };
    let ended = |_| Err(Problem::from(Fact::ServiceEnding {}).into());
    let answer = answer.unwrap_or_else(ended);
    let answer = answer.map_err(|refusal| refused(StatusCode::UNPROCESSABLE_ENTITY, refusal))?;
    let (answer, run) = match answer {
        Answer::Beginning => (Granted::Begun, service.status().run.map(|run| run.name).or(named)),
        Answer::Running(run) => (Granted::Running, Some(run)),
        other => return Err(not_granted(other, "stop it first, or wait until its file is finished")),
    };
    Ok(reply(&service, Reply { answer, run, ..Reply::default() }))
}

async fn stop(
    State(service): State<Service>,
    JsonBody(StopRequest { cause }): JsonBody<StopRequest>,
) -> Result<Response, Response> {
    let cause = cause.unwrap_or_else(|| "stopped".into());
    check_some_text(&cause).map_err(unusable)?;
    let late = |error: &str| refusal(StatusCode::GATEWAY_TIMEOUT, error);
    match service.stop(cause).await.map_err(unavailable)? {
        (Answer::Stopping(run), over) => {
            let last = service.within(FILE_TIMEOUT, over).await.and_then(Result::ok).ok_or_else(|| {
                late(&format!("run `{run}` is ending, but its file is not finished yet; `ballbard status` shows the state"))
            })?;
            // If the file could not be finished, the run has failed.
            if last.error.is_some() {
                let error = format!("run `{run}`: {}", last.cause);
                return Err(refusal(StatusCode::INTERNAL_SERVER_ERROR, &error));
            }
            let verdict = verdict(&service, &last).await;
            let last = LastRun { verdict: verdict.clone(), ..last };
            let (answer, run, last) = (Granted::Stopped, Some(run), Some(last));
            Ok(reply(&service, Reply { answer, run, last, verdict, ..Reply::default() }))
        }
        (Answer::Homing, _) => {
            let homing = homed(&service).await.ok_or_else(|| {
                late("the homing is ending, but its marks are not saved yet; `ballbard status` shows the state")
            })?;
            let (answer, homing) = (Granted::Homing, Some(homing));
            Ok(reply(&service, Reply { answer, homing, ..Reply::default() }))
        }
        _ => Ok(reply(&service, Reply { last: service.status().last, ..Reply::default() })),
    }
}

async fn home(
    State(service): State<Service>,
    JsonBody(HomeRequest {}): JsonBody<HomeRequest>,
) -> Result<Response, Response> {
    let answer = match service.home().await.map_err(unavailable)? {
        Answer::Beginning => Granted::Begun,
        Answer::Homing => Granted::Homing,
        other => return Err(not_granted(other, "encoders are homed between runs")),
    };
    Ok(reply(&service, Reply { answer, ..Reply::default() }))
}

/// The refusal of a run or a homing. `while_busy` is the advice in case another run is active.
fn not_granted(answer: Answer, while_busy: &str) -> Response {
    match answer {
        Answer::Busy(run) => refusal(StatusCode::CONFLICT, &format!("run `{run}` is active; {while_busy}")),
        Answer::Refused(problem) => refused(StatusCode::CONFLICT, problem.into()),
        other => refusal(StatusCode::INTERNAL_SERVER_ERROR, &format!("unexpected answer {other:?}")),
    }
}

async fn mark(
    State(service): State<Service>,
    JsonBody(MarkRequest { text, ago_ms }): JsonBody<MarkRequest>,
) -> Result<Response, Response> {
    text.as_deref().map_or(Ok(()), check_some_text).map_err(unusable)?;
    if ago_ms > AGO_MS_MAX {
        return Err(unusable("`ago_ms` is more than 600000; mark it within ten minutes"));
    }
    let marked = service.mark(text, ago_ms).await.map_err(unavailable)?;
    let (run, text) = marked
        .ok_or_else(|| refusal(StatusCode::CONFLICT, "no run is active, so there is nothing to mark"))?;
    let (answer, run, mark) = (Granted::Marked, Some(run), Some(text));
    Ok(reply(&service, Reply { answer, run, mark, ..Reply::default() }))
}

/// Refuses an empty text, and a text that may not occur in a run.
fn check_some_text(text: &str) -> Result<(), &'static str> {
    if text.is_empty() { Err("the text is empty; write at least one character") } else { check_text(text) }
}

/// The grade of a run that has just ended. Waits until the grade has been read from the file.
async fn verdict(service: &Service, last: &LastRun) -> Option<Verdict> {
    let file = last.file.as_ref()?;
    let mut status = service.watch();
    let of_run = |status: &Status| status.last.clone().filter(|last| last.file.as_ref() == Some(file));
    let has_verdict = |status: &Status| of_run(status).is_some_and(|last| last.verdict.is_some());
    let wait = async { status.wait_for(has_verdict).await.ok().and_then(|status| of_run(&status)?.verdict) };
    service.within(LIST_TIMEOUT, wait).await.flatten()
}

/// Waits for the end of the homing.
async fn homed(service: &Service) -> Option<HomingStatus> {
    let mut status = service.watch();
    let over = |status: &Status| status.homing.as_ref().is_none_or(|homing| homing.is_over);
    let wait = async { status.wait_for(over).await.ok().and_then(|status| status.homing.clone()) };
    service.within(FILE_TIMEOUT, wait).await.flatten()
}

/// Logs each refused request with the reason.
async fn logged(request: Request, next: Next) -> Response {
    let asked = format!("{} {}", request.method(), request.uri().path());
    let response = next.run(request).await;
    if let Some(Refusal { error, .. }) = response.extensions().get() {
        let line: String = format!("refused: {asked}: {error}").chars().take(REFUSAL_CHARS_MAX).collect();
        tracing::warn!("{}", line.replace(char::is_control, " "));
    }
    response
}

/// Rules that decide which requests are admitted.
struct Admission {
    /// Checks requests from other machines; `None` without remote access.
    gate: Option<Gate>,
    service: Service,
    /// Origins, other than this machine, that may connect to Foxglove's WebSocket.
    origins: Vec<String>,
}

/// Middleware that refuses requests of foreign web pages, and requests from other machines without the token.
async fn admitted(State(admission): State<Arc<Admission>>, request: Request, next: Next) -> Response {
    let refused = match &admission.gate {
        Some(gate) if matches!(request.extensions().get(), Some(Peer::Elsewhere)) => {
            gate.refuse(&request, admission.service.now())
        }
        _ => refused_on_loopback(&request, &admission.origins),
    };
    match refused {
        Some(response) => response,
        None => next.run(request).await,
    }
}

/// Refuses a request to the loopback port unless it comes from a program or a page of this machine.
/// Returns `None` if the request is admitted.
fn refused_on_loopback(request: &Request, origins: &[String]) -> Option<Response> {
    let is_foxglove = request.uri().path() == foxglove::PATH;
    let error: String = if let Some(sign) = sign_of_a_proxy(request) {
        format!(
            "the request came through a reverse proxy ({sign}), but this port is not protected by the token; \
             give the proxy a socket: `ballbard run --behind-proxy SOCKET`"
        )
    } else if is_local(request.headers(), if is_foxglove { origins } else { &[] }) {
        return None;
    } else if is_foxglove {
        "only programs and pages of this machine may connect; --foxglove-origin admits another origin".into()
    } else {
        "only programs and pages of this machine have access".into()
    };
    Some(refusal(StatusCode::FORBIDDEN, &error))
}

/// The evidence that a reverse proxy forwarded the request, or `None`. Most proxies add a header. By default nginx adds none.
/// Older versions of nginx use HTTP/1.0, which programs and browsers do not use any more. All versions run as a system
/// account. Only the metrics may be read by a system account.
fn sign_of_a_proxy(request: &Request) -> Option<String> {
    let is_of_proxy =
        |name: &&str| ["forwarded", "via", "x-real-ip"].contains(name) || name.starts_with("x-forwarded-");
    if let Some(header) = request.headers().keys().map(HeaderName::as_str).find(is_of_proxy) {
        return Some(header.to_owned());
    }
    if request.version() < Version::HTTP_11 {
        return Some("HTTP/1.0".into());
    }
    if request.uri().path() == metrics::PATH {
        return None;
    }
    let account = request.extensions().get::<Peer>()?.system_account()?;
    Some(format!("account `{account}`"))
}

/// Whether a request names a loopback host, and its origin, if it has one, is this machine or one of `origins`.
fn is_local(headers: &HeaderMap, origins: &[String]) -> bool {
    let loopback = |authority: &str| {
        let host = authority.rsplit_once(':').map_or(authority, |(host, _)| host);
        ["127.0.0.1", "localhost", "[::1]"].contains(&host)
    };
    // A header may occur twice. Some readers use the first value, others the last, so all values must be valid.
    let all_are = |name: HeaderName, is_ours: &dyn Fn(&str) -> bool| {
        headers.get_all(name).iter().all(|value| value.to_str().is_ok_and(is_ours))
    };
    headers.contains_key(header::HOST)
        && all_are(header::HOST, &loopback)
        && all_are(header::ORIGIN, &|origin| {
            origin.strip_prefix("http://").is_some_and(loopback)
                || origins.iter().any(|other| other == origin)
        })
}

/// Sends a reply. Every reply reports whether the bus is simulated.
fn reply(service: &Service, reply: Reply) -> Response {
    Json(Reply { simulated: service.status().simulated, ..reply }).into_response()
}

/// Refuses a request with an invalid value.
fn unusable(error: &str) -> Response {
    refusal(StatusCode::UNPROCESSABLE_ENTITY, error)
}

/// Refuses a request because the service is ending or overloaded.
fn unavailable(refusal: Refusal) -> Response {
    refused(StatusCode::SERVICE_UNAVAILABLE, refusal)
}

fn refusal(status: StatusCode, error: &str) -> Response {
    refused(status, Refusal::new(error))
}

fn refused(status: StatusCode, refusal: Refusal) -> Response {
    // The client receives one copy, and the extension carries another copy for the log.
    (status, Extension(refusal.clone()), Json(refusal)).into_response()
}
