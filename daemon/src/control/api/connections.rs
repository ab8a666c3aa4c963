//! The service's clients, none of which can keep it from its work or from its end.
//!
//! One request for each connection, so that a time and a place are given for each: a client has five seconds to say what
//! it wants, gives up its place before that if others need it, and loses it when it takes nothing of its answer. Few
//! connections are open at a time, because files need descriptors, too.
//!
//! `tower-http` limits the time and size of a request, but sees none before its headers are complete: it can neither drop the
//! idlest connection for a new one nor one whose client stops reading.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::Response;
use axum::{Extension, Router};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::TcpUserTimeout;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, UnixStream};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tower::ServiceExt;

use super::refusal;
use super::remote::FromElsewhere;

/// Connections at a time: some people and programs, and far fewer than a process may have files.
const CONNECTIONS_MAX: usize = 64;
/// Longest request \[bytes\].
const BODY_BYTES_MAX: usize = 64 * 1024;
/// How long a client may take to send its header, and as long for the rest.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);
/// How long an answer may take to begin: more than `stop` waits for the disk.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(40);
/// A client that takes nothing of its answer for as long has none \[ms\].
const TAKES_NOTHING_MS: u32 = 10_000;
const CLOSE: HeaderValue = HeaderValue::from_static("close");
/// How long the end of the service waits for clients that are being answered.
const FAREWELL: Duration = Duration::from_secs(1);

/// Those that are open, the oldest first.
pub(super) struct Connections {
    routes: Router,
    routes_from_elsewhere: Router,
    open: Vec<Connection>,
}

/// One more client, by the way that it came.
pub(super) enum Client<'a> {
    /// To the loopback port.
    Local(TcpStream),
    Tls(TcpStream, &'a TlsAcceptor),
    Proxy(UnixStream),
}

struct Connection {
    task: JoinHandle<()>,
    /// Its whole request is there.
    has_asked: Arc<AtomicBool>,
}

impl Connections {
    pub fn new(routes: Router) -> Self {
        let routes_from_elsewhere = routes.clone().layer(Extension(FromElsewhere));
        Self { routes, routes_from_elsewhere, open: Vec::new() }
    }

    /// Serves one more client. Where there are too many the oldest that has not asked yet goes; where all have
    /// asked, the new one.
    pub fn add(&mut self, client: Client<'_>) {
        self.open.retain(|connection| !connection.task.is_finished());
        if self.open.len() >= CONNECTIONS_MAX {
            let idle = self.open.iter().position(|connection| !connection.has_asked.load(Ordering::Relaxed));
            let Some(idle) = idle else { return };
            self.open.remove(idle).task.abort();
        }
        if let Client::Local(stream) | Client::Tls(stream, _) = &client {
            // What is sent waits in the kernel, which alone knows whether the client takes it. A stream without it serves, too.
            let _ = setsockopt(stream, TcpUserTimeout, &TAKES_NOTHING_MS);
        }
        let has_asked = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&has_asked);
        let elsewhere = self.routes_from_elsewhere.clone();
        let task = match client {
            Client::Local(stream) => tokio::spawn(converse(stream, self.routes.clone(), asked)),
            Client::Proxy(stream) => tokio::spawn(converse(stream, elsewhere, asked)),
            Client::Tls(stream, tls) => {
                let tls = tls.clone();
                tokio::spawn(async move {
                    // Who does not agree on TLS in time goes.
                    if let Ok(Ok(stream)) = timeout(REQUEST_TIMEOUT, tls.accept(stream)).await {
                        converse(stream, elsewhere, asked).await;
                    }
                })
            }
        };
        self.open.push(Connection { task, has_asked });
    }

    /// Lets those who have asked have their answer, for a moment.
    pub async fn finish(self) {
        let answers = async {
            for connection in self.open {
                if connection.has_asked.load(Ordering::Relaxed) {
                    let _ = connection.task.await;
                }
            }
        };
        // Who takes no answer within that time takes none; the tasks end with the runtime.
        let _ = timeout(FAREWELL, answers).await;
    }
}

async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    routes: Router,
    asked: Arc<AtomicBool>,
) {
    let service = service_fn(move |request| answer(request, routes.clone(), Arc::clone(&asked)));
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(REQUEST_TIMEOUT)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    // Whatever a client does wrong is its own loss.
    let _ = connection.await;
}

async fn answer(
    request: hyper::Request<Incoming>,
    routes: Router,
    has_asked: Arc<AtomicBool>,
) -> Result<Response, std::convert::Infallible> {
    let (head, body) = request.into_parts();
    let mut response = match timeout(REQUEST_TIMEOUT, to_bytes(Body::new(body), BODY_BYTES_MAX)).await {
        Err(_) => refusal(StatusCode::REQUEST_TIMEOUT, "the request did not come within 5 seconds"),
        Ok(Err(_)) => refusal(StatusCode::PAYLOAD_TOO_LARGE, "the request is longer than 64 kB, or was cut"),
        Ok(Ok(body)) => {
            has_asked.store(true, Ordering::Relaxed);
            let answer = routes.oneshot(Request::from_parts(head, Body::from(body)));
            timeout(ANSWER_TIMEOUT, answer).await.unwrap_or_else(|_| {
                Ok(refusal(StatusCode::GATEWAY_TIMEOUT, "no answer within 40 seconds; ask for the status"))
            })?
        }
    };
    // One that goes on as a WebSocket is not closed; hyper would say so of each if it were asked to close them.
    if response.status() != StatusCode::SWITCHING_PROTOCOLS {
        response.headers_mut().insert(header::CONNECTION, CLOSE);
    }
    Ok(response)
}
