//! Messages that the service sends to the service manager, and its lines in the journal.

use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixDatagram;
use std::process::Stdio;
use std::time::{Duration, Instant};

use serde_json::json;

use super::rig::{Running, quick};
use crate::support::ballbard;

/// Starts a service with this standard error and with environment variables that systemd would set.
fn under_systemd(stderr: Stdio, environment: &[(&str, String)]) -> Running {
    let mut command = ballbard();
    command.stderr(stderr).envs(environment.iter().map(|(name, value)| (name, value)));
    Running::by(command, tempfile::tempdir().unwrap(), quick().path(), &[])
}

#[test]
fn systemd_is_notified_that_the_service_is_ready_and_lives() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let environment = [("NOTIFY_SOCKET", path.display().to_string()), ("WATCHDOG_USEC", "900000".to_owned())];
    let service = under_systemd(Stdio::null(), &environment);
    let mut told = Vec::new();
    let is_fed = |told: &[String]| told.iter().filter(|line| *line == "WATCHDOG=1").count() >= 5;
    while !is_fed(&told) || !told.iter().any(|line| line == "STATUS=READY") {
        let mut bytes = [0; 200];
        let length = socket.recv(&mut bytes).expect("no message to systemd");
        told.push(String::from_utf8_lossy(&bytes[..length]).trim().to_owned());
    }
    assert_eq!(told[0], "READY=1");
    drop(service);
}

#[test]
fn the_journal_has_begin_and_refusals_with_their_priority_and_no_flood_of_them() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("journal");
    let journal = File::create(&path).unwrap();
    let found = journal.metadata().unwrap();
    let stream = format!("{}:{}", found.dev(), found.ino());
    let service = under_systemd(journal.into(), &[("JOURNAL_STREAM", stream)]);
    service.wait_for("waiting");
    for _ in 0..50 {
        assert_eq!(service.post("mark", &json!({"text": "x"})).0, 409);
    }
    service.granted("start", &json!({"name": "logged"}));
    service.wait_for("writing");
    service.granted("stop", &json!({}));
    let log = || std::fs::read_to_string(&path).unwrap();
    let begun = Instant::now();
    while !log().contains("run is over") {
        assert!(begun.elapsed() < Duration::from_secs(10), "{}", log());
        std::thread::sleep(Duration::from_millis(50));
    }
    let log = log();
    assert!(log.lines().all(|line| line.starts_with('<') && line.as_bytes()[2] == b'>'), "{log}");
    assert!(log.lines().any(|line| line.starts_with("<6>run begins") && line.contains("logged")), "{log}");
    let refused: Vec<_> =
        log.lines().filter(|line| line.starts_with("<4>refused: POST /api/mark: no run")).collect();
    assert_eq!(refused.len(), 20, "{log}");
    assert!(refused[19].contains("omitted"), "{}", refused[19]);
}
