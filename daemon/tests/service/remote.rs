//! Access from other machines, which is possible only with the token. An independent client and a real browser are used.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::process::Command;

use ballbard::control::status::{ServiceState, Status};
use serde_json::json;

use super::rig::{Running, quick, shipped};
use crate::support::ballbard;

fn open(arguments: &[&str]) -> Running {
    Running::with_arguments(arguments)
}

fn token(service: &Running) -> String {
    fs::read_to_string(service.directory.path().join("token")).unwrap()
}

/// Port of the TLS listener, taken from the status.
fn port(service: &Running) -> String {
    let status: Status = service.get("status");
    let words = status.remote.unwrap();
    words.split([':', ',']).nth(2).unwrap().to_owned()
}

#[test]
#[ignore = "needs Python"]
fn over_tls_an_independent_client_is_served_with_the_token_and_with_nothing_else() {
    let service = open(&["--listen", "127.0.0.1:0"]);
    service.wait_for("waiting");
    let python = std::env::var_os("BALLBAR_PYTHON").unwrap_or_else(|| "python3".into());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/service/remote.py");
    let status: Status = service.get("status");
    let said = Command::new(python)
        .arg(script)
        .arg(port(&service))
        .arg(service.directory.path())
        .arg(status.remote.unwrap())
        .output()
        .unwrap();
    assert!(said.status.success(), "{}", super::rig::text(&said));
    // Programs on the same machine still need no token.
    assert_eq!(service.get::<Status>("status").state, ServiceState::Waiting);
}

#[test]
#[ignore = "needs chromium"]
fn a_browser_that_was_given_the_token_once_shows_the_page() {
    let service = open(&["--listen", "127.0.0.1:0"]);
    service.wait_for("waiting");
    let profile = tempfile::tempdir().unwrap();
    let shown = |path: &str| {
        let url = format!("https://127.0.0.1:{}{path}", port(&service));
        let output = Command::new("chromium")
            .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"])
            .args(["--ignore-certificate-errors", "--timeout=3000", "--dump-dom"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg(url)
            .output()
            .expect("chromium is missing: apt-get install chromium");
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let form = shown("/");
    assert!(form.contains("token is missing") && form.contains("<form"), "{form}");
    shown(&format!("/?token={}", token(&service)));
    let page = shown("/");
    assert!(page.contains("id=\"word\""), "{page}");
    let status = shown("/api/status");
    assert!(status.contains("waiting"), "{status}");
}

/// Sends a request over a stream, as a reverse proxy passes it on. Returns status code and answer.
fn passed_on(mut stream: impl Read + Write, request: &str, headers: &[&str], body: &str) -> (u16, String) {
    let headers: String = headers.iter().map(|header| format!("{header}\r\n")).collect();
    let length = body.len();
    write!(stream, "{request}\r\n{headers}Content-Length: {length}\r\n\r\n{body}").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let status = answer.split(' ').nth(1).unwrap().parse().unwrap();
    (status, answer)
}

#[test]
fn through_a_reverse_proxy_nothing_is_reached_without_the_token_whatever_host_it_names() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("proxy.sock");
    // The socket file exists already, as if a killed service had left it.
    drop(UnixListener::bind(&socket).unwrap());
    let arguments = ["--behind-proxy", socket.to_str().unwrap()];
    let mut service = Running::in_directory(directory, quick().path(), &arguments);
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "kept", "duration_s": 0.2}));
    service.wait_until("the run", |status| status.last.is_some());
    let delete = |headers: &[&str]| {
        let stream = UnixStream::connect(&socket).unwrap();
        let headers = [headers, &["Connection: close", "Content-Type: application/json"]].concat();
        passed_on(stream, "POST /api/delete HTTP/1.0", &headers, r#"{"name": "kept"}"#)
    };
    let status = |headers: &[&str]| {
        passed_on(UnixStream::connect(&socket).unwrap(), "GET /api/status HTTP/1.1", headers, "")
    };
    // By default, nginx and Apache send one of these hosts. Some of the hosts are names of the loopback interface.
    for host in ["localhost", "127.0.0.1:7311", "127.0.0.1", "[::1]:7311", "lab.example"] {
        for origin in [vec![], vec![format!("Origin: https://{host}")]] {
            let headers = [vec![format!("Host: {host}")], origin].concat();
            let headers: Vec<&str> = headers.iter().map(String::as_str).collect();
            let (code, answer) = delete(&headers);
            assert_eq!(code, 401, "{host}: {answer}");
        }
    }
    assert!(service.directory.path().join("kept.mcap").exists());
    let bearer = format!("Authorization: Bearer {}", token(&service));
    for (headers, expected) in [
        (vec!["Host: lab.example", &bearer], 200),
        (vec!["Host: localhost", "X-Forwarded-For: 192.0.2.7", &bearer], 200),
        (vec!["Host: lab.example:8443", "Origin: https://lab.example:8443", &bearer], 200),
        // The scheme of an Authorization header is case-insensitive (RFC 9110, section 11.1).
        (vec!["Host: lab.example", &bearer.replace("Bearer", "bearer")], 200),
        (vec!["Host: lab.example", "Authorization: Bearer x"], 401),
        (vec!["Host: lab.example", "Origin: https://evil.example", &bearer], 403),
        (vec!["Host: lab.example", "Origin: http://lab.example", &bearer], 403),
        (vec!["Host: 127.0.0.1:7311", "Origin: http://127.0.0.1:7311"], 403),
    ] {
        let (code, answer) = status(&headers);
        assert_eq!(code, expected, "{headers:?}: {answer}");
    }
    let (_, answer) = status(&["Host: lab.example"]);
    assert!(answer.contains("state directory") && answer.contains("?token="), "no remedy in: {answer}");
    // The Host header differs from the origin, because the proxy does not pass on the Host header of the browser.
    let (code, answer) = status(&["Host: localhost", "Origin: https://lab.example", &bearer]);
    assert!(code == 403 && answer.contains("proxy_set_header Host $http_host"), "{answer}");
    service.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(service.ended(std::time::Duration::from_secs(10)).success());
    assert!(!socket.exists(), "the socket is left behind");
}

#[test]
fn what_a_reverse_proxy_passes_on_to_the_loopback_port_is_refused_with_the_remedy() {
    let service = Running::start();
    let ask = |version: &str, header: &str| {
        let stream = TcpStream::connect(format!("127.0.0.1:{}", service.port)).unwrap();
        let headers = [&format!("Host: 127.0.0.1:{}", service.port), header];
        passed_on(stream, &format!("GET /api/status HTTP/{version}"), &headers, "")
    };
    for (version, header) in [
        ("1.1", "X-Forwarded-For: 192.0.2.7"),
        ("1.1", "x-forwarded-proto: https"),
        ("1.1", "Forwarded: for=192.0.2.7"),
        ("1.1", "X-Real-IP: 192.0.2.7"),
        ("1.1", "Via: 1.1 lab.example"),
        // By default, nginx sends this version and only this header.
        ("1.0", "Connection: close"),
    ] {
        let (code, answer) = ask(version, header);
        assert_eq!(code, 403, "{version} {header}: {answer}");
        assert!(answer.contains("--behind-proxy"), "{answer}");
    }
    assert_eq!(ask("1.1", "Accept: */*").0, 200);
}

#[test]
#[ignore = "needs root, to send requests as another account"]
fn a_request_of_a_system_account_is_refused_with_the_remedy_but_for_the_metrics() {
    let service = Running::start();
    service.wait_for("waiting");
    // Sends a request as the current nginx does by default, which is HTTP/1.1 without additional headers. Sockets that this
    // thread opens belong to `account`.
    let ask = |account: u32, path: &str| {
        std::thread::scope(|scope| {
            let asked = scope.spawn(|| {
                nix::unistd::setfsuid(account.into());
                let stream = TcpStream::connect(format!("127.0.0.1:{}", service.port)).unwrap();
                let host = format!("Host: 127.0.0.1:{}", service.port);
                passed_on(stream, &format!("GET {path} HTTP/1.1"), &[&host], "")
            });
            asked.join().unwrap()
        })
    };
    for (account, path, expected) in [
        (33, "/api/status", 403),
        (33, "/", 403),
        (65_534, "/api/status", 403),
        (33, "/metrics", 200),
        (1000, "/api/status", 200),
        (0, "/api/status", 200),
    ] {
        let (code, answer) = ask(account, path);
        assert_eq!(code, expected, "{account} {path}: {answer}");
        assert!(code == 200 || answer.contains("account `") && answer.contains("--behind-proxy"), "{answer}");
    }
}

#[test]
fn a_socket_that_cannot_be_made_is_refused_with_the_remedy() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("file");
    fs::write(&file, "kept").unwrap();
    for (socket, part) in [
        (file.to_str().unwrap(), "choose another path with --behind-proxy"),
        ("/no/such/directory/x.sock", "choose another path with --behind-proxy"),
        ("lab.example", "give an absolute path"),
    ] {
        let said = refused(directory.path(), &["--behind-proxy", socket]);
        assert!(said.contains(part), "{said}");
    }
    assert_eq!(fs::read_to_string(&file).unwrap(), "kept");
    let taken = directory.path().join("taken");
    let _other = UnixListener::bind(&taken).unwrap();
    let said = refused(directory.path(), &["--behind-proxy", taken.to_str().unwrap()]);
    assert!(said.contains("in use"), "{said}");
}

#[test]
fn token_and_key_are_made_once_for_their_owner_alone() {
    let mut service = open(&["--listen", "127.0.0.1:0"]);
    let status: Status = service.get("status");
    let first = (token(&service), status.remote.unwrap().split("SHA-256").nth(1).unwrap().to_owned());
    assert_eq!(first.0.len(), 64);
    let kept = service.directory.path().to_owned();
    for name in ["token", "key.pem"] {
        assert_eq!(fs::metadata(kept.join(name)).unwrap().permissions().mode() & 0o777, 0o600, "{name}");
    }
    service.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(service.ended(std::time::Duration::from_secs(10)).success());
    let directory = std::mem::replace(&mut service.directory, tempfile::tempdir().unwrap());
    let again = Running::in_directory(directory, &shipped(), &["--listen", "127.0.0.1:0"]);
    let status: Status = again.get("status");
    let second = (token(&again), status.remote.unwrap().split("SHA-256").nth(1).unwrap().to_owned());
    assert_eq!(first, second);
}

/// Starts a service whose state directory is `directory`. The service must refuse to start. Returns its message.
fn refused(directory: &Path, arguments: &[&str]) -> String {
    let mut command = ballbard();
    command.env("STATE_DIRECTORY", directory).env("RUST_LOG", "off");
    command.args(["run", "--bus", "simulated", "--port", "0", "--config"]);
    let output = command.arg(shipped()).arg("--out").arg(directory).args(arguments).output().unwrap();
    assert!(!output.status.success());
    super::rig::text(&output)
}

#[test]
fn a_token_that_others_may_read_or_that_was_cut_is_refused_with_the_remedy() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("token");
    for (text, mode) in [("a".repeat(64), 0o644), ("a".repeat(63), 0o600), (String::new(), 0o600)] {
        fs::write(&file, text).unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(mode)).unwrap();
        let said = refused(directory.path(), &["--listen", "127.0.0.1:0"]);
        assert!(said.contains("token") && said.contains("remove it"), "{said}");
    }
}

#[test]
fn certificates_that_are_no_certificates_are_refused_with_the_remedy() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("given.pem");
    fs::write(&file, "no certificate").unwrap();
    let given = file.to_str().unwrap();
    let said =
        refused(directory.path(), &["--listen", "127.0.0.1:0", "--certificate", given, "--key", given]);
    assert!(said.contains("given.pem") && said.contains("--certificate"), "{said}");
    // A certificate is only accepted together with its key.
    let said = refused(directory.path(), &["--listen", "127.0.0.1:0", "--certificate", given]);
    assert!(said.contains("--key"), "{said}");
}
