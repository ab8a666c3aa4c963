//! Runs command lines of `identify`.

use std::path::Path;
use std::process::{Command, Output};

use super::repository;

/// Runs `identify` with these arguments, a robot of `config/robots`, and a directory for results.
pub fn identify(arguments: &[&str], robot: &str, out: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_identify"))
        .args(arguments)
        .arg("--robot")
        .arg(repository("config/robots").join(robot))
        .arg("--out")
        .arg(out)
        .env("RUST_LOG", "off")
        .output()
        .unwrap()
}
