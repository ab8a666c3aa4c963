//! Connections of clients. A task serves each connection: it passes the request to the routes of the API and sends the reply.
//! No client can block the service or delay its end.
//!
//! Each connection serves one request and has limited time. A client has five seconds to send its request. A client that
//! stops reading its reply is disconnected. The number of open connections is limited, because recordings need file
//! descriptors, too. If the limit is reached, a new client replaces the oldest client that has not completed its request.
//!
//! `tower-http` is not used, because it limits the time and size of a request only after the headers are complete. It can
//! neither replace an idle connection by a new one nor drop a client that stops reading.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::Response;
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

use super::peer::Peer;
use super::refusal;

/// Largest number of open connections. It suffices for several people and programs, and is far below the
/// number of files that a process may open.
const CONNECTIONS_MAX: usize = 64;
/// Longest request \[bytes\].
const BODY_BYTES_MAX: usize = 64 * 1024;
/// Time limit for a client to send the header, and again for the body.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for the API to begin a reply. It is longer than `stop` waits for the disk.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(40);
/// A client that reads nothing of the reply for this time is disconnected \[ms\].
const UNREAD_TIMEOUT_MS: u32 = 10_000;
const CLOSE: HeaderValue = HeaderValue::from_static("close");
/// How long the end of the service waits for replies that are being sent.
const FINISH_TIMEOUT: Duration = Duration::from_secs(1);

/// Open connections, the oldest first.
pub(super) struct Connections {
    routes: Router,
    open: Vec<Connection>,
}

/// A new client, by the transport of its connection.
pub(super) enum Client<'a> {
    /// On the loopback port.
    Local(TcpStream),
    Tls(TcpStream, &'a TlsAcceptor),
    Proxy(UnixStream),
}

struct Connection {
    task: JoinHandle<()>,
    /// Whether the whole request has arrived.
    has_asked: Arc<AtomicBool>,
}

impl Connections {
    pub fn new(routes: Router) -> Self {
        Self { routes, open: Vec::new() }
    }

    /// Serves one more client. At the limit, the oldest client without a complete request is dropped. If all clients have
    /// sent their requests, the new client is dropped.
    pub fn add(&mut self, client: Client<'_>) {
        self.open.retain(|connection| !connection.task.is_finished());
        if self.open.len() >= CONNECTIONS_MAX {
            let idle = self.open.iter().position(|connection| !connection.has_asked.load(Ordering::Relaxed));
            let Some(idle) = idle else { return };
            self.open.remove(idle).task.abort();
        }
        if let Client::Local(stream) | Client::Tls(stream, _) = &client {
            // Sent data wait in the kernel, so only the kernel can detect that the client does not read. If the option
            // cannot be set, the connection works without this limit.
            let _ = setsockopt(stream, TcpUserTimeout, &UNREAD_TIMEOUT_MS);
        }
        let has_asked = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&has_asked);
        let routes = self.routes.clone();
        let task = match client {
            Client::Local(stream) => {
                let peer = Peer::of_loopback(&stream);
                tokio::spawn(converse(stream, peer, routes, asked))
            }
            Client::Proxy(stream) => tokio::spawn(converse(stream, Peer::Elsewhere, routes, asked)),
            Client::Tls(stream, tls) => {
                let tls = tls.clone();
                tokio::spawn(async move {
                    // A client that does not complete the TLS handshake in time is dropped.
                    if let Ok(Ok(stream)) = timeout(REQUEST_TIMEOUT, tls.accept(stream)).await {
                        converse(stream, Peer::Elsewhere, routes, asked).await;
                    }
                })
            }
        };
        self.open.push(Connection { task, has_asked });
    }

    /// Waits a short time until replies to complete requests have been sent.
    pub async fn finish(self) {
        let answers = async {
            for connection in self.open {
                if connection.has_asked.load(Ordering::Relaxed) {
                    let _ = connection.task.await;
                }
            }
        };
        // Replies that are not read within that time are lost. Their tasks end with the runtime.
        let _ = timeout(FINISH_TIMEOUT, answers).await;
    }
}

/// Serves a connection until it is closed.
async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: Peer,
    routes: Router,
    asked: Arc<AtomicBool>,
) {
    let service = service_fn(move |request| answer(request, peer, routes.clone(), Arc::clone(&asked)));
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(REQUEST_TIMEOUT)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    // An error of a client affects only its own connection.
    let _ = connection.await;
}

/// Computes the reply to a request, once the body of the request is complete.
async fn answer(
    request: hyper::Request<Incoming>,
    peer: Peer,
    routes: Router,
    has_asked: Arc<AtomicBool>,
) -> Result<Response, std::convert::Infallible> {
    let (mut head, body) = request.into_parts();
    head.extensions.insert(peer);
    let mut response = match timeout(REQUEST_TIMEOUT, to_bytes(Body::new(body), BODY_BYTES_MAX)).await {
        Err(_) => refusal(StatusCode::REQUEST_TIMEOUT, "the request did not arrive within 5 seconds"),
        Ok(Err(_)) => refusal(StatusCode::PAYLOAD_TOO_LARGE, "the request is longer than 64 kB, or was cut"),
        Ok(Ok(body)) => {
            has_asked.store(true, Ordering::Relaxed);
            let answer = routes.oneshot(Request::from_parts(head, Body::from(body)));
            timeout(ANSWER_TIMEOUT, answer).await.unwrap_or_else(|_| {
                Ok(refusal(
                    StatusCode::GATEWAY_TIMEOUT,
                    "no reply within 40 seconds; `ballbard status` shows the state",
                ))
            })?
        }
    };
    // Do not set this header for WebSockets: they stay open, and hyper would log an error for each of them.
    if response.status() != StatusCode::SWITCHING_PROTOCOLS {
        response.headers_mut().insert(header::CONNECTION, CLOSE);
    }
    Ok(response)
}
