//! Requests that no program of this project sends.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::Duration;

use ballbard::control::status::{ServiceState, Status};

use super::rig::Running;

/// Opens a connection and sends these bytes on it.
fn send(port: &str, request: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    // The service may close the connection before it has read everything.
    let _ = stream.write_all(request);
    stream
}

/// The status line of the reply. Empty if there is no reply.
fn status_line(mut stream: TcpStream) -> String {
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).lines().next().unwrap_or_default().to_owned()
}

fn raw(port: &str, request: &[u8]) -> String {
    status_line(send(port, request))
}

fn raw_post(port: &str, headers: &str, body: &str) -> String {
    let length = body.len();
    let request = format!(
        "POST /api/start HTTP/1.1\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n{body}"
    );
    raw(port, request.as_bytes())
}

#[test]
fn what_a_foreign_web_page_could_send_is_refused() {
    let service = Running::start();
    service.wait_for("waiting");
    let port = &service.port;
    let json = "Content-Type: application/json\r\n";
    for headers in [
        format!("Host: evil.example\r\n{json}"),
        format!("Host: 127.0.0.1:{port}\r\nOrigin: http://evil.example\r\n{json}"),
        format!("Host: 127.0.0.1.evil.example\r\n{json}"),
        format!("Host: 127.0.0.1:{port}\r\nOrigin: null\r\n{json}"),
        // If a header occurs twice, the second one must also be checked.
        format!("Host: 127.0.0.1:{port}\r\nHost: evil.example\r\n{json}"),
        format!(
            "Host: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\nOrigin: http://evil.example\r\n{json}"
        ),
    ] {
        let answer = raw_post(port, &headers, "{}");
        assert!(answer.contains("403"), "{headers}: {answer}");
    }
    // A request with another host name that resolves to this machine gets neither the page nor its data.
    for path in ["/", "/app.js", "/api/live", "/api/events", "/api/runs/x/mcap"] {
        let request = format!("GET {path} HTTP/1.1\r\nHost: evil.example:{port}\r\n\r\n");
        assert!(raw(port, request.as_bytes()).contains("403"), "{path}");
    }
    let host = format!("Host: 127.0.0.1:{port}\r\n");
    assert!(raw_post(port, &format!("{host}Content-Type: text/plain\r\n"), "{}").contains("415"));
    assert!(raw_post(port, &format!("{host}{json}"), "{\"name\": ").contains("400"));
    let huge = format!("{{\"note\": \"{}\"}}", "x".repeat(1 << 20));
    assert!(raw_post(port, &format!("{host}{json}"), &huge).contains("413"));
    for nonsense in [&b"\0\0\0\0"[..], b"GET / HTTP/9.9\r\n\r\n", b"\r\n\r\n", &[0xff; 4096]] {
        let stream = send(port, nonsense);
        // The sending direction is closed, so that the service does not wait for the rest of the request.
        let _ = stream.shutdown(Shutdown::Write);
        let answer = status_line(stream);
        assert!(answer.is_empty() || answer.contains(" 4") || answer.contains(" 5"), "{answer}");
    }
    assert_eq!(service.get::<Status>("status").state, ServiceState::Waiting);
}
