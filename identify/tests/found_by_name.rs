//! Robots and bars are found by name in a directory without such files. A file in the wrong place causes a message.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;
use std::process::{Command, Output};

use crate::support::repository;

/// Runs `identify` in a directory. Returns its exit code and all of its output.
fn identify(directory: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let Output { status, stdout, stderr } = Command::new(env!("CARGO_BIN_EXE_identify"))
        .current_dir(directory)
        .args(arguments)
        .env_remove("RUST_LOG")
        .output()
        .unwrap();
    (status.code(), [stdout, stderr].map(|text| String::from_utf8(text).unwrap()).concat())
}

#[test]
fn an_empty_directory_has_the_robots_and_the_bar_of_the_program() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let (code, listed) = identify(at, &["robot", "list"]);
    assert_eq!(code, Some(0), "{listed}");
    for (name, robot) in [("irb2400_16", "ABB IRB 2400/16"), ("ur10", "Universal Robots UR10")] {
        assert!(listed.lines().any(|line| line.starts_with(name) && line.contains(robot)), "{listed}");
    }
    let (code, told) = identify(at, &["examine", "--robot", "irb2400_16", "--cost", "pose", "--poses", "60"]);
    assert_eq!(code, Some(0), "{told}");
    assert!(
        told.contains("ABB IRB 2400/16 with double ball-bar") && told.contains("`ball_bar` as built into"),
        "{told}"
    );
    // If an argument is the name of a file, the file must exist. Its name must not select a built-in configuration, because
    // the lengths of another bar would cause a wrong scale.
    let (code, told) = identify(at, &["examine", "--robot", "irb2400_16", "--bar", "ball_bar.toml"]);
    assert_eq!(code, Some(1), "{told}");
    assert!(
        told.contains("there is no file ball_bar.toml") && told.contains("did you mean `ball_bar`?"),
        "{told}"
    );
    // A file in this directory has priority over the built-in configuration, and the output names it.
    std::fs::create_dir_all(at.join("config/robots")).unwrap();
    for name in ["ball_bar.toml", "robots/irb2400_16.toml"] {
        let text = std::fs::read_to_string(repository("config").join(name)).unwrap();
        let own = text.replace("ABB IRB", "Our ABB IRB").replace("double ball-bar", "our bar");
        std::fs::write(at.join("config").join(name), own).unwrap();
    }
    let (code, told) =
        identify(at, &["examine", "--robot", "irb2400_16.toml", "--cost", "pose", "--poses", "60"]);
    assert_eq!(code, Some(0), "{told}");
    assert!(told.contains("Our ABB IRB 2400/16 with our bar"), "{told}");
    assert!(
        told.contains("config/ball_bar.toml") && told.contains("config/robots/irb2400_16.toml"),
        "{told}"
    );
}

#[test]
fn a_result_of_a_named_robot_is_repeated_from_elsewhere() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let run = |arguments: &[&str]| {
        let (code, told) = identify(at, arguments);
        assert_eq!(code, Some(0), "{told}");
    };
    run(&["simulate", "contact", "--robot", "irb120_3", "--out", "seats"]);
    let calibrate = ["calibrate", "contact", "seats/contacts.csv", "--mapping", "seats/contact.toml"];
    run(&[&calibrate[..], &["--sockets", "seats/sockets.toml", "--robot", "irb120_3", "--out", "one"]]
        .concat());
    let experiment = std::fs::read_to_string(at.join("one/experiment.toml")).unwrap();
    assert!(experiment.contains("robot = \"irb120_3\""), "{experiment}");
    run(&["calibrate", "--experiment", "one/experiment.toml", "--out", "two"]);
}

#[test]
fn what_is_no_robot_is_said_with_what_there_is() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let bar = repository("config/ball_bar.toml");
    let (bar, robot) = (bar.to_str().unwrap(), "irb2400_16");
    std::fs::write(at.join("latin1.toml"), b"# K\xfcche\nname = \"\xfc\"\n").unwrap();
    std::fs::write(at.join("binary.toml"), b"\x89MCAP\0\0").unwrap();
    for (arguments, expected) in [
        (
            ["--robot", "irb2400", "--bar", bar],
            "did you mean `irb2400_16`? Known by name: irb120_3, irb2400_16",
        ),
        (
            ["--robot", "other/robot.toml", "--bar", bar],
            "there is no file other/robot.toml and no robot of that name",
        ),
        (["--robot", bar, "--bar", bar], "this is the configuration of a ball-bar; give it with --bar"),
        (
            ["--robot", robot, "--bar", "ur10"],
            "ur10: this is the configuration of a robot; give it with --robot",
        ),
        (["--robot", "latin1.toml", "--bar", bar], "latin1.toml, line 1: byte 0xFC is not UTF-8"),
        (["--robot", "latin1.toml", "--bar", bar], "iconv -f latin1 -t utf-8 latin1.toml"),
        (["--robot", "binary.toml", "--bar", bar], "this is a binary file, not TOML"),
    ] {
        let (code, told) = identify(at, &[&["examine"], &arguments[..]].concat());
        assert!(code == Some(1) && told.contains(expected), "{expected}: {told}");
    }
}

#[test]
fn names_of_parameters_are_checked_before_anything_is_read() {
    let directory = tempfile::tempdir().unwrap();
    let of_bar =
        ["calibrate", "--recording", "no.mcap", "--robot-log", "no.csv", "--robot", "ur10", "--out", "o"];
    let of_rows = ["calibrate", "tracker", "no.csv", "--mapping", "no.toml", "--robot", "ur10", "--out", "o"];
    for command in [of_bar, of_rows] {
        let (code, told) = identify(directory.path(), &[&command[..], &["--fix", "ra1,rdd1"]].concat());
        assert!(code == Some(2) && told.contains("did you mean `rd1`?"), "{code:?}: {told}");
        let (code, told) =
            identify(directory.path(), &[&command[..], &["--fix", "ra1,rd1", "--fix", "ra2"]].concat());
        assert!(code == Some(1) && !told.contains("parameter"), "{code:?}: {told}");
    }
}

#[test]
fn the_mapping_of_a_log_in_place_of_that_of_rows_is_recognised() {
    let directory = tempfile::tempdir().unwrap();
    let mapping = repository("config/robot_log.toml");
    let arguments = ["inspect", "rows.csv", "--robot", "ur10", "--mapping", mapping.to_str().unwrap()];
    let (code, told) = identify(directory.path(), &arguments);
    assert!(
        code == Some(1) && told.contains("mapping of a robot's log; give it with --log-mapping"),
        "{told}"
    );
}

#[test]
fn a_recording_in_place_of_the_log_is_recognised() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let (code, told) =
        identify(at, &["simulate", "--robot", "irb2400_16", "--duration", "20s", "--out", "run"]);
    assert_eq!(code, Some(0), "{told}");
    let exchanged = ["--recording", "run/robot_log.csv", "--robot-log", "run/recording.mcap"];
    let (code, told) =
        identify(at, &[&["calibrate"], &exchanged[..], &["--robot", "irb2400_16", "--out", "o"]].concat());
    assert!(code == Some(1) && told.contains("exchange the files of --recording and --robot-log"), "{told}");
}
