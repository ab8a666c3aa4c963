//! Invalid and hostile requests.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use ballbard::control::status::{NameReply, ServiceState, Status};
use serde_json::json;

use super::rig::Running;

#[test]
fn hostile_requests_are_refused_and_leave_nothing() {
    let service = Running::start();
    service.wait_for("waiting");
    for name in ["", "..", "/", "\u{202e}", "-", "\u{0}"] {
        let (status, reply) = service.post("start", &json!({"name": name}));
        assert_eq!(status, 422, "{name}: {reply}");
        assert!(reply["error"].as_str().unwrap().contains("run name"), "{reply}");
    }
    for body in [
        json!({"name": 5}),
        json!({"nmae": "x"}),
        json!({"duration_s": -1}),
        json!({"duration_s": 1e308}),
        json!({"duration_s": 1e9}),
        json!({"note": "\u{1b}[2J"}),
        json!({"duration_s": 0.0}),
        json!({"note": "x".repeat(5000)}),
        json!([1]),
        json!(null),
    ] {
        let (status, reply) = service.post("start", &body);
        assert_eq!(status, 422, "{body}: {reply}");
        assert!(!reply["error"].as_str().unwrap().is_empty());
    }
    for (path, body) in [
        ("mark", json!({"text": ""})),
        ("mark", json!({"text": "x", "ago_ms": 600_001})),
        ("mark", json!({"text": "x", "ago_ms": -1})),
        ("stop", json!({"cause": ""})),
        ("stop", json!({"cause": "\u{1b}]0;x\u{7}"})),
    ] {
        assert_eq!(service.post(path, &body).0, 422);
    }
    assert_eq!(service.post("mark", &json!({"text": "x"})).0, 409);
    assert_eq!(service.post("nowhere", &json!({})).0, 404);
    assert_eq!(std::fs::read_dir(service.directory.path()).unwrap().count(), 0);
    assert_eq!(service.get::<Status>("status").state, ServiceState::Waiting);
}

#[test]
fn whatever_a_run_is_called_its_file_lies_in_the_directory_under_a_plain_name() {
    let service = Running::start();
    service.wait_for("waiting");
    for (typed, name) in [
        ("../up", "up".to_owned()),
        ("/etc/passwd", "etc-passwd".to_owned()),
        ("Prüfling 7/ä", "Prüfling-7-ä".to_owned()),
        ("a\u{0}b", "a-b".to_owned()),
        ("a.mcap.active", "a-mcap-active".to_owned()),
        (&"x".repeat(60_000), "x".repeat(120)),
    ] {
        let asked: NameReply =
            serde_json::from_value(service.post("name", &json!({"name": typed})).1).unwrap();
        assert_eq!((asked.name.as_str(), asked.problem), (name.as_str(), None));
        assert_eq!(service.granted("start", &json!({"name": typed})).run.as_deref(), Some(name.as_str()));
        service.wait_for("writing");
        service.granted("stop", &json!({}));
        assert!(service.directory.path().join(format!("{name}.mcap")).exists(), "{name}");
        let asked: NameReply =
            serde_json::from_value(service.post("name", &json!({"name": typed})).1).unwrap();
        assert!(asked.problem.unwrap().contains("choose another name"));
    }
    let asked: NameReply = serde_json::from_value(service.post("name", &json!({"name": "???"})).1).unwrap();
    assert!(asked.name.is_empty() && asked.problem.unwrap().contains("no letter or digit"));
    // The default name is date, robot, bar and a number, for the page and for the command.
    let about = json!({"robot": "IRB 2400", "bar": "short"});
    let NameReply { name, .. } = serde_json::from_value(service.post("name", &about).1).unwrap();
    assert!(name.ends_with("_irb-2400_short_01"), "{name}");
    assert_eq!(service.granted("start", &about).run.unwrap(), name);
}

/// Sends raw bytes and returns the status line.
fn raw(port: &str, request: &[u8]) -> String {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    // The service may close before it has read everything.
    let _ = stream.write_all(request);
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).lines().next().unwrap_or_default().to_owned()
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
        // The text after a valid origin counts, too.
        format!("Host: 127.0.0.1:{port}\r\nHost: evil.example\r\n{json}"),
        format!(
            "Host: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\nOrigin: http://evil.example\r\n{json}"
        ),
    ] {
        let answer = raw_post(port, &headers, "{}");
        assert!(answer.contains("403"), "{headers}: {answer}");
    }
    // A foreign name that resolves to this machine gets neither the page nor its data.
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
        let answer = raw(port, nonsense);
        assert!(answer.is_empty() || answer.contains(" 4") || answer.contains(" 5"), "{answer}");
    }
    assert_eq!(service.get::<Status>("status").state, ServiceState::Waiting);
}
