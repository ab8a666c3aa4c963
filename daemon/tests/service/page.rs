//! Requests that the page sends: current state, recordings, deletion.

use ballbard::control::status::Granted;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ballbard::control::live::{Live, Minute};
use ballbard::control::recordings::runs::{Curves, RunLine};
use serde::de::DeserializeOwned;
use serde_json::json;

use super::rig::{Running, agent, quick, text};

/// Subscribes to the events of the service. Returns the stream of events.
fn listen(service: &Running) -> BufReader<TcpStream> {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{}", service.port)).unwrap();
    let port = &service.port;
    write!(stream, "GET /api/events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n").unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    BufReader::new(stream)
}

fn next<T: DeserializeOwned>(events: &mut impl BufRead) -> Option<T> {
    let mut line = String::new();
    while events.read_line(&mut line).ok()? > 0 {
        if let Some(json) = line.strip_prefix("data: ") {
            return Some(serde_json::from_str(json).unwrap());
        }
        line.clear();
    }
    None
}

fn fetch(service: &Running, path: &str) -> (u16, String, Vec<u8>) {
    let mut response = agent().get(&service.url(path)).call().unwrap();
    let named = response.headers().get("content-disposition").map(|name| name.to_str().unwrap().to_owned());
    let body = response.body_mut().read_to_vec().unwrap();
    (response.status().as_u16(), named.unwrap_or_default(), body)
}

#[test]
fn events_come_ten_times_a_second_with_what_moves_and_end_with_the_service() {
    let mut service = Running::start();
    service.wait_for("waiting");
    let mut events = listen(&service);
    next::<Minute>(&mut events).unwrap();
    // The first event from now on with angles of all joints. On a busy machine, cycles may be late.
    let mut next_with_angles = || {
        std::iter::from_fn(|| next::<Live>(&mut events))
            .find(|live| live.joints.iter().all(|joint| joint.speed_deg_per_s.is_some()))
            .unwrap()
    };
    let moments: Vec<Live> = (0..10).map(|_| next_with_angles()).collect();
    let (first, last) = (&moments[0], &moments[9]);
    // On a busy machine, 10 events may take more time, but never less.
    let lasted_ms = last.at_ms - first.at_ms;
    assert!(lasted_ms >= 800, "10 events in {lasted_ms} ms");
    assert_eq!(last.joints.len(), 5);
    for (before, after) in first.joints.iter().zip(&last.joints) {
        assert_ne!(before.angle_deg.unwrap(), after.angle_deg.unwrap());
        assert!(after.speed_deg_per_s.unwrap().abs() < 30.0);
    }
    assert!(last.disk_hours.unwrap() > 0.0);
    // A new subscriber first gets the values of the last minute.
    let Minute { at_ms, angles_deg } = next(&mut listen(&service)).unwrap();
    assert!(at_ms.iter().rev().zip(at_ms.iter().rev().skip(1)).all(|(after, before)| after > before));
    let place = at_ms.iter().position(|at| *at == first.at_ms).unwrap();
    for (angles, joint) in angles_deg.iter().zip(&first.joints) {
        assert!((angles[place].unwrap() - joint.angle_deg.unwrap()).abs() < 0.006, "{joint:?}");
    }
    // For a second after a busy machine has delayed cycles, the headline is CHECK.
    let mut words = (0..100).map(|_| next::<Live>(&mut events).unwrap().headline.word);
    assert!(words.any(|word| word == "READY"), "never READY in ten seconds");
    service.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(service.ended(Duration::from_secs(20)).success());
    while next::<Live>(&mut events).is_some() {}
}

#[test]
fn files_of_the_page_are_compressed_and_sent_again_only_if_they_changed() {
    let service = Running::start();
    let url = service.url("").replace("/api/", "/app.js");
    let mut plain = agent().get(&url).call().unwrap();
    let tag = plain.headers().get("etag").unwrap().clone();
    let length = plain.body_mut().read_to_vec().unwrap().len();
    let mut compressed = agent().get(&url).header("accept-encoding", "br, gzip").call().unwrap();
    assert_eq!(compressed.headers().get("content-encoding").unwrap(), "gzip");
    // Both versions have the same tag, so it must be weak.
    assert!(tag.as_bytes().starts_with(b"W/\"") && compressed.headers().get("etag") == Some(&tag), "{tag:?}");
    for version in [&plain, &compressed] {
        assert_eq!(version.headers().get("vary").unwrap(), "accept-encoding");
    }
    let bytes = compressed.body_mut().read_to_vec().unwrap();
    assert!(bytes.starts_with(&[0x1f, 0x8b]) && 2 * bytes.len() < length, "{} of {length}", bytes.len());
    let mut known = agent().get(&url).header("if-none-match", &tag).call().unwrap();
    assert_eq!((known.status().as_u16(), known.body_mut().read_to_vec().unwrap().len()), (304, 0));
    assert_eq!(agent().get(&url).header("if-none-match", "\"other\"").call().unwrap().status().as_u16(), 200);
}

#[test]
fn clients_that_take_no_event_hold_up_nobody_and_leave_places_for_others() {
    let service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "watched"}));
    service.wait_for("writing");
    let stuck: Vec<_> = (0..50).map(|_| listen(&service)).collect();
    std::thread::sleep(Duration::from_millis(500));
    // A subscriber beyond the limit receives an error that names an alternative.
    let mut refused = listen(&service);
    let mut line = String::new();
    refused.read_line(&mut line).unwrap();
    assert!(line.contains("503"), "{line}");
    // The subscribers read no events during the test. The service must still answer.
    let live: Live = service.get("live");
    assert_eq!(live.status.run.unwrap().name, "watched");
    let last = service.granted("stop", &json!({})).last.unwrap();
    assert_eq!(service.recording("watched").cycles.len() as u64, last.cycles);
    drop(stuck);
}

#[test]
fn a_recording_is_downloaded_as_it_is_and_as_a_table_and_deleted_by_its_name_alone() {
    let outside = tempfile::tempdir().unwrap();
    let service = Running::in_directory(tempfile::tempdir_in(outside.path()).unwrap(), quick().path(), &[]);
    service.wait_for("waiting");
    let about =
        json!({"name": "monday-1", "robot": "IRB 2400", "operator": "A", "bar": "short", "payload": "12 kg"});
    service.granted("start", &about);
    service.wait_for("writing");
    assert_eq!(fetch(&service, "runs/monday-1/mcap").0, 404, "the file of a running run is not offered");
    service.wait_for_cycles(60);
    let last = service.granted("stop", &json!({})).last.unwrap();
    let (code, named, bytes) = fetch(&service, "runs/monday-1/mcap");
    let expected = "attachment; filename=\"monday-1.mcap\"; filename*=UTF-8''monday%2D1%2Emcap";
    assert_eq!((code, named.as_str()), (200, expected));
    assert_eq!(bytes, std::fs::read(service.directory.path().join("monday-1.mcap")).unwrap());
    let (code, _, table) = fetch(&service, "runs/monday-1/csv");
    let rows = String::from_utf8(table).unwrap().lines().count() as u64;
    assert_eq!((code, rows), (200, last.cycles + 1));
    let Curves { t_s, joints } = service.get("runs/monday-1/plot");
    assert!(
        t_s.len() > 50 && joints.len() == 5 && joints.iter().all(|joint| joint.angle_deg.len() == t_s.len())
    );
    let lines: Vec<RunLine> = service.get("runs");
    let RunLine { robot, operator, bar, payload, .. } = &lines[0];
    assert_eq!([robot, operator, bar, payload], ["IRB 2400", "A", "short", "12 kg"]);
    // The service neither shows nor deletes files in other directories.
    let secret = outside.path().join("secret.mcap");
    std::fs::write(&secret, "secret").unwrap();
    for name in [
        "..%2Fsecret",
        "%2E%2E%2Fsecret",
        "..",
        "secret",
        "%00",
        "monday-1.mcap",
        "monday-1%2F..%2Fmonday-1",
        "%ff",
    ] {
        for kind in ["mcap", "csv"] {
            let (code, _, body) = fetch(&service, &format!("runs/{name}/{kind}"));
            assert!(matches!(code, 400 | 404), "{name}: {code}");
            assert!(!String::from_utf8_lossy(&body).contains("secret\n"), "{name}");
        }
    }
    for name in ["../secret", "/etc/passwd", "monday-1.mcap", ""] {
        assert_eq!(service.post("delete", &json!({"name": name})).0, 404, "{name}");
    }
    assert!(secret.exists());
    assert_eq!(service.granted("delete", &json!({"name": "monday-1"})).answer, Granted::Deleted);
    assert_eq!(service.get::<Vec<RunLine>>("runs"), []);
}

#[test]
fn the_page_is_served_with_all_that_it_needs() {
    let service = Running::start();
    let mut seen = vec![String::from("/")];
    let mut next = 0;
    while let Some(path) = seen.get(next).cloned() {
        let url = format!("http://127.0.0.1:{}{path}", service.port);
        let mut response = agent().get(&url).call().unwrap();
        assert_eq!(response.status(), 200, "{path}");
        let policy = response.headers().get("content-security-policy").unwrap().to_str().unwrap().to_owned();
        assert!(
            policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"),
            "{policy}"
        );
        let mut text = String::new();
        response.body_mut().as_reader().read_to_string(&mut text).unwrap();
        if !path.contains("uplot") {
            let named =
                text.split(['"', '\'']).filter(|word| word.ends_with(".js") || word.ends_with(".css"));
            for file in
                named.map(|word| format!("/{}", word.trim_start_matches("./").trim_start_matches('/')))
            {
                if !seen.contains(&file) {
                    seen.push(file);
                }
            }
            // A page must not load anything from other servers.
            assert!(!text.contains("https://") && !text.contains("//cdn"), "{path}");
        }
        next += 1;
    }
    assert!(seen.len() >= 9, "{seen:?}");
}

#[test]
#[ignore = "needs Python with openapi-spec-validator and jsonschema: set BALLBAR_PYTHON"]
fn every_answer_is_as_the_openapi_document_says_for_independent_validators() {
    let service = Running::with_arguments(&["--listen", "127.0.0.1:0"]);
    service.wait_for("waiting");
    let python =
        std::env::var_os("BALLBAR_PYTHON").expect("BALLBAR_PYTHON: a Python with tests/requirements.txt");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/service/openapi.py");
    let mut command = Command::new(python);
    let output = command.arg(script).arg(format!("http://127.0.0.1:{}", service.port)).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert!(text(&output).contains("19 paths hold"), "{}", text(&output));
}
