//! Reads a robot's joint log from CSV.
//!
//! Header row with `t_s` and the six columns that the robot's configuration names, `{column}{1..6}_{rad|deg}`;
//! other columns are ignored. Lines `# key: value` before or between rows declare `robot`, `clock` and `values`
//! (measured or commanded). Comma, semicolon or tab between cells, decimal point, byte order mark and CRLF allowed.

use std::path::Path;

use shared::config::{AngleUnit, RobotConfig};

use super::csv_text::{Column, Format, Row, Table, comments, decode, delimiter_of_header};
use super::{JointConversion, LogError, LogQuality, Origin, RobotLog};

/// Fewest rows that make a log.
pub(super) const ROWS_MIN: usize = 50;
/// Name of the column with time stamps \[s\].
pub(super) const TIME_COLUMN: &str = "t_s";
/// Joint values may pass the nominal limits by this much before a log is refused \[deg\]: zero positions of real
/// robots differ a little from the data sheet.
const LIMIT_SLACK_DEG: f64 = 2.0;
/// A log whose joints all move less than this \[deg\] cannot identify anything.
const MOTION_DEG_MIN: f64 = 5.0;

/// Reads the log at `path`.
///
/// # Errors
/// Every way in which the file cannot be used, see [`LogError`].
pub fn load(path: &Path, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    let bytes =
        std::fs::read(path).map_err(|source| LogError::Unreadable { path: path.to_owned(), source })?;
    read(&bytes, path, robot)
}

/// [`load`] on bytes in memory; `path` is only named in errors.
///
/// # Errors
/// As [`load`].
pub fn read(bytes: &[u8], path: &Path, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    let text = decode(bytes, path)?;
    let conversion = JointConversion::new(&robot.log)?;
    let format = Format { delimiter: delimiter_of_header(text), decimal_comma: false };
    let mut table = Table::open(text, path, format)?;
    let columns = Columns::find(&table, path, robot)?;
    let raw = read_rows(&mut table, &columns, path)?;
    if raw.stamps_ns.len() < ROWS_MIN {
        return Err(LogError::TooFewRows {
            path: path.to_owned(),
            rows: raw.stamps_ns.len(),
            needed: ROWS_MIN,
        });
    }
    let q_rad: Vec<[f64; 6]> = raw.values.iter().map(|row| conversion.to_joint(row)).collect();
    check_limits(&raw, &q_rad, &conversion, robot, path)?;
    Ok(assemble(text, raw, q_rad))
}

struct Columns {
    time: Column,
    joints: Vec<Column>,
}

impl Columns {
    fn find(table: &Table<'_>, path: &Path, robot: &RobotConfig) -> Result<Self, LogError> {
        let time = table.column(TIME_COLUMN, "Name the column of time stamps, in seconds, `t_s`.")?;
        let unit = robot.log.unit;
        let other = match unit {
            AngleUnit::Rad => AngleUnit::Deg,
            AngleUnit::Deg => AngleUnit::Rad,
        };
        let mut joints = Vec::with_capacity(6);
        for index in 0..6 {
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
                "A log of {} has {} to {}; rename the columns or correct `log` in the robot's configuration.",
                robot.name,
                column_name(robot, 0, unit),
                column_name(robot, 5, unit)
            );
            joints.push(table.column(&name, &remedy)?);
        }
        Ok(Self { time, joints })
    }
}

/// Name of the column of motor or joint `index` (from 0).
pub(super) fn column_name(robot: &RobotConfig, index: usize, unit: AngleUnit) -> String {
    format!("{}{}_{}", robot.log.column, index + 1, unit.suffix())
}

/// What the file says, in its own units.
#[derive(Default)]
struct RawLog {
    lines: Vec<u64>,
    stamps_ns: Vec<i64>,
    values: Vec<[f64; 6]>,
    duplicates_dropped: usize,
}

fn read_rows(table: &mut Table<'_>, columns: &Columns, path: &Path) -> Result<RawLog, LogError> {
    let mut raw = RawLog::default();
    let mut stamp_before = String::new();
    while let Some(row) = table.next_row() {
        let row = row?;
        let stamp_ns = stamp_ns(table, &row, &columns.time)?;
        let mut values = [0.0; 6];
        for (value, column) in values.iter_mut().zip(&columns.joints) {
            *value = table.number(&row, column)?;
        }
        let stamp = table.text(&row, &columns.time);
        if let (Some(&before_ns), Some(&before)) = (raw.stamps_ns.last(), raw.values.last()) {
            if stamp_ns == before_ns && values == before {
                raw.duplicates_dropped += 1;
                continue;
            }
            if stamp_ns <= before_ns {
                return Err(LogError::TimeNotIncreasing {
                    path: path.to_owned(),
                    line: row.line,
                    before_line: raw.lines.last().copied().unwrap_or_default(),
                    before_s: stamp_before,
                    after_s: stamp.to_owned(),
                });
            }
        }
        stamp.clone_into(&mut stamp_before);
        raw.lines.push(row.line);
        raw.stamps_ns.push(stamp_ns);
        raw.values.push(values);
    }
    Ok(raw)
}

/// A stamp to integer ns. Decimal digits are taken as they are: a UTC stamp in seconds has more of them than an
/// `f64` can hold.
fn stamp_ns(table: &Table<'_>, row: &Row, column: &Column) -> Result<i64, LogError> {
    let seconds = table.number(row, column)?;
    decimal_to_ns(table.text(row, column))
        .or_else(|| {
            let ns = (seconds * 1e9).round();
            (ns.abs() < i64::MAX as f64).then_some(ns as i64)
        })
        .ok_or_else(|| {
            table.bad(
                row,
                column,
                format!("{seconds} s is more than 292 years"),
                "give the time in seconds, from any zero within 292 years",
            )
        })
}

/// `[-]digits[.digits]` in seconds to ns, exactly up to ns and rounded below; none for other notations.
fn decimal_to_ns(text: &str) -> Option<i64> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    if !whole.bytes().chain(fraction.bytes()).all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let whole: i64 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
    let digit = |index: usize| fraction.as_bytes().get(index).map_or(0, |byte| i64::from(byte - b'0'));
    let rounding = i64::from(digit(9) >= 5);
    let fraction_ns = (0..9).fold(0, |ns, index| ns * 10 + digit(index)) + rounding;
    let ns = whole.checked_mul(1_000_000_000)?.checked_add(fraction_ns)?;
    Some(if negative { -ns } else { ns })
}

fn check_limits(
    raw: &RawLog,
    q_rad: &[[f64; 6]],
    conversion: &JointConversion,
    robot: &RobotConfig,
    path: &Path,
) -> Result<(), LogError> {
    let beyond = |row: &[f64; 6]| beyond_limits(row, &robot.joint_limits_deg);
    let rows_beyond = q_rad.iter().filter(|row| beyond(row).is_some()).count();
    let first =
        q_rad.iter().zip(&raw.lines).find_map(|(row, line)| beyond(row).map(|joint| (row, line, joint)));
    let Some((row, &line, joint)) = first else { return Ok(()) };
    let [low_deg, high_deg] = robot.joint_limits_deg[joint];
    Err(LogError::BeyondLimits {
        path: path.to_owned(),
        line,
        joint: joint + 1,
        value_deg: row[joint].to_degrees(),
        low_deg,
        high_deg,
        rows_beyond,
        rows: q_rad.len(),
        remedy: likely_cause(raw, conversion, robot),
    })
}

/// The first joint beyond its limits.
fn beyond_limits(q_rad: &[f64; 6], limits_deg: &[[f64; 2]; 6]) -> Option<usize> {
    q_rad.iter().zip(limits_deg).position(|(q, [low, high])| {
        !(low - LIMIT_SLACK_DEG..=high + LIMIT_SLACK_DEG).contains(&q.to_degrees())
    })
}

/// Tries the usual mistakes on the whole log and names the one that would bring every row within the limits.
fn likely_cause(raw: &RawLog, conversion: &JointConversion, robot: &RobotConfig) -> String {
    let fits = |to_joint: &dyn Fn(&[f64; 6]) -> [f64; 6]| {
        raw.values.iter().all(|row| beyond_limits(&to_joint(row), &robot.joint_limits_deg).is_none())
    };
    if robot.log.unit == AngleUnit::Rad && fits(&|row| conversion.to_joint_with_unit(row, AngleUnit::Deg)) {
        return "read as degrees every row fits: the columns look like degrees under a `_rad` header; export \
                radians, or name the columns `_deg` and set log.unit = \"deg\" in the robot's configuration"
            .into();
    }
    for (i, j) in (0..6).flat_map(|i| (i + 1..6).map(move |j| (i, j))) {
        let swapped = |row: &[f64; 6]| {
            let mut row = *row;
            row.swap(i, j);
            conversion.to_joint(&row)
        };
        if fits(&swapped) {
            let unit = robot.log.unit;
            return format!(
                "with columns `{}` and `{}` exchanged every row fits: check their order in the export",
                column_name(robot, i, unit),
                column_name(robot, j, unit)
            );
        }
    }
    "check that the log belongs to this robot, its unit, the order of its columns, and log.raw_offset_rad and \
     joint_limits_deg of the robot's configuration"
        .into()
}

fn assemble(text: &str, raw: RawLog, q_rad: Vec<[f64; 6]>) -> RobotLog {
    let first_stamp_ns = raw.stamps_ns.first().copied().unwrap_or_default();
    // 128 bits: two stamps may be further apart than 292 years.
    let since_first_s = |stamp: &i64| (i128::from(*stamp) - i128::from(first_stamp_ns)) as f64 * 1e-9;
    let t_s: Vec<f64> = raw.stamps_ns.iter().map(since_first_s).collect();
    let quality = quality(&t_s, &q_rad, raw.duplicates_dropped);
    let mut log =
        RobotLog { first_stamp_ns, t_s, q_rad, quality, clock: "unstated".into(), ..RobotLog::default() };
    for (key, value) in comments(text) {
        match key.as_str() {
            "robot" => log.robot = Some(value.to_owned()),
            "clock" => value.clone_into(&mut log.clock),
            "values" => {
                log.origin = [Origin::Measured, Origin::Commanded]
                    .into_iter()
                    .find(|origin| origin.name() == value.to_lowercase())
                    .unwrap_or_default();
            }
            _ => {}
        }
    }
    log
}

fn quality(t_s: &[f64], q_rad: &[[f64; 6]], duplicates_dropped: usize) -> LogQuality {
    let mut steps_s: Vec<f64> =
        t_s.iter().zip(t_s.iter().skip(1)).map(|(before, after)| after - before).collect();
    steps_s.sort_by(f64::total_cmp);
    let span_deg = |joint: usize| {
        let (low, high) = q_rad.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), q| {
            (low.min(q[joint]), high.max(q[joint]))
        });
        (high - low).to_degrees()
    };
    let mut remarks = Vec::new();
    if (0..6).all(|joint| span_deg(joint) < MOTION_DEG_MIN) {
        remarks.push(format!(
            "no joint moves by {MOTION_DEG_MIN} deg in the whole log: radians in columns named as degrees, or the \
             wrong part of a log?"
        ));
    }
    LogQuality {
        duplicates_dropped,
        period_s: steps_s.get(steps_s.len() / 2).copied().unwrap_or_default(),
        longest_gap_s: steps_s.last().copied().unwrap_or_default(),
        remarks,
    }
}
