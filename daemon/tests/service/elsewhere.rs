//! Commands that are sent to the service of another machine. The tests check the effect of the commands. They also check
//! that nothing is sent to any third machine.

use std::io::Read;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::Arc;

use ballbard::control::recordings::runs::RunLine;
use ballbard::control::status::{Granted, Reply, Status};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::sign::{CertifiedKey, SingleCertAndKey};
use tokio_rustls::rustls::{ServerConfig, ServerConnection};

use super::rig::{Running, text};
use crate::support::ballbard;

/// A service that accepts other machines. The address, the token and the certificate are those that other machines need.
struct Far {
    service: Running,
    url: String,
    fingerprint: String,
}

impl Far {
    fn new() -> Self {
        let service = Running::with_arguments(&["--listen", "127.0.0.1:0"]);
        let words = service.get::<Status>("status").remote.unwrap();
        let (url, rest) = words.split_once(", certificate SHA-256 ").unwrap();
        let fingerprint = rest.split(';').next().unwrap().to_owned();
        Self { url: url.into(), fingerprint, service }
    }

    fn token(&self) -> PathBuf {
        self.service.directory.path().join("token")
    }

    /// Runs a command as on another machine. `directory` is the working directory there.
    fn command(&self, directory: &Path, arguments: &[&str]) -> Output {
        ask(directory, arguments, &self.url, &self.token(), &self.fingerprint)
    }

    fn done(&self, directory: &Path, arguments: &[&str]) -> String {
        let output = self.command(directory, arguments);
        assert!(output.status.success(), "{arguments:?}: {}", text(&output));
        String::from_utf8(output.stdout).unwrap()
    }
}

fn ask(directory: &Path, arguments: &[&str], url: &str, token: &Path, fingerprint: &str) -> Output {
    let mut command = ballbard();
    command.env("RUST_LOG", "off").current_dir(directory).args(arguments).args(["--service", url]);
    command.arg("--token-file").arg(token).args(["--fingerprint", fingerprint]).output().unwrap()
}

#[test]
fn a_run_is_recorded_marked_noted_and_exported_on_another_machine() {
    let far = Far::new();
    let here = tempfile::tempdir().unwrap();
    let done = |arguments: &[&str]| far.done(here.path(), arguments);
    far.service.wait_until_ready();
    let status = done(&["status"]);
    assert!(["READY", "CHECK"].iter().any(|word| status.starts_with(word)), "{status}");
    let begun: Reply = serde_json::from_str(&done(&[
        "start",
        "--name",
        "far",
        "--note",
        "before",
        "--reason",
        "may be late",
        "--json",
    ]))
    .unwrap();
    assert_eq!((begun.answer, begun.run.as_deref()), (Granted::Begun, Some("far")));
    far.service.wait_for("writing");
    assert!(done(&["mark", "half"]).contains("`far`"));
    assert!(done(&["stop"]).contains("far.mcap"));
    done(&["note", "far", "after"]);
    let lines: Vec<RunLine> = serde_json::from_str(&done(&["runs", "--json"])).unwrap();
    assert_eq!((lines[0].name.as_str(), lines[0].note.as_str()), ("far", "after"));
    // The exported table must equal the one on the service's machine and contain the current note. The command runs
    // in a directory without recordings.
    done(&["export", "far", "--csv", "--relative"]);
    let there = tempfile::tempdir().unwrap();
    let table = there.path().join("far.csv");
    let local = ["export", "far", "--csv", "--relative", "--out", table.to_str().unwrap()];
    assert!(far.service.command(&local).status.success());
    let fetched = std::fs::read_to_string(here.path().join("far.csv")).unwrap();
    assert_eq!(fetched, std::fs::read_to_string(&table).unwrap());
    assert!(fetched.contains("note: after") && fetched.contains("mark: half"));
    // An existing table must not be overwritten. A local file must not be used in place of a run of the other machine.
    let again = far.command(here.path(), &["export", "far", "--csv"]);
    assert!(!again.status.success() && text(&again).contains("--force"), "{}", text(&again));
    let own = far.service.directory.path().join("far.mcap");
    let own = far.command(here.path(), &["export", own.to_str().unwrap(), "--csv"]);
    assert!(!own.status.success() && text(&own).contains("no finished run"), "{}", text(&own));
    assert!(text(&far.command(here.path(), &["mark", "late"])).contains("no run is active"));
}

#[test]
fn whoever_has_another_certificate_is_told_nothing() {
    let (far, other) = (Far::new(), Far::new());
    let here = tempfile::tempdir().unwrap();
    let output = ask(here.path(), &["status"], &other.url, &far.token(), &far.fingerprint);
    let said = text(&output);
    assert!(!output.status.success());
    for told in [other.url.as_str(), &other.fingerprint, &far.fingerprint, "ballbard status"] {
        assert!(said.contains(told), "`{told}` is missing in: {said}");
    }
}

#[test]
fn whoever_has_the_certificate_without_its_key_is_told_nothing() {
    let (far, other) = (Far::new(), Far::new());
    let certificate = CertificateDer::from_pem_file(far.service.directory.path().join("certificate.pem"));
    let key = PrivateKeyDer::from_pem_file(other.service.directory.path().join("key.pem"));
    let key = ring::sign::any_supported_type(&key.unwrap()).unwrap();
    let shown = SingleCertAndKey::from(CertifiedKey::new(vec![certificate.unwrap()], key));
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(shown));
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("https://{}", listener.local_addr().unwrap());
    let greeted = std::thread::spawn(move || {
        let mut stream = listener.accept().unwrap().0;
        ServerConnection::new(Arc::new(config)).unwrap().complete_io(&mut stream)
    });
    let here = tempfile::tempdir().unwrap();
    let output = ask(here.path(), &["status"], &url, &far.token(), &far.fingerprint);
    assert!(!output.status.success() && text(&output).contains(&url), "{}", text(&output));
    assert!(text(&output).contains("ignature"), "{}", text(&output));
    assert!(greeted.join().unwrap().is_err(), "the client agreed");
}

#[test]
fn what_is_wrong_with_address_token_or_network_is_said_with_the_remedy() {
    let far = Far::new();
    let here = tempfile::tempdir().unwrap();
    let refused = |url: &str, token: &Path, told: &[&str]| {
        let output = ask(here.path(), &["status"], url, token, &far.fingerprint);
        assert!(!output.status.success());
        for told in told {
            assert!(text(&output).contains(told), "`{told}` is missing in: {}", text(&output));
        }
    };
    // An address without a listener, and an address whose listener does not use TLS.
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let nobody = format!("https://{free}");
    refused(&nobody, &far.token(), &[&nobody, "refused", "ballbard run --listen"]);
    let plain = format!("https://127.0.0.1:{}", far.service.port);
    refused(&plain, &far.token(), &[&plain, "does not use TLS", "--listen"]);
    // A token file that is missing, a token file that other users may read, and a wrong token.
    let token = here.path().join("token");
    refused(&far.url, &token, &["token", "copy the file `token`"]);
    std::fs::write(&token, "a".repeat(64)).unwrap();
    std::fs::set_permissions(&token, std::fs::Permissions::from_mode(0o644)).unwrap();
    refused(&far.url, &token, &["chmod 600"]);
    std::fs::set_permissions(&token, std::fs::Permissions::from_mode(0o600)).unwrap();
    refused(&far.url, &token, &[&far.url, token.to_str().unwrap(), "the token is wrong", "state directory"]);
    // Commands with an invalid address are refused before any request is sent.
    for (arguments, told) in [
        (vec!["status", "--service", &far.url], "--token-file"),
        (vec!["status", "--token-file", "x"], "--service"),
        (
            vec![
                "status",
                "--service",
                "http://127.0.0.1:1",
                "--token-file",
                "x",
                "--fingerprint",
                &far.fingerprint,
            ],
            "https://",
        ),
        (
            vec!["status", "--service", &far.url, "--token-file", "x", "--fingerprint", "ab:cd"],
            "64 hexadecimal",
        ),
        (
            vec![
                "runs",
                "here",
                "--service",
                &far.url,
                "--token-file",
                "x",
                "--fingerprint",
                &far.fingerprint,
            ],
            "--service",
        ),
        (
            vec![
                "status",
                "--port",
                "1",
                "--service",
                &far.url,
                "--token-file",
                "x",
                "--fingerprint",
                &far.fingerprint,
            ],
            "--port",
        ),
    ] {
        let output = ballbard().args(&arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(text(&output).contains(told), "{arguments:?}: {}", text(&output));
    }
    far.service.wait_for("waiting");
}

#[test]
fn before_the_certificate_is_known_nothing_of_the_token_is_on_the_wire() {
    let far = Far::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("https://{}", listener.local_addr().unwrap());
    // A listener that receives everything that is sent, and then closes the connection.
    let sent = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut sent = vec![0; 4096];
        let length = stream.read(&mut sent).unwrap();
        sent.truncate(length);
        sent
    });
    let here = tempfile::tempdir().unwrap();
    let output = ask(here.path(), &["status"], &url, &far.token(), &far.fingerprint);
    assert!(!output.status.success() && text(&output).contains(&url), "{}", text(&output));
    let (sent, token) = (sent.join().unwrap(), std::fs::read(far.token()).unwrap());
    assert!(sent.len() > 100 && !sent.windows(token.len()).any(|window| window == token), "{sent:?}");
    assert!(!String::from_utf8_lossy(&sent).contains("HTTP"), "{sent:?}");
}
