//! Gives `version.rs` the commit that is built: from git, or in a source archive from `commit.txt`, which `git archive` fills in.

use std::path::Path;
use std::process::Command;

/// The sources of both programs, as seen from this directory.
const SOURCES: [&str; 10] = [
    "../Cargo.lock",
    "../Cargo.toml",
    "../config",
    "../daemon/simulated-segment/src",
    "../daemon/src",
    "../identify/core/src",
    "../identify/program/src",
    "../identify/src",
    "generate/src",
    "src",
];

fn main() {
    println!("cargo::rerun-if-changed=build.rs\ncargo::rerun-if-changed=commit.txt");
    println!("cargo::rerun-if-env-changed=SOURCE_DATE_EPOCH");
    // To follow every commit and edit would build all crates anew after each: a debug build states the commit of this
    // crate's last build, "or later".
    let is_debug = std::env::var("PROFILE").is_ok_and(|profile| profile != "release");
    let archived = std::fs::read_to_string("commit.txt").ok().filter(|text| !text.starts_with("$Format"));
    let commit = archived.or_else(|| commit_of_git(!is_debug)).unwrap_or_default();
    let (hash, committed_s) = commit.trim().split_once(' ').unwrap_or_default();
    let date_s = std::env::var("SOURCE_DATE_EPOCH").unwrap_or_else(|_| committed_s.to_owned());
    let state = if is_debug {
        "debug build"
    } else if !hash.is_empty() && is_modified() {
        "modified"
    } else {
        ""
    };
    println!("cargo::rustc-env=COMMIT_HASH={hash}\ncargo::rustc-env=COMMIT_TIME_S={date_s}");
    println!("cargo::rustc-env=BUILD_STATE={state}");
}

/// Hash and time \[s\] of the commit that is checked out, unless this directory lies in another project's repository. `follow`: this
/// crate is built anew after the next commit.
fn commit_of_git(follow: bool) -> Option<String> {
    if git(&["rev-parse", "--show-prefix"])?.trim() != "shared/" {
        return None;
    }
    // `logs/HEAD` grows with each commit; a path that is missing would build this crate each time.
    for name in ["HEAD", "logs/HEAD"].iter().filter(|_| follow) {
        let path = git(&["rev-parse", "--git-path", name])?;
        if Path::new(path.trim()).exists() {
            println!("cargo::rerun-if-changed={}", path.trim());
        }
    }
    git(&["show", "--no-patch", "--format=%H %ct", "HEAD"])
}

/// Whether the sources differ from their commit; unknown, and false, in an archive.
fn is_modified() -> bool {
    SOURCES.iter().for_each(|path| println!("cargo::rerun-if-changed={path}"));
    let status = git(&[&["status", "--porcelain", "--"], &SOURCES[..]].concat());
    status.is_some_and(|changes| !changes.is_empty())
}

fn git(arguments: &[&str]) -> Option<String> {
    // Without a lock: `git status` would otherwise rewrite the index, and may disturb another git command.
    let output = Command::new("git").arg("--no-optional-locks").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}
