//! Robot logs that other programs wrote are read correctly. rosbags writes ROS 2 bags, Google's protobuf writes EGM, and
//! Python's CSV and XML writers write the other formats.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::Command;

use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::logs::{
    BarLog, LogError, LogOptions, RobotLog, RobotLogMapping, ValueOrigin, load, load_with, read,
};
use identify::model::ParameterId;
use identify::simulate::Comparison;
use identify::simulate::{self, Design, Experiment};
use shared::config::{self, RobotConfig};
use system_tests::{ball_bar as shipped_bar, config_directory, python_with};

/// These three constants have the same values as in `write_robot_log.py`.
const ROWS: usize = 5000;
const START_NS: i64 = 1_795_000_000_123_456_789;
const PERIOD_S: f64 = 0.008;

fn angle_rad(row: usize, joint: usize) -> f64 {
    0.4 * (0.01 * row as f64 + joint as f64).sin()
}

fn robot() -> RobotConfig {
    config::load(&config_directory().join("robots/irb120_3.toml")).unwrap()
}

/// Writes a log of this kind with `write_robot_log.py`. The script needs the given Python modules. Returns
/// the path of the log.
fn write_log(directory: &Path, modules: &[&str], kind: &str) -> PathBuf {
    let python = python_with(modules);
    let path = directory.join(format!("log.{}", kind.split('-').next().unwrap()));
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("write_robot_log.py");
    let output = Command::new(python).arg(script).arg(kind).arg(&path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    path
}

/// Checks that the rows agree with the angles of the script within `tolerance_rad`. The row `dropped_row`
/// is missing in the log.
fn assert_follows(log: &RobotLog, dropped_row: Option<usize>, tolerance_rad: f64) {
    let rows: Vec<usize> = (0..ROWS).filter(|row| Some(*row) != dropped_row).collect();
    assert_eq!(log.q_rad.len(), rows.len());
    for ((row, q_rad), t_s) in rows.iter().zip(log.q_rad.iter()).zip(&log.q_rad.t_s) {
        assert!((t_s - *row as f64 * PERIOD_S).abs() < 1e-9, "row {row} at {t_s} s");
        for (joint, q) in q_rad.iter().enumerate() {
            assert!((q - angle_rad(*row, joint)).abs() < tolerance_rad, "row {row} joint {joint}: {q}");
        }
    }
}

fn check_bag(kind: &str) {
    let directory = tempfile::tempdir().unwrap();
    let path = write_log(directory.path(), &["rosbags"], kind);
    let log = load(&path, &robot()).unwrap();
    // In one message, the position of a joint is NaN. This message must be dropped.
    assert_follows(&log, Some(100), 1e-12);
    assert_eq!((log.quality.incomplete_dropped, log.q_rad.first_stamp_ns), (1, START_NS));
    assert_eq!((log.clock.as_str(), log.origin), ("header.stamp", ValueOrigin::Measured));
    for (row, speeds) in log.speed_rad_s.unwrap().iter().enumerate().take(100) {
        for (joint, speed) in speeds.iter().enumerate() {
            assert!((speed - 0.5 * (0.01 * row as f64 + joint as f64).cos()).abs() < 1e-12);
        }
    }
    assert!(log.torque.is_none());
    check_wrong_topic(&path);
}

fn check_wrong_topic(path: &Path) {
    let joints: String = (1..=6)
        .map(|joint| format!("[[joints]]\ncolumn = \"right_joint_{joint}\"\nunit = \"rad\"\n"))
        .collect();
    for (text, expected) in [
        (joints.clone(), "left_joint_3"),
        (format!("topic = \"/right/joint_states\"\n{joints}"), "/right/joint_states"),
    ] {
        let mapping: RobotLogMapping = config::parse(&text, Path::new("mapping.toml")).unwrap();
        let options = LogOptions { mapping: Some(mapping), ..LogOptions::default() };
        let message = load_with(path, &robot(), &options).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn joint_states_of_an_mcap_bag_by_rosbags_are_found_by_name() {
    check_bag("mcap");
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn joint_states_of_a_db3_bag_by_rosbags_are_found_by_name() {
    check_bag("db3");
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn an_incomplete_bag_is_read_as_far_as_it_goes_with_a_remark() {
    let directory = tempfile::tempdir().unwrap();
    let path = write_log(directory.path(), &["rosbags"], "mcap");
    let bytes = std::fs::read(&path).unwrap();
    let log = read(&bytes[..bytes.len() * 2 / 3], &path, &robot()).unwrap();
    assert!((ROWS / 3..ROWS).contains(&log.q_rad.len()));
    assert!(
        log.quality.remarks.iter().any(|remark| remark.contains("damaged after")),
        "{:?}",
        log.quality.remarks
    );
    for (q_rad, t_s) in log.q_rad.iter().zip(&log.q_rad.t_s) {
        let row = (t_s / PERIOD_S).round() as usize;
        assert!(q_rad.iter().enumerate().all(|(joint, q)| (q - angle_rad(row, joint)).abs() < 1e-12));
    }
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn a_bar_s_joint_states_in_bags_by_rosbags_calibrate_as_the_recording_does() {
    let python = python_with(&["rosbags"]);
    let (robot, bar) =
        (config::load(&config_directory().join("robots/irb2400_16.toml")).unwrap(), shipped_bar());
    let directory = tempfile::tempdir().unwrap();
    let design = Design { duration_s: 60.0, ..Design::for_robot(&robot) };
    let mut simulated = simulate::run(&Experiment { design, ..Experiment::new(&robot, &bar) }).unwrap();
    simulated.cycles[3000].encoders[2].valid = false;
    let files = simulate::write(directory.path(), &simulated, &robot, &bar).unwrap();
    let bag = |storage: &str| {
        let path = directory.path().join(format!("bar.{storage}"));
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("write_robot_log.py");
        let arguments =
            [format!("bar-{storage}").into(), path.clone().into_os_string(), files.recording.clone().into()];
        let output = Command::new(&python).arg(script).args(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        BarLog::load(&path, &bar, None).unwrap()
    };
    let [of_mcap, of_db3] = ["mcap", "db3"].map(bag);
    assert_eq!(of_mcap.cycles(), of_db3.cycles());
    let (cycles, encoders) = (of_db3.cycles(), of_db3.encoders());
    assert_eq!(cycles.len(), simulated.cycles.len());
    assert!(!cycles[3000].is_valid() && cycles[3000].encoders[1].valid);
    let joints: Vec<u8> = encoders.iter().map(|encoder| encoder.joint).collect();
    assert_eq!(joints, [1, 2, 3, 4, 5]);
    let log = load(&files.robot_log, &robot).unwrap();
    let found = calibrate_run(cycles, encoders, &log, &robot, &bar, &IdentifyConfig::default()).unwrap();
    let error = Comparison::new(&found, &simulated.truth)
        .only(|id| matches!(id, ParameterId::Robot { .. }))
        .euclidean_mm_mrad();
    println!("{error:.4} mm|mrad");
    assert!(error < 0.05, "{error} mm|mrad");
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn egm_messages_by_googles_protobuf_are_read_in_degrees_on_either_clock() {
    let directory = tempfile::tempdir().unwrap();
    for (kind, clock) in [("egm", "controller, ms of its own"), ("egm-utc", "controller, UTC")] {
        let path = write_log(directory.path(), &["google.protobuf"], kind);
        let log = load(&path, &robot()).unwrap();
        if kind == "egm" {
            // The controller's counter of milliseconds wraps after 20 s, and the log lasts 40 s.
            assert_follows(&log, None, 1e-12);
        } else {
            // Stamps of this format are whole microseconds.
            assert_eq!(log.q_rad.first_stamp_ns, START_NS / 1000 * 1000);
        }
        assert_eq!((log.q_rad.len(), log.quality.duplicates_dropped), (ROWS, 1));
        assert_eq!((log.clock.as_str(), log.origin), (clock, ValueOrigin::Measured));
    }
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn measured_not_target_angles_of_an_rtde_client_are_read_by_name() {
    let directory = tempfile::tempdir().unwrap();
    let path = write_log(directory.path(), &["csv"], "rtde");
    let log = load(&path, &robot()).unwrap();
    assert_follows(&log, None, 1e-12);
    assert_eq!((log.q_rad.first_stamp_ns, log.origin), (250_000_000_000, ValueOrigin::Measured));
    for (row, speeds) in log.speed_rad_s.unwrap().iter().enumerate() {
        for (joint, speed) in speeds.iter().enumerate() {
            assert!((speed - 0.5 * (0.01 * row as f64 + joint as f64).cos()).abs() < 1e-12);
        }
    }
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn measured_angles_of_rsi_telegrams_by_an_xml_writer_are_read() {
    let directory = tempfile::tempdir().unwrap();
    let path = write_log(directory.path(), &["xml.etree"], "rsi");
    let log = load(&path, &robot()).unwrap();
    assert_follows(&log, None, 1e-12);
    assert_eq!((log.clock.as_str(), log.origin), ("IPOC", ValueOrigin::Measured));
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn a_spreadsheets_export_with_decimal_commas_is_read_by_its_mapping() {
    let directory = tempfile::tempdir().unwrap();
    let path = write_log(directory.path(), &["csv"], "table");
    let layout = "delimiter = \";\"\ndecimal_comma = true\nskip_lines = 1\nunit_lines = 1\n";
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"Achse {joint}\"\nunit = \"deg\"\n")).collect();
    let text = format!("[csv]\n{layout}[time]\ncolumn = \"Zeit\"\nunit = \"ms\"\n{joints}");
    let mapping: RobotLogMapping = config::parse(&text, Path::new("mapping.toml")).unwrap();
    let options = LogOptions { mapping: Some(mapping), ..LogOptions::default() };
    assert_follows(&load_with(&path, &robot(), &options).unwrap(), None, 1e-12);
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn an_egm_capture_that_is_cut_is_refused_with_the_message_and_the_byte() {
    let directory = tempfile::tempdir().unwrap();
    let path = write_log(directory.path(), &["google.protobuf"], "egm");
    let bytes = std::fs::read(&path).unwrap();
    let error = read(&bytes[..bytes.len() - 3], &path, &robot()).unwrap_err();
    assert!(matches!(&error, LogError::BadRecord { place, .. } if place.contains("5001")), "{error}");
}
