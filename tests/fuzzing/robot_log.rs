//! Robot logs of every kind from any bytes.

use std::path::Path;
use std::sync::LazyLock;

use identify::logs::{LogFormat, LogOptions, RobotLogMapping, read_with};
use shared::config::{self, RobotConfig};

use super::explained;

struct Setting {
    robot: RobotConfig,
    mapping: RobotLogMapping,
}

static SETTING: LazyLock<Setting> = LazyLock::new(|| {
    let directory = crate::config_directory();
    // Limits that nothing reaches, so that most logs come through.
    let mut robot: RobotConfig =
        config::load(&directory.join("robots/irb120_3.toml")).expect("a shipped file");
    robot.joint_limits_deg = [[-1e6, 1e6]; 6];
    Setting { robot, mapping: config::load(&directory.join("robot_log.toml")).expect("a shipped file") }
});

/// Reads a log of that kind, with and without a mapping: it has what it promises, or is refused with a reason.
fn any_log(format: LogFormat, bytes: &[u8]) {
    let Setting { robot, mapping } = &*SETTING;
    for mapping in [None, Some(mapping.clone())] {
        let options = LogOptions { format: Some(format), mapping };
        match read_with(bytes, Path::new("log"), robot, &options) {
            Ok(log) => {
                assert!(log.q_rad.len() == log.t_s.len() && log.t_s.first() == Some(&0.0));
                assert!(log.t_s.is_sorted_by(|a, b| a <= b), "time runs backwards");
                assert!(log.q_rad.iter().flatten().all(|q| q.is_finite()));
                let rows = log.q_rad.len();
                assert!(log.speed_rad_s.is_none_or(|speeds| speeds.len() == rows));
                assert!(log.torque.is_none_or(|torques| torques.len() == rows));
            }
            Err(error) => explained(&error),
        }
    }
}

pub fn any_table(bytes: &[u8]) {
    any_log(LogFormat::Csv, bytes);
    any_log(LogFormat::UrRtde, bytes);
}

pub fn any_mcap(bytes: &[u8]) {
    any_log(LogFormat::Ros2Mcap, bytes);
}

pub fn any_db3(bytes: &[u8]) {
    any_log(LogFormat::Ros2Db3, bytes);
}

pub fn any_egm(bytes: &[u8]) {
    any_log(LogFormat::Egm, bytes);
}

pub fn any_rsi(bytes: &[u8]) {
    any_log(LogFormat::Rsi, bytes);
    drop(LogFormat::detect(bytes, Path::new("log")));
}

fn row(row: usize) -> [f64; 6] {
    std::array::from_fn(|joint| 20.0 * (0.3 * row as f64 + joint as f64).sin())
}

/// The robot's own table, RTDE's, and that of the shipped mapping.
pub fn tables() -> Vec<Vec<u8>> {
    let table = |header: &str, separator: &str, step: f64, comma: bool| {
        let mut text = header.to_owned();
        for index in 0..52 {
            let cells = row(index).map(|value| format!("{value:.3}")).join(separator);
            let line = format!("{}{separator}{cells}\n", index as f64 * step);
            text += &if comma { line.replace('.', ",") } else { line };
        }
        text.into_bytes()
    };
    let own: Vec<String> = (1..=6).map(|joint| format!("joint{joint}_deg")).collect();
    let rtde: Vec<String> = (0..6).map(|joint| format!("actual_q_{joint}")).collect();
    vec![
        table(&format!("# robot: x\nt_s,{}\n", own.join(",")), ",", 0.004, false),
        table(&format!("timestamp {}\n", rtde.join(" ")), " ", 0.008, false),
        table("x\nTime;J1;J2;J3;J4;J5;J6\n[ms];;;;;;\n", ";", 8.0, true),
    ]
}

/// Telegrams with and without a root element.
pub fn telegrams() -> Vec<Vec<u8>> {
    let telegram = |index: usize| {
        let axes: String =
            row(index).iter().zip(1..).map(|(value, axis)| format!(" A{axis}=\"{value:.3}\"")).collect();
        format!("<Rob TYPE=\"KUKA\"><AIPos{axes}/><IPOC>{}</IPOC></Rob>\n", 4000 + 4 * index)
    };
    let text: String = (0..52).map(telegram).collect();
    vec![format!("<?xml version=\"1.0\"?>\n<Log>{text}</Log>").into_bytes(), text.into_bytes()]
}

/// Messages with the controller's milliseconds.
pub fn egm_messages() -> Vec<Vec<u8>> {
    let message = |index: usize| {
        let mut joints = Vec::new();
        for value in row(index) {
            joints.push(0x09);
            joints.extend(value.to_le_bytes());
        }
        let joints = [&[0x0a, joints.len() as u8][..], &joints].concat();
        let body = [
            &[0x0a, 4, 0x08, index as u8, 0x10, 4 * (index as u8 % 32)][..],
            &[0x12, joints.len() as u8],
            &joints,
        ]
        .concat();
        [&[body.len() as u8][..], &body].concat()
    };
    vec![(0..30).flat_map(message).collect(), message(1)]
}

/// Bags with joint states as our own recordings have them.
pub fn mcap_bags() -> Vec<Vec<u8>> {
    super::recording::whole_and_cut()
}

/// None: `small.db3` in the corpus was written by another program.
pub fn sqlite_bags() -> Vec<Vec<u8>> {
    Vec::new()
}
