//! Fuzz targets: read robot logs of every format from arbitrary bytes.

use std::path::Path;
use std::sync::LazyLock;

use identify::logs::{
    ForceColumns, ForceFrame, ForceUnit, LogFormat, LogOptions, RobotLogMapping, read_with,
};
use shared::config::{self, RobotConfig};

use super::{explained, force_log, joint_states};

struct RobotLogSetting {
    robot: RobotConfig,
    mapping: RobotLogMapping,
}

static SETTING: LazyLock<RobotLogSetting> = LazyLock::new(|| {
    let directory = crate::config_directory();
    // No joint reaches these limits, so most logs are accepted.
    let mut robot: RobotConfig =
        config::load(&directory.join("robots/irb120_3.toml")).expect("a shipped file");
    robot.joint_limits_deg = vec![[-1e6, 1e6]; 6];
    let shipped: RobotLogMapping = config::load(&directory.join("robot_log.toml")).expect("a shipped file");
    let torques = ForceColumns { columns: Vec::new(), unit: ForceUnit::Nm, frame: ForceFrame::Flange };
    RobotLogSetting { robot, mapping: RobotLogMapping { force: Some(torques), ..shipped } }
});

/// Reads a log in this format, with and without a mapping. If the log is accepted, it must have the guaranteed properties.
/// If the log is refused, the error must contain a reason.
fn any_log(format: LogFormat, bytes: &[u8]) {
    let RobotLogSetting { robot, mapping } = &*SETTING;
    for mapping in [None, Some(mapping.clone())] {
        let options = LogOptions { format: Some(format), mapping };
        match read_with(bytes, Path::new("log"), robot, &options) {
            Ok(log) => {
                assert!(log.q_rad.len() == log.q_rad.t_s.len() && log.q_rad.t_s.first() == Some(&0.0));
                assert!(log.q_rad.t_s.is_sorted_by(|a, b| a <= b), "time runs backwards");
                assert!(log.q_rad.iter().flatten().all(|q| q.is_finite()));
                let rows = log.q_rad.len();
                assert!(log.speed_rad_s.is_none_or(|speeds| speeds.len() == rows));
                assert!(log.torque.is_none_or(|torques| torques.len() == rows));
                if let Some(force) = &log.force {
                    assert_eq!(force.values.len(), rows);
                    force_log::check(force);
                }
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

/// Seeds: a table in the robot's own format and a table of RTDE, both with a force, and a table for the shipped mapping.
pub fn tables() -> Vec<Vec<u8>> {
    let table = |header: &str, separator: &str, step: f64, more: &str| {
        let mut text = header.to_owned();
        for index in 0..52 {
            let cells = row(index).map(|value| format!("{value:.3}")).join(separator);
            text += &format!("{}{separator}{cells}{more}\n", index as f64 * step);
        }
        text
    };
    let own: Vec<String> = (1..=6).map(|joint| format!("joint{joint}_deg")).collect();
    let rtde: Vec<String> = (0..6).map(|joint| format!("actual_q_{joint}")).collect();
    let force: Vec<String> = (0..3).map(|axis| format!("actual_TCP_force_{axis}")).collect();
    let german = table("", ";", 8.0, "").replace('.', ",");
    [
        table(&format!("# robot: x\nt_s,{},force_N\n", own.join(",")), ",", 0.004, ",12.5"),
        table(&format!("timestamp {} {}\n", rtde.join(" "), force.join(" ")), " ", 0.008, " 1 -2.5 3"),
        format!("x\nTime;J1;J2;J3;J4;J5;J6\n[ms];;;;;;\n{german}"),
    ]
    .map(String::into_bytes)
    .to_vec()
}

/// Seeds: telegrams with and without a root element.
pub fn telegrams() -> Vec<Vec<u8>> {
    let telegram = |index: usize| {
        let axes: String =
            row(index).iter().zip(1..).map(|(value, axis)| format!(" A{axis}=\"{value:.3}\"")).collect();
        format!("<Rob TYPE=\"KUKA\"><AIPos{axes}/><IPOC>{}</IPOC></Rob>\n", 4000 + 4 * index)
    };
    let text: String = (0..52).map(telegram).collect();
    vec![format!("<?xml version=\"1.0\"?>\n<Log>{text}</Log>").into_bytes(), text.into_bytes()]
}

/// Seeds: EGM messages whose stamps are milliseconds of the controller.
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

/// Seeds: bags with efforts, and our own recordings. The joint names in the bags are those of drivers, or
/// those of the shipped mapping.
pub fn mcap_bags() -> Vec<Vec<u8>> {
    let driver = ["joint_2", "joint_1", "joint_3", "gripper", "joint_4", "joint_5", "joint_6"];
    let mut bags = vec![joint_states::bag(&driver), joint_states::bag(&["J1", "J2", "J3", "J4", "J5", "J6"])];
    bags.extend(super::recording::whole_and_cut());
    bags
}

/// Returns no seeds, because another program is needed to write such bags. The archive of saved inputs contains `small.db3`.
pub fn sqlite_bags() -> Vec<Vec<u8>> {
    Vec::new()
}
