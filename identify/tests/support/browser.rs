//! Pages in a real browser.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// What a browser makes of a page, and whom it asks on the way.
pub struct Shown {
    /// What a parser of HTML made of the text, not what we wrote.
    pub document: String,
    /// Addresses on the web that it asked for.
    pub foreign: Vec<String>,
    /// What the browser said of itself.
    pub stderr: String,
}

/// Opens a page.
pub fn shown(text: &str) -> Shown {
    let directory = tempfile::tempdir().unwrap();
    let page = directory.path().join("report.html");
    std::fs::write(&page, text).unwrap();
    let requests = directory.path().join("requests.json");
    let output = Command::new(browser())
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args([
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--dump-dom",
        ])
        .arg(format!("--user-data-dir={}", directory.path().join("profile").display()))
        .arg(format!("--log-net-log={}", requests.display()))
        .arg(format!("file://{}", page.display()))
        .output()
        .unwrap();
    Shown {
        document: String::from_utf8_lossy(&output.stdout).into_owned(),
        foreign: foreign(&requests),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    }
}

/// Addresses on the web that a browser's log of requests names, without those that it visits by itself at any start.
fn foreign(log: &Path) -> Vec<String> {
    let log: Value = serde_json::from_slice(&std::fs::read(log).unwrap()).unwrap();
    let address = |event: &Value| event["params"]["url"].as_str().map(str::to_owned);
    let of_browser = |url: &str| ["google", "gstatic", "chrome"].iter().any(|name| url.contains(name));
    let events = log["events"].as_array().unwrap().iter().filter_map(address);
    events.filter(|url| url.starts_with("http") && !of_browser(url)).collect()
}

/// Chromium.
fn browser() -> PathBuf {
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let found = ["chromium", "chromium-browser", "google-chrome"].iter().find_map(|name| {
        std::env::split_paths(&paths).map(|path| path.join(name)).find(|path| path.is_file())
    });
    found.expect("chromium is missing: apt-get install chromium")
}
