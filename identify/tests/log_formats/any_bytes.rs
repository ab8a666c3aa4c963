//! A log with arbitrary bytes is either refused with a message, or the values that are read
//! are finite and in order, or marked.

use std::path::Path;
use std::sync::LazyLock;

use identify::logs::{
    LogFormat, LogOptions, MeasuredLengthMapping, MeasuredLengths, MeasuredPoseMapping, MeasuredPoses,
    OtherBarLog, TimeColumn, TimeUnit, TimedPoses, read_with,
};
use proptest::prelude::*;
use shared::config::{self, BallBarConfig};

use super::bags::{self, JointState};
use super::{angle_deg, bar_log, cells, german_table, irb120, rows, shipped_mapping, telegrams};

const ROWS: usize = 60;

fn rtde() -> Vec<u8> {
    let names = |what: &str| (0..6).map(|i| format!("{what}_{i}")).collect::<Vec<_>>().join(" ");
    let mut text = format!("timestamp {} {}\n", names("actual_q"), names("actual_qd"));
    for (row, deg) in rows(ROWS) {
        let (q, qd) = (cells(&deg.map(f64::to_radians), " "), cells(&[0.25; 6], " "));
        text += &format!("{} {q} {qd}\n", row as f64 * 0.002);
    }
    text.into_bytes()
}

/// A log in Protobuf that is encoded here. Each message has a header with number and milliseconds, and feedback with joints.
fn egm() -> Vec<u8> {
    let message = |(row, deg): (usize, [f64; 6])| {
        let values: Vec<u8> = deg.iter().flat_map(|v| [&[0x09][..], &v.to_le_bytes()].concat()).collect();
        let joints = [&[0x0a, values.len() as u8][..], &values].concat();
        let header = [0x0a, 4, 0x08, row as u8, 0x10, row as u8];
        let body = [&header[..], &[0x12, joints.len() as u8], &joints].concat();
        [&[body.len() as u8][..], &body].concat()
    };
    rows(ROWS).flat_map(message).collect()
}

fn robot_states() -> Vec<JointState> {
    let state = |row: usize| JointState {
        topic: "/joint_states",
        stamp_ns: (row as i64 + 1) * 8_000_000,
        names: (1..=6).map(|joint| format!("joint_{joint}")).collect(),
        position: (0..6).map(|joint| angle_deg(row, joint).to_radians()).collect(),
    };
    (0..ROWS).map(state).collect()
}

fn own_table() -> Vec<u8> {
    let names = (1..=6).map(|joint| format!("joint{joint}_deg")).collect::<Vec<_>>().join(",");
    let lines = rows(ROWS).map(|(row, deg)| format!("{},{}\n", row as f64 * 0.004, cells(&deg, ",")));
    (format!("t_s,{names}\n") + &lines.collect::<String>()).into_bytes()
}

/// A complete log in each format of robot logs, with that format.
static ROBOT_LOGS: LazyLock<Vec<(LogFormat, Vec<u8>)>> = LazyLock::new(|| {
    vec![
        (LogFormat::Csv, own_table()),
        (LogFormat::Csv, german_table(ROWS).into_bytes()),
        (LogFormat::UrRtde, rtde()),
        (LogFormat::Rsi, telegrams(ROWS, 4).into_bytes()),
        (LogFormat::Egm, egm()),
        (LogFormat::Ros2Mcap, bags::mcap(&robot_states())),
        (LogFormat::Ros2Db3, bags::db3(&robot_states())),
    ]
});

/// A complete file in each format of the bar's logs.
static BAR_LOGS: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let states = &bar_log::joint_states("")[..ROWS];
    let exported: String = (0..ROWS)
        .map(|row| {
            let counts = (1..=5).map(|joint| (row * joint * 1000).to_string()).collect::<Vec<_>>().join(",");
            let flags = if row == 30 { "stale_input origin_changed" } else { "" };
            format!("2026-11-22T10:15:00.{row:02}Z,{counts},1,1,1,1,{},{row},{flags}\n", u8::from(row != 30))
        })
        .collect();
    let columns = |name: &str| (1..=5).map(|joint| format!("{name}{joint}")).collect::<Vec<_>>().join(",");
    let header = format!("time_utc,{},{},cycle,flags\n", columns("count"), columns("valid"));
    let headerless: String = (0..ROWS)
        .map(|row| format!("2016-03-14-10:22:33.{row:02};{};2;3;{}\n", row * 77, row * 100))
        .collect();
    vec![(header + &exported).into_bytes(), headerless.into_bytes(), bags::mcap(states), bags::db3(states)]
});

fn config<T: serde::de::DeserializeOwned + config::Validate>(name: &str) -> T {
    config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config").join(name)).unwrap()
}

/// Reads the bytes as a robot log, with and without a mapping. Returns whether at least
/// one of the two attempts was accepted.
fn read_as_robot(bytes: &[u8], format: LogFormat) -> bool {
    let mut robot = irb120();
    // No value reaches these limits, so most logs are accepted.
    robot.joint_limits_deg = vec![[-1e6, 1e6]; 6];
    let mut taken = false;
    for mapping in [None, Some(shipped_mapping())] {
        match read_with(bytes, Path::new("log"), &robot, &LogOptions { format: Some(format), mapping }) {
            Ok(log) => {
                taken = true;
                assert!(log.q_rad.len() == log.q_rad.t_s.len() && log.q_rad.t_s[0] == 0.0);
                assert!(log.q_rad.iter().flatten().chain(&log.q_rad.t_s).all(|value| value.is_finite()));
                assert!(log.q_rad.t_s.is_sorted(), "time runs backwards");
            }
            Err(error) => assert!(error.to_string().len() > 10),
        }
    }
    taken
}

fn bars() -> [BallBarConfig; 2] {
    let mut four = crate::support::bar();
    four.encoders.remove(2);
    [crate::support::bar(), four]
}

fn read_as_bar(bytes: &[u8]) -> bool {
    let mut taken = false;
    for bar in bars() {
        for mapping in [None, Some(bar_log::shipped())] {
            match OtherBarLog::read(bytes, Path::new("log"), &bar, mapping.as_ref()) {
                Ok(log) => {
                    taken = true;
                    assert!(!log.encoders.is_empty() && !log.unknown.is_empty());
                    assert!((0..).zip(&log.cycles).all(|(number, cycle)| cycle.cycle == number));
                    if let Ok(angles) = identify::prepare::bar_angles(&log.cycles, &log.encoders) {
                        let all = angles.readings.iter().flat_map(|reading| reading.recorded_rad);
                        assert!(all.into_iter().all(|angle| angle.is_finite()));
                    }
                    let _ = identify::inspect::bar_log(&log);
                }
                Err(error) => assert!(error.to_string().len() > 10),
            }
        }
    }
    taken
}

fn pose_tables() -> [Vec<u8>; 2] {
    let lengths = "x_mm,y_mm,z_mm,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,cable_mm\n".to_owned()
        + &"1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19\n".repeat(12);
    let joints =
        "shoulder_pan_joint;shoulder_lift_joint;elbow_joint;wrist_1_joint;wrist_2_joint;wrist_3_joint";
    let measured = ["x", "y", "z", "rx", "ry", "rz"].map(|axis| format!("measurement_{axis}")).join(";");
    let poses = format!("Timestamp;{joints};{measured}\n")
        + &"1;0,5;-1,5;0;0;0;3,1;2361,9;-1368,5;119,4;-90,5;-60;10\n".repeat(12);
    [lengths.into_bytes(), poses.into_bytes()]
}

fn read_as_poses(bytes: &[u8]) -> bool {
    let path = Path::new("poses");
    let lengths =
        MeasuredLengths::read(bytes, path, &config::<MeasuredLengthMapping>("measured_length.toml"));
    let mapping = config::<MeasuredPoseMapping>("measured_pose.toml");
    let poses = MeasuredPoses::read(bytes, path, &mapping);
    let time = TimeColumn::new("Timestamp", TimeUnit::default());
    let timed = MeasuredPoseMapping { time: Some(time), joints: Vec::new(), ..mapping };
    match TimedPoses::read(bytes, path, &timed) {
        Ok(poses) => {
            assert_eq!(poses.rows.t_s.len(), poses.rows.len());
            assert!(poses.rows.t_s.windows(2).all(|pair| pair[1] > pair[0]));
        }
        Err(error) => assert!(error.to_string().len() > 10),
    }
    let taken = lengths.is_ok() || poses.is_ok();
    match lengths {
        Ok(lengths) => assert!(lengths.rows.iter().all(|row| row.joints_rad.iter().all(|q| q.is_finite()))),
        Err(error) => assert!(error.to_string().len() > 10),
    }
    match poses {
        Ok(poses) => assert!(poses.rows.iter().all(|row| row.position_m.iter().all(|x| x.is_finite()))),
        Err(error) => assert!(error.to_string().len() > 10),
    }
    taken
}

fn read_as_everything(bytes: &[u8]) {
    for (format, _) in &*ROBOT_LOGS {
        read_as_robot(bytes, *format);
    }
    read_as_bar(bytes);
    read_as_poses(bytes);
}

#[test]
fn the_whole_files_that_are_damaged_below_are_read() {
    for (format, bytes) in &*ROBOT_LOGS {
        assert!(read_as_robot(bytes, *format), "{}", format.name());
    }
    assert!(BAR_LOGS.iter().all(|bytes| read_as_bar(bytes)));
    assert!(pose_tables().iter().all(|bytes| read_as_poses(bytes)));
}

/// Damage to a file: changed bytes, a section that occurs twice or is missing, and a truncated end.
#[derive(Debug, Clone)]
struct Damage {
    flips: Vec<(prop::sample::Index, u8)>,
    part: (prop::sample::Index, usize),
    doubled: bool,
    cut: Option<prop::sample::Index>,
}

fn damage() -> impl Strategy<Value = Damage> {
    let flips = prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..5);
    let part = (any::<prop::sample::Index>(), 0_usize..90);
    let cut = prop::option::weighted(0.3, any::<prop::sample::Index>());
    (flips, part, any::<bool>(), cut).prop_map(|(flips, part, doubled, cut)| Damage {
        flips,
        part,
        doubled,
        cut,
    })
}

impl Damage {
    fn done(&self, whole: &[u8]) -> Vec<u8> {
        let mut bytes = whole.to_vec();
        for (at, byte) in &self.flips {
            let at = at.index(bytes.len());
            bytes[at] = *byte;
        }
        let from = self.part.0.index(bytes.len());
        let to = (from + self.part.1).min(bytes.len());
        let part = bytes[from..to].to_vec();
        bytes.splice(from..to, if self.doubled { part.repeat(2) } else { Vec::new() });
        if let Some(cut) = &self.cut {
            bytes.truncate(cut.index(bytes.len().max(1)));
        }
        bytes
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn no_bytes_make_a_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        read_as_everything(&bytes);
        // Arbitrary bytes also follow the first bytes of each binary format.
        for magic in [&b"\x89MCAP0\r\n"[..], b"SQLite format 3\0"] {
            read_as_everything(&[magic, &bytes].concat());
        }
    }

    #[test]
    fn no_damage_to_a_robot_s_log_gives_nonsense(damage in damage()) {
        for (format, whole) in &*ROBOT_LOGS {
            read_as_robot(&damage.done(whole), *format);
        }
    }

    #[test]
    fn no_damage_to_a_file_of_the_bar_gives_nonsense(damage in damage()) {
        for whole in &*BAR_LOGS {
            read_as_bar(&damage.done(whole));
        }
    }

    #[test]
    fn no_damage_to_a_table_of_poses_gives_nonsense(damage in damage()) {
        for whole in pose_tables() {
            read_as_poses(&damage.done(&whole));
        }
    }
}
