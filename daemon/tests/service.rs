//! The service over loopback: idempotent, one run at a time, deaf to nonsense, and always a closed file.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use ballbard::control::runs::RunLine;
use ballbard::control::status::{CheckLine, Reply, Status};
use serde_json::{Value, json};
use shared::recording::Recording;
use shared::recording::schema::EventKind;

fn shipped() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
}

/// A service on the simulated bus, on a port of its own.
struct Running {
    child: Child,
    port: String,
    directory: tempfile::TempDir,
}

impl Running {
    fn start() -> Self {
        Self::in_directory(tempfile::tempdir().unwrap(), &shipped())
    }

    fn in_directory(directory: tempfile::TempDir, config: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_ballbard"))
            .env("RUST_LOG", "off")
            .args(["run", "--port", "0", "--config"])
            .arg(config)
            .arg("--out")
            .arg(directory.path())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let port = line.trim().rsplit_once(':').unwrap().1.to_owned();
        Self { child, port, directory }
    }

    fn url(&self, path: &str) -> String {
        format!("http://127.0.0.1:{}/{path}", self.port)
    }

    fn get<T: serde::de::DeserializeOwned>(&self, path: &str) -> T {
        agent().get(&self.url(path)).call().unwrap().body_mut().read_json().unwrap()
    }

    fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        let mut response = agent().post(&self.url(path)).send_json(body).unwrap();
        (response.status().as_u16(), response.body_mut().read_json().unwrap())
    }

    fn granted(&self, path: &str, body: &Value) -> Reply {
        let (status, reply) = self.post(path, body);
        assert_eq!(status, 200, "{reply}");
        serde_json::from_value(reply).unwrap()
    }

    fn wait_for(&self, state: &str) -> Status {
        let begun = Instant::now();
        loop {
            let status: Status = self.get("status");
            if status.state == state {
                return status;
            }
            assert!(begun.elapsed() < Duration::from_secs(30), "{state} never came: {status:?}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// What a person types.
    fn command(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ballbard"));
        command.env("RUST_LOG", "off").args(arguments).args(["--port", &self.port]).output().unwrap()
    }

    fn signal(&self, signal: nix::sys::signal::Signal) {
        let pid = nix::unistd::Pid::from_raw(i32::try_from(self.child.id()).unwrap());
        nix::sys::signal::kill(pid, signal).unwrap();
    }

    fn recording(&self, name: &str) -> Recording {
        Recording::open(&self.directory.path().join(format!("{name}.mcap"))).unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn agent() -> ureq::Agent {
    ureq::Agent::config_builder().http_status_as_error(false).proxy(None).build().into()
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[test]
fn runs_are_recorded_one_after_the_other_from_one_bus() {
    let service = Running::start();
    service.wait_for("waiting");
    for name in ["first", "second"] {
        assert_eq!(service.granted("start", &json!({"name": name, "note": "n"})).answer, "begun");
        let writing = service.wait_for("writing").run.unwrap();
        assert!(writing.cycles > 0 && writing.bytes > 0, "{writing:?}");
        assert_eq!(service.granted("mark", &json!({"text": "half way"})).run.as_deref(), Some(name));
        let stopped = service.granted("stop", &json!({"cause": "enough"}));
        assert_eq!((stopped.answer.as_str(), stopped.run.as_deref()), ("stopped", Some(name)));
        let recording = service.recording(name);
        assert_eq!((recording.run.name.as_str(), recording.run.note.as_str()), (name, "n"));
        assert_eq!(recording.end.cause, "enough");
        assert_eq!(recording.cycles.len() as u64, stopped.last.unwrap().cycles);
        let marks: Vec<_> = recording.events.iter().filter(|event| event.kind == EventKind::Marker).collect();
        assert!(matches!(marks[..], [mark] if mark.text == "half way"), "{marks:?}");
        assert!(recording.cycles.iter().filter(|cycle| cycle.is_valid()).count() > 50);
    }
    let lines: Vec<RunLine> = service.get("runs");
    assert_eq!(lines.iter().map(|line| line.name.as_str()).collect::<Vec<_>>(), ["second", "first"]);
}

#[test]
fn starting_and_stopping_twice_changes_nothing() {
    let service = Running::start();
    service.wait_for("waiting");
    assert_eq!(service.granted("stop", &json!({})).answer, "idle");
    assert_eq!(service.granted("start", &json!({"name": "one"})).answer, "begun");
    for body in [json!({"name": "one"}), json!({})] {
        let again = service.granted("start", &body);
        assert_eq!((again.answer.as_str(), again.run.as_deref()), ("running", Some("one")));
    }
    let (status, other) = service.post("start", &json!({"name": "two"}));
    assert_eq!(status, 409);
    assert!(other["error"].as_str().unwrap().contains("`one` goes on"), "{other}");
    assert_eq!(service.granted("stop", &json!({})).answer, "stopped");
    assert_eq!(service.granted("stop", &json!({})).answer, "idle");
    let (status, taken) = service.post("start", &json!({"name": "one"}));
    assert_eq!(status, 409);
    assert!(taken["error"].as_str().unwrap().contains("never overwritten"), "{taken}");
    service.wait_for("waiting");
}

#[test]
fn many_clients_at_once_get_one_run_at_a_time_and_every_file_is_whole() {
    let service = Running::start();
    service.wait_for("waiting");
    let begun: usize = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..8)
            .map(|client| {
                let service = &service;
                scope.spawn(move || {
                    let mut begun = 0;
                    for turn in 0..6 {
                        let name = format!("c{client}-{turn}");
                        let (status, reply) = service.post("start", &json!({"name": name}));
                        assert!(status == 200 || status == 409, "{reply}");
                        begun += usize::from(reply["answer"] == "begun");
                        std::thread::sleep(Duration::from_millis(30));
                        let (status, reply) = service.post("stop", &json!({}));
                        assert_eq!(status, 200, "{reply}");
                    }
                    begun
                })
            })
            .collect();
        clients.into_iter().map(|client| client.join().unwrap()).sum()
    });
    service.wait_for("waiting");
    let lines: Vec<RunLine> = service.get("runs");
    assert!(begun > 0);
    assert_eq!(lines.len(), begun);
    for line in lines {
        let recording = Recording::open(&line.file).unwrap();
        assert_eq!((recording.cycles.len() as u64, line.recovered), (line.cycles, false));
    }
}

#[test]
fn hostile_requests_are_refused_and_leave_nothing() {
    let service = Running::start();
    service.wait_for("waiting");
    let names = ["../up", "a/b", "/etc/passwd", ".hidden", "a\u{0}b", "a b", "%2e%2e", "", "..", "\u{202e}x"];
    for name in names.iter().map(|name| (*name).to_owned()).chain(["x".repeat(201), "x".repeat(60_000)]) {
        let (status, reply) = service.post("start", &json!({"name": name}));
        assert_eq!(status, 409, "{name}: {reply}");
        assert!(reply["error"].as_str().unwrap().contains("run name"), "{reply}");
    }
    for body in [
        json!({"name": 5}),
        json!({"nmae": "x"}),
        json!({"duration_s": -1}),
        json!({"duration_s": 1e300}),
        json!({"duration_s": 0.0}),
        json!({"note": "x".repeat(5000)}),
        json!([1]),
        json!(null),
    ] {
        let (status, reply) = service.post("start", &body);
        assert_eq!(status, 422, "{body}: {reply}");
        assert!(!reply["error"].as_str().unwrap().is_empty());
    }
    for (path, body) in [("mark", json!({"text": ""})), ("mark", json!({})), ("stop", json!({"cause": ""}))] {
        assert_eq!(service.post(path, &body).0, 422);
    }
    assert_eq!(service.post("mark", &json!({"text": "x"})).0, 409);
    assert_eq!(service.post("nowhere", &json!({})).0, 404);
    assert_eq!(std::fs::read_dir(service.directory.path()).unwrap().count(), 0);
    assert_eq!(service.get::<Status>("status").state, "waiting");
}

/// Sends bytes as they are and gives the status line.
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
        "POST /start HTTP/1.1\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n{body}"
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
    ] {
        let answer = raw_post(port, &headers, "{}");
        assert!(answer.contains("403"), "{headers}: {answer}");
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
    assert_eq!(service.get::<Status>("status").state, "waiting");
}

#[test]
fn the_commands_say_what_they_did() {
    let service = Running::start();
    service.wait_for("waiting");
    let started = service.command(&["start", "--name", "typed", "--note", "by hand", "--operator", "A"]);
    assert!(started.status.success() && text(&started).contains("`typed` has begun"), "{}", text(&started));
    assert!(text(&service.command(&["start", "--name", "typed"])).contains("goes on already"));
    service.wait_for("writing");
    assert!(text(&service.command(&["mark", "a mark"])).contains("marked in run `typed`"));
    let status = service.command(&["status"]);
    assert!(text(&status).contains("WRITING") && text(&status).contains("`typed`"), "{}", text(&status));
    let stopped = service.command(&["stop"]);
    assert!(text(&stopped).contains("typed.mcap"), "{}", text(&stopped));
    assert!(text(&service.command(&["stop"])).contains("no run goes on"));
    let runs =
        Command::new(env!("CARGO_BIN_EXE_ballbard")).arg("runs").arg(service.directory.path()).output();
    let runs = text(&runs.unwrap());
    assert!(runs.contains("typed") && runs.contains("by hand") && !runs.contains("recovered"), "{runs}");
}

#[test]
fn without_a_service_the_commands_say_what_to_type() {
    let output =
        Command::new(env!("CARGO_BIN_EXE_ballbard")).args(["status", "--port", "1"]).output().unwrap();
    assert!(!output.status.success() && text(&output).contains("ballbard run"), "{}", text(&output));
}

#[test]
fn the_check_has_a_line_for_each_thing_and_a_remedy_for_each_problem() {
    let service = Running::start();
    service.wait_for("waiting");
    std::thread::sleep(Duration::from_millis(300));
    let lines: Vec<CheckLine> = service.get("check");
    let line = |subject: &str| lines.iter().find(|line| line.subject == subject).unwrap().clone();
    for subject in ["bus", "encoders", "disk", "left-over files"] {
        assert_eq!(line(subject).remedy, None, "{lines:?}");
    }
    for subject in ["real time", "clock"] {
        // Depends on this machine; it must be there.
        assert!(!line(subject).finding.is_empty());
    }
    // A file that appears while the service runs turns exactly its line.
    std::fs::write(service.directory.path().join("old.mcap.active"), "left").unwrap();
    let after: Vec<CheckLine> = service.get("check");
    for (before, after) in lines.iter().zip(after) {
        if after.subject == "left-over files" {
            assert!(after.remedy.unwrap().contains("recover") && after.finding.contains("old.mcap.active"));
        } else {
            assert_eq!(before.remedy, after.remedy);
        }
    }
}

#[test]
fn a_signal_ends_service_and_run_with_a_finished_file() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "signal"}));
    service.wait_for("writing");
    let asked = Instant::now();
    service.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(service.child.wait().unwrap().success());
    assert!(asked.elapsed() < Duration::from_secs(20));
    let recording = service.recording("signal");
    assert!(recording.end.cause.contains("SIGTERM"), "{}", recording.end.cause);
}

#[test]
fn a_run_ends_by_itself_after_its_duration() {
    let service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "short", "duration_s": 0.5}));
    let last = loop {
        if let Some(last) = service.get::<Status>("status").last {
            break last;
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    assert_eq!((last.cycles, last.cause.as_str()), (50, "duration reached"));
    assert_eq!(service.recording("short").cycles.len(), 50);
    service.wait_for("waiting");
}

#[test]
fn a_run_that_a_kill_left_behind_is_there_finished_when_the_service_starts_again() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "killed"}));
    service.wait_for("writing");
    let written = service.get::<Status>("status").run.unwrap().cycles;
    service.signal(nix::sys::signal::Signal::SIGKILL);
    service.child.wait().unwrap();
    let directory = std::mem::replace(&mut service.directory, tempfile::tempdir().unwrap());
    let again = Running::in_directory(directory, &shipped());
    again.wait_for("waiting");
    let lines: Vec<RunLine> = again.get("runs");
    assert!(matches!(&lines[..], [line] if line.recovered && line.cycles >= written), "{lines:?}");
    assert!(again.recording("killed").end.cause.contains("recovered"));
}

#[test]
fn at_the_disk_floor_no_run_begins() {
    let directory = tempfile::tempdir().unwrap();
    let config = tempfile::tempdir().unwrap();
    std::fs::copy(shipped().join("ball_bar.toml"), config.path().join("ball_bar.toml")).unwrap();
    let daemon = std::fs::read_to_string(shipped().join("daemon.toml")).unwrap();
    // More than any disk has.
    let daemon = daemon.replace("disk_floor_mb = 500", "disk_floor_mb = 4000000000");
    std::fs::write(config.path().join("daemon.toml"), daemon).unwrap();
    let service = Running::in_directory(directory, config.path());
    service.wait_for("waiting");
    let (status, reply) = service.post("start", &json!({"name": "full"}));
    assert_eq!(status, 409);
    assert!(reply["error"].as_str().unwrap().contains("disk floor"), "{reply}");
    let lines: Vec<CheckLine> = service.get("check");
    assert!(lines.iter().any(|line| line.subject == "disk" && line.remedy.is_some()), "{lines:?}");
    assert_eq!(std::fs::read_dir(service.directory.path()).unwrap().count(), 0);
}

/// A file system of 8 MB, unmounted when the test is over.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn mount() -> Option<Self> {
        let directory = tempfile::tempdir().unwrap();
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=8m", "tmpfs"])
            .arg(directory.path())
            .stderr(Stdio::null())
            .status();
        mounted.is_ok_and(|status| status.success()).then(|| Self(directory))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
    }
}

#[test]
fn a_disk_that_others_fill_ends_the_run_with_a_finished_file() {
    let Some(disk) = SmallDisk::mount() else {
        println!("skipped: mounting a small disk needs root");
        return;
    };
    let config = tempfile::tempdir().unwrap();
    std::fs::copy(shipped().join("ball_bar.toml"), config.path().join("ball_bar.toml")).unwrap();
    let daemon = std::fs::read_to_string(shipped().join("daemon.toml")).unwrap();
    let daemon = daemon.replace("disk_floor_mb = 500", "disk_floor_mb = 2");
    std::fs::write(config.path().join("daemon.toml"), daemon).unwrap();
    let service = Running::in_directory(tempfile::tempdir_in(disk.0.path()).unwrap(), config.path());
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "filled"}));
    let cycles = service.wait_for("writing").run.unwrap().cycles;
    std::fs::write(disk.0.path().join("others"), vec![1; 6_800_000]).unwrap();
    let last = service.wait_for("waiting").last.unwrap();
    assert!(last.cause.contains("disk floor") && last.cycles >= cycles, "{last:?}");
    let recording = service.recording("filled");
    assert_eq!(recording.end.cause, last.cause);
    assert_eq!(service.post("start", &json!({"name": "next"})).0, 409);
}
