//! Other machines: nobody without the token, by an independent client and in a real browser.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use ballbard::control::status::Status;

use super::rig::{Running, agent, shipped};
use crate::support::ballbard;

fn open(arguments: &[&str]) -> Running {
    Running::with(tempfile::tempdir().unwrap(), &shipped(), arguments)
}

fn token(service: &Running) -> String {
    fs::read_to_string(service.directory.path().join("token")).unwrap()
}

/// Port of the TLS listener, as the status names it.
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
    // Programs of this machine are served as before.
    assert_eq!(service.get::<Status>("status").state, "waiting");
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

#[test]
fn a_reverse_proxy_is_let_in_under_its_name_and_with_the_token() {
    let service = open(&["--behind-proxy", "lab.example"]);
    service.wait_for("waiting");
    let token = token(&service);
    let asked = |headers: &[(&str, &str)]| {
        let request = agent().get(service.url("status"));
        let request = headers.iter().fold(request, |request, (name, value)| request.header(*name, *value));
        let mut answer = request.call().unwrap();
        (answer.status().as_u16(), answer.body_mut().read_to_string().unwrap())
    };
    let bearer = format!("Bearer {token}");
    for (headers, expected) in [
        (vec![("Host", "lab.example"), ("Authorization", &bearer)], 200),
        (vec![("Host", "lab.example"), ("Origin", "https://lab.example"), ("Authorization", &bearer)], 200),
        (vec![("Host", "lab.example")], 401),
        (vec![("Host", "lab.example"), ("Authorization", "Bearer x")], 401),
        (vec![("Host", "other.example"), ("Authorization", &bearer)], 403),
        (vec![("Host", "lab.example"), ("Origin", "https://evil.example"), ("Authorization", &bearer)], 403),
        (vec![("Host", "lab.example"), ("Origin", "http://lab.example"), ("Authorization", &bearer)], 403),
    ] {
        let (status, said) = asked(&headers);
        assert_eq!(status, expected, "{headers:?}: {said}");
    }
    let (_, said) = asked(&[("Host", "lab.example")]);
    assert!(said.contains("state directory") && said.contains("?token="), "no remedy in: {said}");
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
    let again = Running::with(directory, &shipped(), &["--listen", "127.0.0.1:0"]);
    let status: Status = again.get("status");
    let second = (token(&again), status.remote.unwrap().split("SHA-256").nth(1).unwrap().to_owned());
    assert_eq!(first, second);
}

/// Starts with what is in the directory, and gives what it says when it refuses.
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
    // One without the other is not understood.
    let said = refused(directory.path(), &["--listen", "127.0.0.1:0", "--certificate", given]);
    assert!(said.contains("--key"), "{said}");
}
