//! The command line of `identify`: exit codes, messages and files.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;

use crate::support::command::identify;
use crate::support::refused::states_the_verdict;
use crate::support::{lengths, repository};
use identify::robot::import;
use shared::config::BallBarConfig;
use shared::recording::schema::CycleRecord;
use shared::recording::{Recording, RecordingWriter};
use tempfile::TempDir;

fn config(name: &str) -> PathBuf {
    repository("config").join(name)
}

const IRB: &str = "irb2400_16.toml";

/// Directory of one experiment that all tests share. It contains recording.mcap, robot_log.csv and truth.toml.
fn experiment() -> &'static Path {
    static EXPERIMENT: OnceLock<TempDir> = OnceLock::new();
    EXPERIMENT
        .get_or_init(|| {
            let directory = tempfile::tempdir().unwrap();
            let bar = config("ball_bar.toml");
            let output = identify(
                &["simulate", "--exact", "--duration", "60s", "--bar", bar.to_str().unwrap()],
                IRB,
                directory.path(),
            );
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            directory
        })
        .path()
}

fn calibrate(recording: &Path, log: &Path, extra: &[&str], out: &Path) -> Output {
    let bar = config("ball_bar.toml");
    let mut arguments = vec!["calibrate", "--recording", recording.to_str().unwrap(), "--robot-log"];
    arguments.extend([log.to_str().unwrap(), "--bar", bar.to_str().unwrap()]);
    arguments.extend(extra);
    identify(&arguments, IRB, out)
}

/// Checks that the command failed because of a wrong option or unreadable input. The output must contain each text
/// of `why`, and `out` must be empty.
fn refused(output: &Output, why: &[&str], out: &Path) {
    fails(output, why);
    assert_eq!(std::fs::read_dir(out).unwrap().count(), 0, "something was left behind");
}

/// Checks that the command failed because the data are not usable. The output must contain each text of `why`. The command
/// must write a page with the reason, but no calibration.
fn refused_with_page(output: &Output, why: &[&str], out: &Path) {
    fails(output, why);
    let left: Vec<_> = std::fs::read_dir(out).unwrap().map(|one| one.unwrap().file_name()).collect();
    assert_eq!(left, ["report.html"]);
    states_the_verdict(&std::fs::read_to_string(out.join("report.html")).unwrap());
}

fn fails(output: &Output, why: &[&str]) {
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    for part in why {
        assert!(text.contains(part), "`{part}` is missing in: {text}");
    }
}

/// Writes the robot log of the experiment, but replaces each data line by the result of `edit`. `edit` receives
/// the number and the text of the line.
fn edited_log(directory: &Path, edit: impl Fn(usize, &str) -> String) -> PathBuf {
    let text = std::fs::read_to_string(experiment().join("robot_log.csv")).unwrap();
    let mut row = 0;
    let lines = text.lines().map(|line| {
        if line.starts_with('#') {
            return line.to_owned();
        }
        row += 1;
        edit(row - 1, line)
    });
    let path = directory.join("edited.csv");
    std::fs::write(&path, lines.collect::<Vec<_>>().join("\n")).unwrap();
    path
}

fn refused_log(edit: impl Fn(usize, &str) -> String, why: &[&str]) {
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let log = edited_log(inputs.path(), edit);
    refused(&calibrate(&experiment().join("recording.mcap"), &log, &[], out.path()), why, out.path());
}

#[test]
fn a_calibration_prints_a_table_and_writes_every_parameter_with_sigma_and_state() {
    let out = tempfile::tempdir().unwrap();
    let directory = experiment();
    let truth = directory.join("truth.toml");
    let extra = ["--fix", "balpha4", "--truth", truth.to_str().unwrap(), "--verbose"];
    let output =
        calibrate(&directory.join("recording.mcap"), &directory.join("robot_log.csv"), &extra, out.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("converged") && text.contains("Euclidean error 0.00"), "{text}");
    let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
    assert!(text.contains("balpha4 within 1 mrad") && page.contains("balpha4 within 1 mrad"), "{text}");
    assert!(text.contains("(k = 2)") && page.contains("Uncertainty budget"), "{text}");

    let written = std::fs::read_to_string(out.path().join("calibration.toml")).unwrap();
    let file: toml::Table = written.parse().unwrap();
    assert_eq!(file["schema"].as_integer(), Some(2));
    assert_eq!(file["inputs"].as_array().unwrap().len(), 4);
    // The file contains every sample of the solve. The residuals are small, because robot and bar are perfect.
    let residuals = std::fs::read_to_string(out.path().join("residuals.csv")).unwrap();
    let mut lines = residuals.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let at = |name: &str| names.iter().position(|one| *one == name).unwrap();
    let number = |line: &str, name: &str| line.split(',').nth(at(name)).unwrap().parse::<f64>().unwrap();
    assert_eq!(lines.clone().count() as i64, file["solve"]["samples"].as_integer().unwrap());
    for line in lines {
        assert!(["x_mm", "y_mm", "z_mm"].iter().all(|name| number(line, name).abs() < 1e-3), "{line}");
    }
    let budget = &file["budget"];
    assert_eq!(budget["coverage_factor"].as_float(), Some(2.0));
    let most = budget["contributions"][0]["source"].as_str().unwrap();
    assert!(most.starts_with("balpha4, fixed"), "{most}");
    let parameters = file["parameters"].as_array().unwrap();
    let entry = |name: &str| {
        let found = parameters.iter().find(|entry| entry["name"].as_str() == Some(name)).unwrap();
        (
            found["status"].as_str().unwrap().to_owned(),
            found.get("sigma").is_some(),
            found["correction"].clone(),
        )
    };
    // In table 3.1 of the thesis, the error of ra3 is -1.52 mm.
    let (status, has_sigma, correction) = entry("ra3");
    assert_eq!((status.as_str(), has_sigma), ("identified_with_prior", true));
    assert!((correction.as_float().unwrap() + 1.52e-3).abs() < 1e-6);
    // The plate has its measured uncertainty. The parameter balpha4 is fixed by name, so its uncertainty is the tolerance.
    // The parameter rd1 is fixed, because it defines the position of the base.
    let (status, has_sigma, correction) = entry("ra6");
    assert_eq!((status.as_str(), has_sigma), ("identified_with_prior", true));
    assert!(correction.as_float().unwrap().abs() < 1e-7);
    let (status, has_sigma, _) = entry("balpha4");
    assert_eq!((status.as_str(), has_sigma), ("fixed", true));
    let (status, has_sigma, _) = entry("rd1");
    assert_eq!((status.as_str(), has_sigma), ("fixed", false));
}

#[test]
fn freeing_what_cannot_be_identified_is_refused_with_its_name() {
    let out = tempfile::tempdir().unwrap();
    let directory = experiment();
    let (recording, log) = (directory.join("recording.mcap"), directory.join("robot_log.csv"));
    let output = calibrate(&recording, &log, &["--free", "rd1"], out.path());
    refused_with_page(&output, &["65 of 66", "dependent rd1|oz", "--fix rd1"], out.path());
    let out = tempfile::tempdir().unwrap();
    let unknown = calibrate(&recording, &log, &["--free", "rgamma3"], out.path());
    refused(&unknown, &["no parameter is called `rgamma3`"], out.path());
    let unknown = calibrate(&recording, &log, &["--free", "foo"], out.path());
    let why = ["no parameter is called `foo`; names are such as `ra1`", "\"Parameters of the model\""];
    refused(&unknown, &why, out.path());
}

#[test]
fn no_option_is_taken_and_ignored() {
    /// The largest integer of 64 bits.
    const HUGE: &str = "18446744073709551615";
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (recording, log) = (experiment().join("recording.mcap"), experiment().join("robot_log.csv"));
    let refused = |extra: &[&str], why: &[&str]| {
        refused(&calibrate(&recording, &log, extra, out.path()), why, out.path())
    };
    refused(&["--free", "rd1", "--fix", "rd1"], &["rd1 is in --free and in --fix"]);
    let without_force = identify(&["simulate", "bar", "--force-noise-n", "2"], IRB, &out.path().join("run"));
    fails(&without_force, &["--force-n <N>"]);
    let mapping = config("bar_log.toml");
    refused(&["--recording-mapping", mapping.to_str().unwrap()], &["--recording-mapping", "leave it out"]);
    // An option of the command line has priority over the configuration file.
    let fixed = inputs.path().join("identify.toml");
    std::fs::write(&fixed, "fix = [\"ra1\"]\n").unwrap();
    let freed =
        calibrate(&recording, &log, &["--config", fixed.to_str().unwrap(), "--free", "ra1"], out.path());
    assert!(freed.status.success(), "{}", String::from_utf8_lossy(&freed.stderr));
    let file: toml::Table =
        std::fs::read_to_string(out.path().join("calibration.toml")).unwrap().parse().unwrap();
    let ra1 = file["parameters"]
        .as_array()
        .unwrap()
        .iter()
        .find(|one| one["name"].as_str() == Some("ra1"))
        .unwrap();
    assert_eq!(ra1["status"].as_str(), Some("identified"));
    let (log, bar, robot) =
        (log.to_str().unwrap(), config("ball_bar.toml"), config("robots/irb2400_16.toml"));
    let (bar, robot) = (bar.to_str().unwrap(), robot.to_str().unwrap());
    for (arguments, why) in [
        (vec!["plan", "check", log, "--bar", bar, "--robot", robot, "--criterion", "worst"], "--criterion"),
        (
            vec!["plan", "check", log, "--bar", bar, "--robot", robot, "--linear-speed-m-s", "1"],
            "--linear-speed-m-s: ABB IRB 2400/16 has no linear axis",
        ),
        (vec!["inspect", log, "--robot", robot, "--bar", bar, "--propose", "mapping.toml"], "--bar"),
        (vec!["examine", "--robot", robot, "--bar", bar, "--poses", "0"], "--poses"),
        (
            vec!["plan", "poses", "--robot", robot, "--measures", "poses", "--out", "poses", "--draw", HUGE],
            "--draw <N>",
        ),
        (
            vec![
                "plan",
                "poses",
                "--robot",
                robot,
                "--measures",
                "poses",
                "--mapping",
                bar,
                "--out",
                "poses",
            ],
            "--mapping",
        ),
    ] {
        let output = Command::new(env!("CARGO_BIN_EXE_identify")).args(&arguments).output().unwrap();
        fails(&output, &[why]);
    }
}

#[test]
fn keys_of_an_experiment_that_nothing_is_for_are_refused_by_name() {
    let inputs = tempfile::tempdir().unwrap();
    let rows = inputs.path().join("rows.csv");
    std::fs::write(&rows, "").unwrap();
    for (key, line) in [("log_mapping", "log_mapping = \"log.toml\""), ("log_format", "log_format = \"rsi\"")]
    {
        let text = format!(
            "robot = \"robot.toml\"\n{line}\n[[wire]]\nfile = \"rows.csv\"\nmapping = \"rows.toml\"\n"
        );
        let path = inputs.path().join("experiment.toml");
        std::fs::write(&path, text).unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_identify"))
            .args([
                "calibrate",
                "--experiment",
                path.to_str().unwrap(),
                "--out",
                inputs.path().to_str().unwrap(),
            ])
            .output()
            .unwrap();
        fails(&output, &[key, "leave it out"]);
    }
}

#[test]
fn numbers_that_no_clock_and_no_table_has_are_refused_and_a_page_is_no_log() {
    let room = tempfile::tempdir().unwrap();
    let (bar, out) = (config("ball_bar.toml"), room.path().join("out"));
    let of_bar = ["simulate", "bar", "--bar", bar.to_str().unwrap()];
    for (option, value) in [
        ("--skew-ppm", "nan"),
        ("--skew-ppm", "1e7"),
        ("--skew-ppm", "-2e6"),
        ("--robot-clock-s", "nan"),
        ("--robot-clock-s", "1e30"),
    ] {
        let output = identify(&[&of_bar[..], &[option, value]].concat(), IRB, &out);
        fails(&output, &[option, "give a number from"]);
        assert!(!out.exists(), "{option} {value}");
    }
    fails(&identify(&["simulate", "contact", "--rows", "0"], IRB, &out), &["--rows is 0"]);
    assert!(!out.exists());
    let page = room.path().join("report.html");
    std::fs::write(&page, "<!DOCTYPE html><html></html>").unwrap();
    let inspect = ["inspect", page.to_str().unwrap(), "--robot"];
    let robot = repository("config/robots").join(IRB);
    let output = Command::new(env!("CARGO_BIN_EXE_identify")).args(inspect).arg(robot).output().unwrap();
    fails(&output, &["a web page, not a log"]);
}

/// Writes the counters of the experiment in the file format of the thesis' program. Returns the path of
/// the file and the options that are needed to read it. Each line has a date and the counters of joints 1,
/// 2, 4 and 5. The file has no header.
fn counters(directory: &Path) -> (PathBuf, Vec<String>) {
    let recording = Recording::open(&experiment().join("recording.mcap")).unwrap();
    let line = |cycle: &CycleRecord| {
        let date = cycle.sample_time.to_datetime().format("%Y-%m-%d-%H:%M:%S%.6f");
        let of = |joint: u8| cycle.encoders().iter().find(|sample| sample.joint == joint).unwrap().count;
        format!("{date};{};{};{};{}\n", of(1), of(2), of(4), of(5))
    };
    let path = directory.join("counters.csv");
    std::fs::write(&path, recording.cycles.iter().map(line).collect::<String>()).unwrap();
    let mapping = config("bar_log.toml");
    (path, vec!["--recording-mapping".into(), mapping.to_str().unwrap().into()])
}

#[test]
fn a_file_of_counters_without_header_calibrates_with_the_shipped_mapping_and_is_inspected() {
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (path, mapping) = counters(inputs.path());
    let mapping: Vec<&str> = mapping.iter().map(String::as_str).collect();
    let (log, truth) = (experiment().join("robot_log.csv"), experiment().join("truth.toml"));
    let extra = [&mapping[..], &["--truth", truth.to_str().unwrap(), "--verbose"]].concat();
    let output = calibrate(&path, &log, &extra, out.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("Euclidean error 0.0"), "{text}");
    let file: toml::Table =
        std::fs::read_to_string(out.path().join("calibration.toml")).unwrap().parse().unwrap();
    assert_eq!(file["inputs"].as_array().unwrap().len(), 5);

    let bar = config("ball_bar.toml");
    let inspect = |files: &[&Path], extra: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_identify"))
            .arg("inspect")
            .args(files)
            .args(extra)
            .args(["--robot".as_ref(), config("robots").join(IRB).as_os_str()])
            .output()
            .unwrap()
    };
    let with_bar = [&mapping[..], &["--bar", bar.to_str().unwrap()]].concat();
    let output = inspect(&[&path, &log, &experiment().join("recording.mcap")], &with_bar);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    for part in ["measurement PC", "how certain its times are", "b5", "robot controller", "simulated"] {
        assert!(text.contains(part), "{text}");
    }
    let table = inputs.path().join("table.csv");
    std::fs::write(&table, "t_s,count1\n0,1\n").unwrap();
    let output = inspect(&[&table], &[]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && told.contains("--bar"), "{told}");
}

#[test]
fn inspect_takes_the_kind_and_the_mapping_of_a_robot_s_log_as_calibrate_does() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("log.dat");
    let mut text = "exported\nTime;J1;J2;J3;J4;J5;J6\n[ms];;;;;;\n".to_owned();
    for row in 0..80 {
        let deg = f64::from(row) * 0.25;
        text += &format!("{};{deg};{deg};0;{deg};{deg};{deg}\n", row * 8).replace('.', ",");
    }
    std::fs::write(&path, text).unwrap();
    let (robot, mapping) = (config("robots").join("irb120_3.toml"), config("robot_log.toml"));
    let inspect = |extra: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
        command.arg("inspect").arg(&path).arg("--robot").arg(&robot).args(extra).output().unwrap()
    };
    let output = inspect(&["--log-mapping", mapping.to_str().unwrap()]);
    let told = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && told.contains("0.6 s, 80 rows"), "{told}");
    let seven = directory.path().join("seven.toml");
    let more = "\n[[joints]]\ncolumn = \"J6\"\nunit = \"deg\"\n\n[[coupling]]";
    let text = std::fs::read_to_string(&mapping).unwrap().replacen("\n[[coupling]]", more, 1);
    std::fs::write(&seven, text).unwrap();
    let output = inspect(&["--log-mapping", seven.to_str().unwrap()]);
    fails(&output, &["seven.toml: the mapping's 7 joints are not the axes of "]);
    let output = inspect(&["--log-format", "rsi"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && told.contains("log.dat"), "{told}");
}

#[test]
fn the_encoder_map_that_is_typed_is_the_one_that_is_used() {
    let out = tempfile::tempdir().unwrap();
    let (recording, log) = (experiment().join("recording.mcap"), experiment().join("robot_log.csv"));
    let told = calibrate(&recording, &log, &["--encoders", "-1,2"], out.path());
    refused(&told, &["--encoders", "give 5 different bar joints"], out.path());
    let told = calibrate(&recording, &log, &["--encoders", "left"], out.path());
    refused(&told, &["find, recorded"], out.path());
    // This encoder map is wrong, so no geometry near the nominal one explains the data.
    let told = calibrate(&recording, &log, &["--encoders", "2,1,3,4,5"], out.path());
    refused_with_page(&told, &["error:"], out.path());
}

#[test]
fn a_damaged_recording_is_refused() {
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut bytes = std::fs::read(experiment().join("recording.mcap")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x40;
    let damaged = inputs.path().join("damaged.mcap");
    std::fs::write(&damaged, &bytes).unwrap();
    let log = experiment().join("robot_log.csv");
    refused(&calibrate(&damaged, &log, &[], out.path()), &["damaged.mcap", "damaged"], out.path());
    std::fs::write(&damaged, &bytes[..middle]).unwrap();
    refused(&calibrate(&damaged, &log, &[], out.path()), &["damaged.mcap"], out.path());
    let missing = inputs.path().join("missing.mcap");
    refused(&calibrate(&missing, &log, &[], out.path()), &["missing.mcap", "cannot be read"], out.path());
}

#[test]
fn a_robot_log_with_a_missing_column_is_refused_with_the_columns_found() {
    let rename = |row: usize, line: &str| {
        if row == 0 { line.replace("motor4_rad", "motor9_rad") } else { line.into() }
    };
    refused_log(rename, &["edited.csv", "motor4_rad", "motor9_rad"]);
}

#[test]
fn a_robot_log_with_nan_is_refused_with_line_and_column() {
    let nan = |row: usize, line: &str| {
        let mut cells: Vec<&str> = line.split(',').collect();
        if row == 500 {
            cells[3] = "NaN";
        }
        cells.join(",")
    };
    refused_log(nan, &["edited.csv", "motor3_rad", "line"]);
}

#[test]
fn degrees_under_a_header_of_radians_are_refused() {
    let to_degrees = |row: usize, line: &str| {
        if row == 0 {
            return line.to_owned();
        }
        let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
        for cell in &mut cells[1..] {
            *cell = cell.parse::<f64>().unwrap().to_degrees().to_string();
        }
        cells.join(",")
    };
    refused_log(to_degrees, &["edited.csv", "degrees"]);
    let header = |row: usize, line: &str| if row == 0 { line.replace("_rad", "_deg") } else { line.into() };
    refused_log(header, &["edited.csv", "deg"]);
}

#[test]
fn a_clock_that_runs_backwards_is_refused() {
    let jump = |row: usize, line: &str| match (row, line.split_once(',')) {
        (9000, Some((_, joints))) => format!("1.0,{joints}"),
        _ => line.to_owned(),
    };
    refused_log(jump, &["edited.csv", "time"]);
}

#[test]
fn logs_without_overlap_in_time_are_refused() {
    // The robot log contains only the first half second, in which the robot stands still.
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let still = |row: usize, line: &str| if row <= 120 { line.to_owned() } else { String::new() };
    let log = edited_log(inputs.path(), still);
    let output = calibrate(&experiment().join("recording.mcap"), &log, &[], out.path());
    refused_with_page(&output, &["robot"], out.path());
    let other = tempfile::tempdir().unwrap();
    let out = tempfile::tempdir().unwrap();
    let bar = config("ball_bar.toml");
    let another_run =
        ["simulate", "--exact", "--seed", "9", "--duration", "60s", "--bar", bar.to_str().unwrap()];
    assert!(identify(&another_run, IRB, other.path()).status.success());
    let recording = experiment().join("recording.mcap");
    let output = calibrate(&recording, &other.path().join("robot_log.csv"), &[], out.path());
    refused_with_page(&output, &["correlat"], out.path());
}

#[test]
fn another_robots_configuration_is_refused() {
    let out = tempfile::tempdir().unwrap();
    let directory = experiment();
    let bar = config("ball_bar.toml");
    let (recording, log) = (directory.join("recording.mcap"), directory.join("robot_log.csv"));
    let arguments =
        ["calibrate", "--recording", recording.to_str().unwrap(), "--robot-log", log.to_str().unwrap()];
    let arguments = [&arguments[..], &["--bar", bar.to_str().unwrap()]].concat();
    refused(&identify(&arguments, "nj220_2_7.toml", out.path()), &["joint1_deg", "motor1_rad"], out.path());
}

#[test]
fn the_part_of_a_recording_that_a_shorter_robot_log_covers_is_printed() {
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let text = std::fs::read_to_string(experiment().join("robot_log.csv")).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let log = inputs.path().join("short.csv");
    std::fs::write(&log, lines[..lines.len() / 2].join("\n")).unwrap();
    let output = calibrate(&experiment().join("recording.mcap"), &log, &[], out.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    // Messages are wrapped to the width of a terminal, so line breaks are removed before the comparison.
    let words = text.split_whitespace().collect::<Vec<_>>().join(" ");
    for part in [
        "short.csv covers 0.0 s to ",
        "s of the recording: ",
        "cycles are outside it, or in its gaps, and not used",
    ] {
        assert!(words.contains(part), "{part}: {text}");
    }
}

#[test]
fn measured_lengths_calibrate_from_a_csv_with_a_mapping() {
    let robot = shared::config::load(&config("robots/irb120_3.toml")).unwrap();
    let csv = lengths::table(&robot, 200, 12.0);
    // Append copies of the first rows. The calibration must not use the copies.
    let copies = csv.lines().skip(1).take(10).collect::<Vec<_>>().join("\n");
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let path = inputs.path().join("lengths.csv");
    std::fs::write(&path, format!("{csv}{copies}")).unwrap();
    let mapping = config("measured_length.toml");
    let arguments = ["calibrate", "wire", path.to_str().unwrap(), "--mapping", mapping.to_str().unwrap()];
    let output = identify(&[&arguments[..], &["--verbose"]].concat(), "irb120_3.toml", out.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("held out") && text.contains("0 of 200 rows rejected"), "{text}");
    let file: toml::Table =
        std::fs::read_to_string(out.path().join("calibration.toml")).unwrap().parse().unwrap();
    let value = |name: &str| {
        let entries = file["parameters"].as_array().unwrap();
        entries.iter().find(|entry| entry["name"].as_str() == Some(name)).unwrap()["value"]
            .as_float()
            .unwrap()
    };
    let [x_m, y_m, _] = lengths::ANCHOR_M;
    assert!((value("anchor_x") - x_m).abs() < 1e-3 && (value("anchor_y") - y_m).abs() < 1e-3);
    assert!((value("length_offset") - 0.012).abs() < 1e-3);
    let rows = &file["rows"].as_array().unwrap()[0];
    assert_eq!((rows["hold_out"].as_str(), rows["seed"].as_integer()), (Some("rows"), Some(1042)));
    assert_eq!(rows["held_out"]["joints"]["rows"].as_integer(), Some(40));
    let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
    assert!(page.contains("wire, 40 held-out rows, calibrated") && page.contains("anchor_x"));

    for bar_only in [["--cost", "length"], ["--encoders", "find"], ["--truth", "truth.toml"]] {
        let out = tempfile::tempdir().unwrap();
        let output = identify(&[&arguments[..], &bar_only].concat(), "irb120_3.toml", out.path());
        refused(&output, &["unexpected argument", bar_only[0]], out.path());
    }
    // Fixed parameters of the options and of the configuration are combined.
    let out = tempfile::tempdir().unwrap();
    let config = out.path().join("identify.toml");
    std::fs::write(&config, "fix = [\"ra2\"]\n").unwrap();
    let fixing = ["--config", config.to_str().unwrap(), "--fix", "attachment_x"];
    let output = identify(&[&arguments[..], &fixing].concat(), "irb120_3.toml", out.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let written = std::fs::read_to_string(out.path().join("calibration.toml")).unwrap();
    let file: toml::Table = written.parse().unwrap();
    let entries = file["parameters"].as_array().unwrap();
    for name in ["ra2", "attachment_x"] {
        let entry = entries.iter().find(|entry| entry["name"].as_str() == Some(name)).unwrap();
        assert_eq!((entry["status"].as_str(), entry["correction"].as_float()), (Some("fixed"), Some(0.0)));
    }

    let broken = csv.replace("cable_mm", "wire_mm");
    let out = tempfile::tempdir().unwrap();
    std::fs::write(&path, broken).unwrap();
    refused(&identify(&arguments, "irb120_3.toml", out.path()), &["cable_mm", "wire_mm"], out.path());
}

#[test]
fn a_reader_that_has_gone_ends_nothing() {
    let mut inspecting = Command::new(env!("CARGO_BIN_EXE_identify"))
        .arg("inspect")
        .arg(experiment().join("recording.mcap"))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(inspecting.stdout.take());
    let output = inspecting.wait_with_output().unwrap();
    assert_eq!((output.status.code(), String::from_utf8_lossy(&output.stderr).as_ref()), (Some(0), ""));
    let mut failing = Command::new(env!("CARGO_BIN_EXE_identify"))
        .args(["inspect", "missing.mcap"])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(failing.stderr.take());
    assert_eq!(failing.wait().unwrap().code(), Some(1));
}

#[test]
fn an_experiment_is_simulated_where_the_bar_stands() {
    let bar = config("ball_bar.toml");
    let at = |base: &str| {
        let out = tempfile::tempdir().unwrap();
        let arguments =
            ["simulate", "--exact", "--duration", "20s", "--base", base, "--bar", bar.to_str().unwrap()];
        (identify(&arguments, IRB, out.path()), out)
    };
    let (output, out) = at("0.9,-0.3,0.4");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let truth: toml::Table = std::fs::read_to_string(out.path().join("truth.toml")).unwrap().parse().unwrap();
    let base_m: Vec<f64> =
        truth["design"]["base_m"].as_array().unwrap().iter().filter_map(toml::Value::as_float).collect();
    assert_eq!(base_m, [0.9, -0.3, 0.4]);

    let (output, out) = at("9,0,0");
    refused(&output, &["no pose of the robot holds the bar", "--base"], out.path());
    let (output, out) = at("1,2");
    refused(&output, &["2 numbers are given, 3 are needed"], out.path());
}

#[test]
fn a_path_in_other_columns_is_checked_with_their_mapping() {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = directory.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let log = std::fs::read_to_string(experiment().join("robot_log.csv")).unwrap();
    let own: String = log.split_inclusive('\n').take(2000).collect();
    let other = file("other.csv", &own.replacen("t_s", "Time", 1));
    let mapping = file("mapping.toml", "[time]\ncolumn = \"Time\"\nunit = \"s\"\n");
    let check = |log: &Path, more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
        command.args(["plan", "check"]).arg(log).arg("--robot").arg(config("robots").join(IRB)).arg("--bar");
        command.arg(config("ball_bar.toml")).args(more).output().unwrap()
    };
    let checked = check(&other, &["--log-mapping", mapping.to_str().unwrap()]);
    assert!(!checked.stdout.is_empty(), "{}", String::from_utf8_lossy(&checked.stderr));
    assert_eq!(checked.stdout, check(&file("own.csv", &own), &[]).stdout);
    fails(&check(&other, &[]), &["--log-mapping"]);
}

#[test]
fn a_simulated_motion_begins_near_a_posture_with_a_number_for_each_axis() {
    let directory = tempfile::tempdir().unwrap();
    let urdf = std::fs::read_to_string(repository("identify/tests/data/seven_axes.urdf")).unwrap();
    let robot = import(&urdf, Some("base"), Some("flange")).unwrap().config;
    let bar = BallBarConfig { plate_m: 0.1, length_m: 0.4, ..crate::support::bar() };
    let [arm, bar] =
        [("arm.toml", toml::to_string(&robot)), ("bar.toml", toml::to_string(&bar))].map(|(name, text)| {
            let path = directory.path().join(name);
            std::fs::write(&path, text.unwrap()).unwrap();
            path.to_str().unwrap().to_owned()
        });
    let simulated = |posture: &str, out: &Path| {
        let place = ["--base", "0.2,-0.3,0.5", "--duration", "20s", "--posture", posture];
        let exact = ["simulate", "bar", "--exact", "--errors", "none", "--bar", &bar];
        identify(&[&exact[..], &place].concat(), &arm, out)
    };
    let out = directory.path().join("run");
    let output = simulated("-124,26,7,-116,132,108,32", &out);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let truth: toml::Table = std::fs::read_to_string(out.join("truth.toml")).unwrap().parse().unwrap();
    let posture = truth["design"]["posture_deg"].as_array().unwrap();
    assert_eq!(posture.len(), 7);
    let six = simulated("0,20,10,0,60,0", &directory.path().join("six"));
    fails(&six, &["--posture has 6 numbers", "has 7 axes"]);
}

#[test]
fn completions_and_man_pages_know_every_command() {
    let generate = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_identify")).arg("generate").args(arguments).output().unwrap()
    };
    let bash = generate(&["completions", "bash"]);
    let pages = tempfile::tempdir().unwrap();
    assert!(generate(&["man", pages.path().to_str().unwrap()]).status.success());
    for command in ["calibrate", "inspect", "compare", "robot", "plan", "simulate", "study"] {
        assert!(String::from_utf8_lossy(&bash.stdout).contains(command), "{command}");
        assert!(pages.path().join(format!("identify-{command}.1")).exists(), "{command}");
    }
    let nowhere = generate(&["man", pages.path().join("nowhere").to_str().unwrap()]);
    assert!(!nowhere.status.success() && String::from_utf8_lossy(&nowhere.stderr).contains("nowhere"));
}

#[test]
fn a_place_for_results_that_cannot_be_used_is_found_before_any_work() {
    let inputs = tempfile::tempdir().unwrap();
    let file = inputs.path().join("result.csv");
    std::fs::write(&file, "").unwrap();
    // The robot log does not exist either, but the output directory is checked first.
    let missing = inputs.path().join("missing.csv");
    for out in [file.as_path(), &file.join("deeper"), Path::new("/proc/results")] {
        let output = calibrate(&experiment().join("recording.mcap"), &missing, &[], out);
        fails(&output, &["--out", &out.display().to_string(), "directory"]);
        assert!(!String::from_utf8_lossy(&output.stderr).contains("missing.csv"));
    }
    let bar = config("ball_bar.toml");
    let simulated = identify(&["simulate", "--duration", "2h", "--bar", bar.to_str().unwrap()], IRB, &file);
    fails(&simulated, &["--out", "give a directory"]);
    // The check whether the directory can be written must leave no files.
    let out = inputs.path().join("not/yet");
    fails(&calibrate(&experiment().join("recording.mcap"), &missing, &[], &out), &["missing.csv"]);
    let left: Vec<_> =
        std::fs::read_dir(inputs.path()).unwrap().map(|one| one.unwrap().file_name()).collect();
    assert_eq!(left, ["result.csv"]);
}

#[test]
fn milliseconds_under_a_header_of_seconds_and_decimal_commas_are_refused_with_what_reads_them() {
    let in_ms = |row: usize, line: &str| match line.split_once(',') {
        Some((time, joints)) if row > 0 => format!("{:.1},{joints}", 1e3 * time.parse::<f64>().unwrap()),
        _ => line.to_owned(),
    };
    refused_log(in_ms, &["column `t_s` counts ms, not seconds", "--log-mapping", "--propose"]);
    let inspected = |path: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
        let output = command.arg("inspect").arg(path).arg("--robot").arg(config("robots").join(IRB));
        output.output().unwrap()
    };
    let inputs = tempfile::tempdir().unwrap();
    fails(&inspected(&edited_log(inputs.path(), in_ms)), &["`t_s` counts ms", "--propose FILE writes"]);
    let commas = |_: usize, line: &str| line.replace(',', ";").replace('.', ",");
    refused_log(commas, &["has a decimal comma", "decimal_comma = true", "--log-mapping", "--propose"]);
    let with_time = |row: usize, line: &str, change: fn(&str) -> String| match line.split_once(',') {
        Some((time, joints)) if row > 0 => format!("{},{joints}", change(time)),
        _ => line.to_owned(),
    };
    let dates = |row: usize, line: &str| with_time(row, line, |_| "2026-11-22 10:15:00.25".into());
    refused_log(dates, &["is not a number", "[time] unit = \"date_time\""]);
    let thousands = |row: usize, line: &str| with_time(row, line, |time| format!("\"1,{time}\""));
    refused_log(thousands, &["has a comma and a point"]);
    let units = |row: usize, line: &str| match row {
        0 => format!("{line}\ns,rad,rad,rad,rad,rad,rad"),
        _ => line.to_owned(),
    };
    refused_log(units, &["`s` is not a number", "unit_lines = 1"]);
    // The proposed mapping can be used to read the file. The columns are those of the robot's own
    // log: motor angles with gear ratios.
    for (number, edit) in [&in_ms as &dyn Fn(usize, &str) -> String, &commas].into_iter().enumerate() {
        let log = edited_log(inputs.path(), edit);
        let mapping = inputs.path().join(format!("mapping{number}.toml"));
        let mapping = mapping.to_str().unwrap();
        let robot = config("robots").join(IRB);
        program(&[
            "inspect",
            log.to_str().unwrap(),
            "--robot",
            robot.to_str().unwrap(),
            "--propose",
            mapping,
        ]);
        let out = tempfile::tempdir().unwrap();
        let recording = experiment().join("recording.mcap");
        let output = calibrate(&recording, &log, &["--log-mapping", mapping], out.path());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(String::from_utf8_lossy(&output.stdout).contains("verdict green"));
    }
}

/// The first sheet of a result names the source of its data: the simulated bus or a robot.
#[test]
fn a_result_of_the_simulated_bus_says_so_first_and_one_of_a_robot_does_not() {
    let directory = experiment();
    let outs = [(); 2].map(|()| tempfile::tempdir().unwrap());
    for (simulated, out) in [true, false].into_iter().zip(&outs) {
        let inputs = tempfile::tempdir().unwrap();
        let recording = inputs.path().join("recording.mcap");
        let bytes = std::fs::read(directory.join("recording.mcap")).unwrap();
        std::fs::write(&recording, bytes).unwrap();
        if !simulated {
            on_another_bus(&recording);
        }
        let output = calibrate(&recording, &directory.join("robot_log.csv"), &[], out.path());
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(text.starts_with("SIMULATED: "), simulated, "{text}");
        // The sheet names the source of the scale, and states what happens if the plate has another length.
        let words = text.split_whitespace().collect::<Vec<_>>().join(" ");
        let scale = "scale: the offset plate of 250.000 mm within 0.010 mm (one sigma), as ball_bar.toml states; a plate longer by \
                     0.1 mm would move positions by ";
        assert!(words.contains(scale), "{text}");
        let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
        assert_eq!(page.contains("<div class=\"band\">SIMULATED"), simulated);
        let written = std::fs::read_to_string(out.path().join("calibration.toml")).unwrap();
        assert_eq!(written.contains("simulated = true"), simulated);
        let inspected = program(&["inspect", recording.to_str().unwrap()]);
        assert_eq!(inspected.contains("SIMULATED: no robot was measured"), simulated, "{inspected}");
    }
    let [one, other] = outs.each_ref().map(|out| out.path().to_str().unwrap());
    let compared = program(&["compare", one, other]);
    assert_eq!(compared.matches("SIMULATED").count(), 1, "{compared}");
}

/// Runs the program, which must succeed. Returns its standard output.
fn program(arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_identify")).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Changes a recording of the simulated bus to one of a network interface.
fn on_another_bus(path: &Path) {
    let recording = Recording::open(path).unwrap();
    let mut run = recording.run.clone();
    run.bus = "eth1".into();
    let mut writer = RecordingWriter::begin(Vec::new(), &run).unwrap();
    recording.cycles.iter().for_each(|cycle| writer.write_cycle(cycle).unwrap());
    std::fs::write(path, writer.end("stopped", run.started).unwrap()).unwrap();
}

/// Ctrl-C cancels a calibration from rows at any stage, like a calibration with the bar. No file is written.
#[test]
fn ctrl_c_ends_a_calibration_from_rows_with_the_shells_code() {
    let (inputs, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let robot: shared::config::RobotConfig = shared::config::load(&config("robots").join(IRB)).unwrap();
    // Solving this number of rows would take several minutes.
    let path = inputs.path().join("lengths.csv");
    std::fs::write(&path, lengths::table(&robot, 50_000, 12.0)).unwrap();
    // A shell starts background jobs with SIGINT ignored, and the program does not handle a signal that is ignored.
    let mut command = Command::new("env");
    command.args(["--default-signal=INT", env!("CARGO_BIN_EXE_identify")]);
    command.args(["calibrate", "wire"]).arg(&path).arg("--mapping").arg(config("measured_length.toml"));
    command.arg("--robot").arg(config("robots").join(IRB)).arg("--out").arg(out.path());
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(std::time::Duration::from_secs(3));
    assert!(child.try_wait().unwrap().is_none(), "it was over too soon");
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let status = child.wait().unwrap();
    // If the handler of the signal is not yet installed, the signal ends the process directly. Shells
    // report the same exit code in both cases.
    assert!(status.code() == Some(130) || status.code().is_none(), "{status}");
    assert_eq!(std::fs::read_dir(out.path()).unwrap().count(), 0);
}
