//! Writes a robot's joint log as CSV, which [`crate::logs::read`] can read.

use std::io::Write;

use shared::config::RobotConfig;

use super::table::{TIME_COLUMN, column_name};
use crate::logs::force::ALONG_COLUMN;
use crate::logs::{ForceKind, JointConversion, RobotLog};

/// Writes `log` as CSV, with the columns and the unit of `robot`'s configuration. A force along the bar is also written if
/// its stamps are those of the joints.
///
/// # Errors
/// Errors of the sink, and an error of kind `Other` if the robot's conversion cannot be inverted.
pub fn write(log: &RobotLog, robot: &RobotConfig, sink: impl Write) -> std::io::Result<()> {
    let conversion = JointConversion::from_robot(robot).map_err(std::io::Error::other)?;
    let mut sink = std::io::BufWriter::new(sink);
    for (key, value) in [
        ("robot", log.robot.as_deref().unwrap_or(&robot.name)),
        ("clock", log.clock.as_str()),
        ("values", log.origin.name()),
    ] {
        writeln!(sink, "# {key}: {}", value.replace(['\r', '\n'], " "))?;
    }
    let mut csv = csv::Writer::from_writer(sink);
    let along = log.force.as_ref().filter(|force| {
        let same_clock = force.values.first_stamp_ns == log.q_rad.first_stamp_ns;
        force.kind == ForceKind::Along && same_clock && force.values.t_s == log.q_rad.t_s
    });
    let header: Vec<String> = std::iter::once(TIME_COLUMN.to_owned())
        .chain((0..robot.axes()).map(|index| column_name(robot, index, robot.log.unit)))
        .chain(along.map(|_| ALONG_COLUMN.to_owned()))
        .collect();
    csv.write_record(&header)?;
    for (index, q_rad) in log.q_rad.iter().enumerate() {
        let Some(stamp_ns) = log.q_rad.stamp_ns(index) else { break };
        let mut row = vec![seconds_text(stamp_ns)];
        row.extend(conversion.to_raw(q_rad).into_iter().map(|value| value.to_string()));
        row.extend(along.and_then(|force| force.values.get(index)).map(|values| values[0].to_string()));
        csv.write_record(&row)?;
    }
    csv.flush()
}

/// Integer nanoseconds as decimal seconds with nine decimals.
pub(in crate::logs) fn seconds_text(ns: i64) -> String {
    let magnitude = ns.unsigned_abs();
    let sign = if ns < 0 { "-" } else { "" };
    format!("{sign}{}.{:09}", magnitude / 1_000_000_000, magnitude % 1_000_000_000)
}
