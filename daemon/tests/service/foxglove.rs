//! Live data of a run. One receiver is an independent client of Foxglove's protocol, another is a client that reads nothing.

use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use ballbard::control::api;
use ballbard::control::live_tap::LiveTap;
use ballbard::control::service::{Service, Settings};
use ballbard::homing::MarksFile;
use ballbard::run::BusChoice;
use serde_json::Value;
use shared::config;
use shared::config::{BallBarConfig, DaemonConfig};
use shared::recording::TOPICS;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

use super::rig::{Running, agent, shipped, text};

#[test]
#[ignore = "needs Python with websocket-client, mcap and mcap-ros2-support: set BALLBAR_PYTHON"]
fn an_independent_client_is_shown_what_is_recorded_and_nothing_else() {
    let service = Running::with_arguments(&["--foxglove"]);
    service.wait_for("waiting");
    let python =
        std::env::var_os("BALLBAR_PYTHON").expect("BALLBAR_PYTHON: a Python with tests/requirements.txt");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/service/foxglove.py");
    let output = Command::new(python).arg(script).arg(&service.port).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
}

/// Sends an upgrade request from a page of `origin`. Returns the status code and text of the answer.
fn asked(service: &Running, origin: Option<&str>, protocol: &str) -> (u16, String) {
    let url = format!("http://127.0.0.1:{}/foxglove", service.port);
    let request = agent().get(&url).header("Connection", "upgrade").header("Upgrade", "websocket");
    let request =
        request.header("Sec-WebSocket-Version", "13").header("Sec-WebSocket-Key", "AAAAAAAAAAAAAAAAAAAAAA==");
    let request = request.header("Sec-WebSocket-Protocol", protocol);
    let mut answer =
        origin.iter().fold(request, |request, origin| request.header("Origin", *origin)).call().unwrap();
    let status = answer.status().as_u16();
    (status, if status == 101 { String::new() } else { answer.body_mut().read_to_string().unwrap() })
}

#[test]
fn nobody_listens_to_a_service_that_was_not_asked_to_let_them_or_from_a_foreign_page() {
    let (protocol, app) = ("foxglove.sdk.v1", "https://app.foxglove.dev");
    let silent = Running::start();
    let (status, said) = asked(&silent, None, protocol);
    assert!(status == 404 && said.contains("--foxglove"), "{status} {said}");
    let open = Running::with_arguments(&["--foxglove"]);
    let (status, said) = asked(&open, Some(app), protocol);
    assert!(status == 403 && said.contains("--foxglove-origin"), "{status} {said}");
    let (status, said) = asked(&open, None, "chat");
    assert!(status == 400 && said.contains(protocol), "{status} {said}");
    let wider = Running::with_arguments(&["--foxglove", "--foxglove-origin", app]);
    for (origin, expected) in [
        (None, 101),
        (Some(app), 101),
        (Some("http://localhost:8080"), 101),
        (Some("https://evil.example"), 403),
    ] {
        assert_eq!(asked(&wider, origin, protocol).0, expected, "{origin:?}");
    }
    // A page of this origin must still not have access to the rest of the service.
    let url = wider.url("status");
    assert_eq!(agent().get(&url).header("Origin", app).call().unwrap().status(), 403);
}

/// Starts a service in this process that serves the live data of `tap`. Returns the service and its port.
fn served(directory: &Path, tap: &LiveTap) -> (Service, u16) {
    let daemon: DaemonConfig = config::load(&shipped().join("daemon.toml")).unwrap();
    let bar: BallBarConfig = config::load(&shipped().join("ball_bar.toml")).unwrap();
    let settings = Settings {
        bus: BusChoice::Interface("none-such".into()),
        faults: Vec::new(),
        daemon: DaemonConfig {
            directory: directory.into(),
            spare_directory: directory.join("spare"),
            ..daemon
        },
        bar,
        marks_file: MarksFile::new(directory.into(), None),
        live_tap: Some(tap.clone()),
    };
    let service = Service::start(settings).unwrap();
    let (serving, (port, at)) = (service.clone(), std::sync::mpsc::channel());
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let listener = tokio::net::TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
            port.send(listener.local_addr().unwrap().port()).unwrap();
            let ending = serving.clone();
            api::serve(listener, None, serving, async move { ending.ended().await }).await;
        });
    });
    (service, at.recv().unwrap())
}

/// Reads messages up to the next text message. Returns this message, and the log time of the last data message before it.
fn next_text(socket: &mut WebSocket<TcpStream>) -> (Value, Option<u64>) {
    let mut latest = None;
    loop {
        match socket.read().unwrap() {
            Message::Text(text) => return (serde_json::from_str(&text).unwrap(), latest),
            Message::Binary(data) => latest = Some(u64::from_le_bytes(data[5..13].try_into().unwrap())),
            _ => {}
        }
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn a_client_that_takes_nothing_misses_messages_is_told_so_and_holds_up_nobody() {
    const MESSAGES: u64 = 100_000;
    let directory = tempfile::tempdir().unwrap();
    let tap = LiveTap::new(Vec::new());
    let (service, port) = served(directory.path(), &tap);
    let mut request = format!("ws://127.0.0.1:{port}/foxglove").into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.websocket.v1".parse().unwrap());
    let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let (mut socket, _) = tungstenite::client(request, stream).unwrap();
    assert_eq!(next_text(&mut socket).0["op"], "serverInfo");
    assert_eq!(next_text(&mut socket).0["op"], "advertise");
    // The second subscription is invalid. When it is refused, the service has also processed the first one.
    let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":0},{"id":8,"channelId":99}]}"#;
    socket.send(Message::text(subscribe)).unwrap();
    let (refused, _) = next_text(&mut socket);
    assert!(refused["message"].as_str().unwrap().contains("subscription 8"), "{refused}");
    // The data have 40 MB, and the kernel buffers only some of them. If the service waited for this
    // client, it would wait forever.
    let mut write = tap.writer_end();
    let mut longest = Duration::ZERO;
    for log_time_ns in 0..MESSAGES {
        let begun = Instant::now();
        write(TOPICS[0], log_time_ns, &[0; 400]);
        longest = longest.max(begun.elapsed());
        if log_time_ns % 250 == 0 {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    assert!(longest < Duration::from_secs(10), "{longest:?}");
    let (told, latest) = next_text(&mut socket);
    assert!(told["message"].as_str().unwrap().contains("messages were not sent"), "{told}");
    assert!(latest.is_some_and(|latest| latest < MESSAGES - 1), "{latest:?}");
    // After data were lost, the stream continues with new data.
    write(TOPICS[0], MESSAGES, &[1]);
    let newest = loop {
        if let Message::Binary(data) = socket.read().unwrap()
            && data[5..13] == MESSAGES.to_le_bytes()
        {
            break data;
        }
    };
    assert_eq!(
        (newest[0], &newest[1..5], &newest[13..]),
        (1, 7_u32.to_le_bytes().as_slice(), [1].as_slice())
    );
    // After the end of the recording, the service still sends pings. It thereby notices a lost client
    // and can accept another client.
    while !matches!(socket.read().unwrap(), Message::Ping(_)) {}
    service.shutdown("test over");
    service.join().unwrap();
    assert!(loop {
        match socket.read() {
            Ok(Message::Close(_)) | Err(_) => break true,
            Ok(_) => {}
        }
    });
}
