//! Tests the Python package `ballbar` with the native module that was just compiled. The test needs no wheel, because
//! a wheel only packs the same files.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::path::Path;
use std::process::Command;

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn the_package_does_what_the_command_does() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    // The compiled module is in the parent directory of the test programs.
    let test = std::env::current_exe().unwrap();
    let built = test.parent().unwrap().parent().unwrap();
    let installed = tempfile::tempdir().unwrap();
    let package = installed.path().join("ballbar");
    std::fs::create_dir(&package).unwrap();
    std::fs::copy(here.join("ballbar/__init__.py"), package.join("__init__.py")).unwrap();
    std::fs::copy(built.join("deps/lib_native.so"), package.join("_native.abi3.so")).unwrap();
    let python = std::env::var_os("BALLBAR_PYTHON").unwrap_or_else(|| "python3".into());
    let tests = Command::new(python)
        .arg(here.join("tests/test_ballbar.py"))
        .env("PYTHONPATH", installed.path())
        // Run in another directory: in the directory of the sources, Python would find the
        // package without its native module.
        .current_dir(installed.path())
        .env("BALLBAR_IDENTIFY", built.join("identify"))
        .status();
    assert!(tests.unwrap().success(), "the tests above went wrong");
}
