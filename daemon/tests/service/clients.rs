//! Clients that send half, nothing, or far too much.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ballbard::control::status::Status;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::signal::Signal;
use serde_json::json;

use super::rig::Running;

/// Two seconds, and what a busy machine adds.
const END_WITHIN: Duration = Duration::from_secs(4);

fn connect(service: &Running) -> TcpStream {
    TcpStream::connect(format!("127.0.0.1:{}", service.port)).unwrap()
}

fn sent(service: &Running, bytes: &str) -> TcpStream {
    let mut stream = connect(service);
    stream.write_all(bytes.as_bytes()).unwrap();
    stream
}

fn head(service: &Running, first: &str, length: usize) -> String {
    let host = format!("Host: 127.0.0.1:{}\r\nContent-Type: application/json\r\n", service.port);
    format!("{first} HTTP/1.1\r\n{host}Content-Length: {length}\r\n\r\n")
}

/// Until the service closes it.
fn closed_after(mut stream: &TcpStream) -> Duration {
    let begun = Instant::now();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let mut rest = Vec::new();
    // A reset is an end, too.
    let read = stream.read_to_end(&mut rest);
    assert!(!read.is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock), "it is never closed");
    begun.elapsed()
}

#[test]
fn half_a_request_keeps_no_service_from_its_end() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "half"}));
    service.wait_for("writing");
    let _held = [
        connect(&service),
        sent(&service, "G"),
        sent(&service, "GET /api/status HTTP/1.1\r\nHost: 127"),
        sent(&service, &format!("{}{{", head(&service, "POST /api/start", 100))),
        // Its answer is read by nobody.
        sent(&service, &head(&service, "GET /api/runs", 0)),
    ];
    std::thread::sleep(Duration::from_millis(300));
    service.signal(Signal::SIGTERM);
    assert!(service.ended(END_WITHIN).success());
    assert!(service.recording("half").end.cause.contains("SIGTERM"));
}

#[test]
fn a_client_that_does_not_say_what_it_wants_is_sent_away() {
    let service = Running::start();
    service.wait_for("waiting");
    let silent = [
        connect(&service),
        sent(&service, "GET /api/status HTTP/1.1\r\nHost: 127"),
        sent(&service, &format!("{}{{", head(&service, "POST /api/start", 100))),
    ];
    // One byte after the other, as long as it is let.
    let mut slow = connect(&service);
    let begun = Instant::now();
    while slow.write_all(b"x").is_ok() {
        assert!(begun.elapsed() < Duration::from_secs(20), "a slow client is served for ever");
        std::thread::sleep(Duration::from_millis(100));
    }
    for stream in &silent {
        assert!(closed_after(stream) < Duration::from_secs(10));
    }
    assert_eq!(service.get::<Status>("status").state, "waiting");
}

#[test]
fn more_clients_than_a_process_has_files_for_change_nothing_for_a_run() {
    const CLIENTS: u64 = 1100;
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "crowded"}));
    service.wait_for("writing");
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, soft.max(hard.min(CLIENTS + 500)), hard).unwrap();
    let crowd: Vec<TcpStream> = (0..CLIENTS).map(|_| sent(&service, "GET /api/status HTT")).collect();
    assert_eq!(service.granted("mark", &json!({"text": "crowded"})).run.as_deref(), Some("crowded"));
    assert!(service.get::<Status>("status").run.is_some());
    let last = service.granted("stop", &json!({})).last.unwrap();
    assert!(last.cycles > 50 && last.file.is_some(), "{last:?}");
    assert_eq!(service.recording("crowded").cycles.len() as u64, last.cycles);
    service.granted("start", &json!({"name": "next"}));
    service.wait_for("writing");
    service.signal(Signal::SIGTERM);
    assert!(service.ended(END_WITHIN).success());
    assert!(!service.recording("next").end.recovered);
    drop(crowd);
}
