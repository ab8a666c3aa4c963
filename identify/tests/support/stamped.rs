//! Logs whose stamps differ from the times of their samples.

use std::path::Path;

use identify::kinematics::Joints;
use identify::logs::{RobotLog, Stream, read, write};
use shared::config::RobotConfig;

/// `log` after it was written with the stamps `stamps_s` \[s\] and read again. `decimals` is the number of decimals of the
/// stamps in the file. Rows without a stamp are not written.
pub fn stamped(
    log: &RobotLog,
    robot: &RobotConfig,
    stamps_s: impl IntoIterator<Item = Option<f64>>,
    decimals: usize,
) -> RobotLog {
    let mut bytes = Vec::new();
    write(log, robot, &mut bytes).unwrap();
    let text = String::from_utf8(bytes).unwrap();
    let mut stamps_s = stamps_s.into_iter();
    let is_row = |line: &str| line.starts_with(|first: char| first.is_ascii_digit() || first == '-');
    let lines = text.lines().map(|line| match line.split_once(',') {
        Some((_, rest)) if is_row(line) => {
            let stamp_s = stamps_s.next().unwrap();
            stamp_s.map_or_else(String::new, |stamp_s| format!("{stamp_s:.decimals$},{rest}\n"))
        }
        _ => format!("{line}\n"),
    });
    read(lines.collect::<String>().as_bytes(), Path::new("log.csv"), robot).unwrap()
}

/// `log` interpolated at another rate.
pub fn resampled(log: &RobotLog, rate_hz: f64) -> RobotLog {
    let spline = Stream::clone(&log.q_rad).spline().unwrap();
    let rows = (log.q_rad.duration_s() * rate_hz) as usize;
    let t_s: Vec<f64> = (0..rows).map(|row| row as f64 / rate_hz).collect();
    let q_rad: Vec<Joints> = t_s.iter().map(|t_s| spline.at(*t_s).unwrap().value).collect();
    RobotLog { q_rad: Stream::new(log.q_rad.first_stamp_ns, t_s, q_rad).into(), ..log.clone() }
}
