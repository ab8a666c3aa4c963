//! Shows pages in a real browser.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// Content of a page as shown by the browser, and its requests to other hosts.
pub struct Shown {
    /// Document after the browser has parsed it and run its scripts.
    pub document: String,
    /// Addresses of other hosts that the page requested.
    pub foreign: Vec<String>,
    /// Messages of the browser.
    pub stderr: String,
}

/// Opens a page in the browser and returns its content.
pub fn shown(text: &str) -> Shown {
    let directory = tempfile::tempdir().unwrap();
    let page = directory.path().join("report.html");
    std::fs::write(&page, text).unwrap();
    let requests = directory.path().join("requests.json");
    let log = format!("--log-net-log={}", requests.display());
    // Run for one second of virtual time, so that the scripts of the page have drawn. Software rendering is needed on
    // machines without a graphics processor.
    let drawn = ["--enable-unsafe-swiftshader", "--virtual-time-budget=1000"];
    let output =
        browser(directory.path()).args(drawn).args(["--dump-dom", &log]).arg(&page).output().unwrap();
    Shown {
        document: String::from_utf8_lossy(&output.stdout).into_owned(),
        foreign: foreign(&requests),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    }
}

/// Data of the three-dimensional view of a page.
pub fn scene(page: &str) -> Value {
    let scene = page.split_once("id=\"path-scene\"").unwrap().1.split_once('>').unwrap().1;
    serde_json::from_str(scene.split_once("</script>").unwrap().0).unwrap()
}

/// Text of each sheet of a page when it is printed. Another program extracts the text from the PDF.
pub fn printed(text: &str) -> Vec<String> {
    const READ: &str = "import json, sys, pypdf; print(json.dumps([sheet.extract_text() for sheet in pypdf.PdfReader(sys.argv[1]).pages]))";
    let directory = tempfile::tempdir().unwrap();
    let [page, sheets] = ["report.html", "report.pdf"].map(|name| directory.path().join(name));
    std::fs::write(&page, text).unwrap();
    let print = format!("--print-to-pdf={}", sheets.display());
    let output =
        browser(directory.path()).args(["--no-pdf-header-footer", &print]).arg(&page).output().unwrap();
    assert!(sheets.is_file(), "{}", String::from_utf8_lossy(&output.stderr));
    let python =
        std::env::var_os("BALLBAR_PYTHON").expect("BALLBAR_PYTHON: a Python with tests/requirements.txt");
    let read = Command::new(python).args(["-c", READ]).arg(&sheets).output().unwrap();
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
    serde_json::from_slice(&read.stdout).unwrap()
}

/// Addresses of other hosts in the browser's log of requests, except those that the browser itself requests at every start.
fn foreign(log: &Path) -> Vec<String> {
    let log: Value = serde_json::from_slice(&std::fs::read(log).unwrap()).unwrap();
    let address = |event: &Value| event["params"]["url"].as_str().map(str::to_owned);
    let of_browser = |url: &str| ["google", "gstatic", "chrome"].iter().any(|name| url.contains(name));
    let events = log["events"].as_array().unwrap().iter().filter_map(address);
    events.filter(|url| url.starts_with("http") && !of_browser(url)).collect()
}

/// A command for Chromium without a window. Chromium keeps its data in this directory. The path of
/// a file may be given as an address.
fn browser(directory: &Path) -> Command {
    let mut command = Command::new(chromium());
    command
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .arg(format!("--user-data-dir={}", directory.join("profile").display()));
    command
}

fn chromium() -> PathBuf {
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let found = ["chromium", "chromium-browser", "google-chrome"].iter().find_map(|name| {
        std::env::split_paths(&paths).map(|path| path.join(name)).find(|path| path.is_file())
    });
    found.expect("chromium is missing: apt-get install chromium")
}
