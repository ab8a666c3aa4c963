//! Reads robot logs from text tables. The columns are the robot's own ([`read_own`]), those of an RTDE client
//! ([`read_rtde`]), or those that a mapping names ([`read_mapped`]). Each function finds its columns, reads all rows into a
//! [`RawLog`], and converts them to a [`RobotLog`].

use std::path::Path;

use shared::config::{AngleUnit, JointKind, RobotConfig};

use super::mapping::{Columns, CsvLayout, RobotLogMapping};
use super::raw::{Meaning, RawLog, RawRobotRow};
use crate::kinematics::Joints;
use crate::logs::force::ForceLayout;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvTable};
use crate::logs::tables::stamp::{StampColumn, TimeColumn, TimeUnit};
use crate::logs::tables::text::Text;
use crate::logs::{ForceColumns, LogError, LogFormat, RobotLog, ValueOrigin, usual_and_longest_step_s};
use crate::statistics::largest_difference;

/// Name of the column with time stamps \[s\].
pub(in crate::logs) const TIME_COLUMN: &str = "t_s";

/// Name of the column of motor or joint `index` (from 0) in the robot's own log.
pub(in crate::logs) fn column_name(robot: &RobotConfig, index: usize, unit: AngleUnit) -> String {
    let prismatic = robot.joint_kinds().nth(index) == Some(JointKind::Prismatic);
    let suffix = if prismatic { JointKind::Prismatic.si_symbol() } else { unit.suffix() };
    format!("{}{}_{suffix}", robot.log.column, index + 1)
}

/// Names of the columns with joints in the robot's own log, base to flange.
pub fn own_columns(robot: &RobotConfig) -> Columns {
    (0..robot.axes()).map(|index| column_name(robot, index, robot.log.unit)).collect()
}

/// The columns of an open table that are read.
struct RobotTableLayout {
    time: StampColumn,
    joints: Vec<CsvColumn>,
    speeds: Option<Vec<CsvColumn>>,
    torques: Option<Vec<CsvColumn>>,
    force: Option<ForceLayout>,
}

/// Reads a table with the robot's own columns: `t_s` and the columns that the robot's configuration names.
/// Other columns are ignored.
pub(in crate::logs) fn read_own(source: LogSource<'_>, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    let path = source.path;
    let meaning = Meaning::own(robot, robot.log.unit, own_columns(robot))?;
    let mut table = CsvTable::open(source, &CsvLayout::default())?;
    let remedy = "Name the column of time stamps, in seconds, `t_s`, or assign the columns in a mapping (--log-mapping).";
    let mut layout = RobotTableLayout {
        time: StampColumn::find(&table, &TimeColumn::new(TIME_COLUMN, TimeUnit::S), remedy)?,
        joints: own_joints(&table, path, robot)?,
        speeds: None,
        torques: None,
        force: ForceLayout::find_usual(&table, robot)?,
    };
    let mut raw = RawLog::new(path, "line");
    read_rows(&mut table, &mut layout, &meaning, &mut raw)?;
    take_comments(&mut raw.log, &table);
    raw.force = layout.force.as_ref().map(|force| force.kind(&table)).transpose()?;
    refuse_if_not_seconds(raw.finish(&meaning)?, path)
}

/// Returns the log, or an error if its `t_s` counts milliseconds or microseconds. With times that are 1000 times too long,
/// rows are seconds apart, and all joints seem to move much more slowly than a real robot.
fn refuse_if_not_seconds(log: RobotLog, path: &Path) -> Result<RobotLog, LogError> {
    /// A log is refused only if the median time between its rows is at least this \[s\]. Even with correct times, such a log
    /// would be too coarse to follow a motion.
    const PERIOD_S_MIN: f64 = 0.9;
    /// A log is refused only if no joint is faster than this \[rad/s, m/s\]. A real motion exceeds this speed at some time.
    const SPEED_MIN: f64 = 0.02;
    let (t_s, rows) = (&log.q_rad.t_s, &log.q_rad);
    let [period_s, _] = usual_and_longest_step_s(t_s);
    let fastest = t_s.windows(2).zip(rows.windows(2)).fold(0.0_f64, |fastest, (t_s, q)| {
        fastest.max(largest_difference(&q[1], &q[0]) / (t_s[1] - t_s[0]).max(f64::MIN_POSITIVE))
    });
    if period_s < PERIOD_S_MIN || fastest > SPEED_MIN {
        return Ok(log);
    }
    let unit = if period_s < 1e3 * PERIOD_S_MIN { "ms" } else { "us" };
    let problem = format!(
        "column `{TIME_COLUMN}` counts {unit}, not seconds: rows are {period_s:.3} apart, and no joint would be faster than \
         {:.3} deg/s",
        fastest.to_degrees()
    );
    let remedy = format!(
        "rename it and name its unit in a mapping, [time] unit = \"{unit}\" (--log-mapping; `identify inspect --propose` writes one)"
    );
    Err(LogError::content(path, problem, remedy))
}

/// Finds the columns with joints in the robot's own log. Columns in the other unit of angles are an error.
fn own_joints(table: &CsvTable<'_>, path: &Path, robot: &RobotConfig) -> Result<Vec<CsvColumn>, LogError> {
    let unit = robot.log.unit;
    let other = match unit {
        AngleUnit::Rad => AngleUnit::Deg,
        AngleUnit::Deg => AngleUnit::Rad,
    };
    let mut joints = Vec::with_capacity(robot.axes());
    for index in 0..robot.axes() {
        let name = column_name(robot, index, unit);
        let in_other_unit = column_name(robot, index, other);
        if !table.has(&name) && table.has(&in_other_unit) {
            return Err(LogError::UnitMismatch {
                path: path.to_owned(),
                column: in_other_unit,
                in_header: other.suffix(),
                in_config: unit.suffix(),
                robot: robot.name.clone(),
            });
        }
        let remedy = format!(
            "The robot's file of {} expects the columns {} to {}; rename the columns, assign them in a mapping (--log-mapping), or correct [log] in the file.",
            robot.name,
            column_name(robot, 0, unit),
            column_name(robot, robot.axes() - 1, unit)
        );
        joints.push(table.column(&name, &remedy)?);
    }
    Ok(joints)
}

/// Reads a table of `record.py` of the RTDE client or of the library `ur_rtde`, with joints in radians. Measured values
/// (`actual_q_0`) are preferred to commanded values (`target_q_0`).
pub(in crate::logs) fn read_rtde(source: LogSource<'_>, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    let path = source.path;
    let mut text = Text::new(source, None)?;
    // `record.py` separates the columns by blanks, `ur_rtde` by commas.
    let delimiter = if text.header_line()?.contains(',') { b',' } else { b' ' };
    let table = &mut CsvTable::delimited(text, delimiter, &CsvLayout::default())?;
    let origin = if table.has("actual_q_0") { ValueOrigin::Measured } else { ValueOrigin::Commanded };
    let kind = if origin == ValueOrigin::Measured { "actual" } else { "target" };
    let columns = |quantity: &str| -> Columns {
        (0..robot.axes()).map(|joint| format!("{kind}_{quantity}_{joint}")).collect()
    };
    let remedy = "Record timestamp and actual_q; add actual_qd and actual_current if you like.";
    let optional = |names: &Columns| {
        let are_all_there = names.iter().all(|name| table.has(name));
        are_all_there.then(|| table.columns(names, remedy)).transpose()
    };
    let meaning = Meaning::of_controller(robot, AngleUnit::Rad, columns("q"), LogFormat::UrRtde, path)?;
    let mut layout = RobotTableLayout {
        time: StampColumn::find(table, &TimeColumn::new("timestamp", TimeUnit::S), remedy)?,
        joints: table.columns(&meaning.logged.names, remedy)?,
        speeds: optional(&columns("qd"))?,
        torques: optional(&columns("current"))?,
        force: ForceLayout::find_usual(table, robot)?,
    };
    let mut raw = RawLog::new(path, "line");
    (raw.log.clock, raw.log.origin) = ("since the controller's start".into(), origin);
    read_rows(table, &mut layout, &meaning, &mut raw)?;
    raw.force = layout.force.as_ref().map(|force| force.kind(table)).transpose()?;
    raw.finish(&meaning)
}

/// Reads a table with the columns that a mapping names.
pub(in crate::logs) fn read_mapped(
    source: LogSource<'_>,
    robot: &RobotConfig,
    mapping: &RobotLogMapping,
) -> Result<RobotLog, LogError> {
    let path = source.path;
    let mut table = CsvTable::open(source, &mapping.csv)?;
    let (mut layout, meaning) = mapped_layout(&table, robot, path, mapping)?;
    let mut raw = RawLog::new(path, "line");
    read_rows(&mut table, &mut layout, &meaning, &mut raw)?;
    take_comments(&mut raw.log, &table);
    raw.log.clock = mapping.clock.clone().unwrap_or(raw.log.clock);
    raw.log.origin = mapping.values.unwrap_or(raw.log.origin);
    raw.force = mapping.force.as_ref().map(ForceColumns::kind);
    raw.finish(&meaning)
}

/// Finds the columns of a mapping in an open table, and the conversion of its joints.
fn mapped_layout<'a>(
    table: &CsvTable<'_>,
    robot: &'a RobotConfig,
    path: &Path,
    mapping: &RobotLogMapping,
) -> Result<(RobotTableLayout, Meaning<'a>), LogError> {
    let remedy = "Correct the name in the mapping file.";
    let time = TimeColumn::of_table(mapping.time.as_ref(), path)?;
    let time = StampColumn::find(table, time, remedy)?;
    let (joints, meaning) = match mapping.with_joints() {
        Some(mapping) => {
            let names: Columns = mapping.joints.iter().map(|joint| joint.column.clone()).collect();
            let joints = table.columns(&names, remedy)?;
            (joints, Meaning::mapped(robot, mapping, names, path)?)
        }
        None => (own_joints(table, path, robot)?, Meaning::own(robot, robot.log.unit, own_columns(robot))?),
    };
    let optional =
        |names: &Option<Columns>| names.as_ref().map(|names| table.columns(names, remedy)).transpose();
    let layout = RobotTableLayout {
        time,
        joints,
        speeds: optional(&mapping.speeds)?,
        torques: optional(&mapping.torques)?,
        force: mapping
            .force
            .as_ref()
            .and_then(|force| ForceLayout::find_named(table, path, force, robot).transpose())
            .transpose()?,
    };
    Ok((layout, meaning))
}

/// Reads robot, clock and origin of the values from comment lines.
fn take_comments(log: &mut RobotLog, table: &CsvTable<'_>) {
    for (key, value) in table.comments() {
        match key.as_str() {
            "robot" => log.robot = Some(value.clone()),
            "clock" => value.clone_into(&mut log.clock),
            "values" => {
                log.origin = [ValueOrigin::Measured, ValueOrigin::Commanded]
                    .into_iter()
                    .find(|origin| origin.name() == value.to_lowercase())
                    .unwrap_or_default();
            }
            _ => {}
        }
    }
}

/// Reads the columns of all rows of a table into `raw`.
fn read_rows(
    table: &mut CsvTable<'_>,
    layout: &mut RobotTableLayout,
    meaning: &Meaning<'_>,
    raw: &mut RawLog,
) -> Result<(), LogError> {
    while let Some(row) = table.next_row()? {
        let numbers = |columns: &[CsvColumn]| -> Result<Joints, LogError> {
            columns.iter().map(|column| row.number(column)).collect()
        };
        let row = RawRobotRow {
            place: row.line,
            stamp_ns: layout.time.next_ns(&row)?,
            joints: numbers(&layout.joints)?,
            speeds: layout.speeds.as_deref().map(numbers).transpose()?,
            torques: layout.torques.as_deref().map(numbers).transpose()?,
            force: layout.force.as_ref().map(|force| force.row(&row)).transpose()?,
        };
        raw.push(row, meaning)?;
    }
    Ok(())
}
