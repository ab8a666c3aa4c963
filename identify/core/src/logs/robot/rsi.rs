//! Reads logs of the KUKA Robot Sensor Interface. The controller sends a `<Rob>` telegram in each cycle. The file contains
//! these telegrams one after the other, with or without a root element around them.
//!
//! In a telegram, `AIPos` contains the measured joint angles in degrees, `ASPos` the commanded angles in degrees, and `IPOC`
//! a counter in milliseconds. A telegram does not contain the date.

use std::path::Path;

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};
use shared::config::RobotConfig;

use super::mapping::RobotLogMapping;
use super::raw::{Meaning, RawLog, RawRobotRow};
use crate::kinematics::Joints;
use crate::logs::source::LogSource;
use crate::logs::tables::stamp::{StampReader, TimeColumn, TimeUnit};
use crate::logs::tables::text::Text;
use crate::logs::{LogError, LogFormat, RobotLog, ValueOrigin};

/// Attributes of `AIPos` and `ASPos`, one for each axis.
const AXES: [&str; 6] = ["A1", "A2", "A3", "A4", "A5", "A6"];

/// Joints and counter of one telegram.
#[derive(Default)]
struct Telegram {
    joints_deg: Option<[f64; AXES.len()]>,
    ipoc: Option<i64>,
}

/// Reads a log of telegrams. `mapping` selects measured or commanded angles and may change the unit of `IPOC`.
pub(in crate::logs) fn read(
    source: LogSource<'_>,
    robot: &RobotConfig,
    mapping: Option<&RobotLogMapping>,
) -> Result<RobotLog, LogError> {
    let path = source.path;
    let text = &*Text::new(source, None)?.whole()?;
    let names = AXES.map(str::to_owned).to_vec();
    let meaning = Meaning::of_degrees(robot, mapping, names, LogFormat::Rsi, path)?;
    let mut raw = RawLog::measured(path, "telegram", mapping, "IPOC");
    raw.remark_unused_force(mapping);
    let element = if raw.log.origin == ValueOrigin::Commanded { "ASPos" } else { "AIPos" };
    let time = mapping.and_then(|mapping| mapping.time.clone());
    if time.as_ref().is_some_and(|time| time.unit.is_dated()) {
        let problem = "[time] of the mapping has a unit with a date, but IPOC is a counter";
        return Err(LogError::content(path, problem, "write unit = \"ms\", or cycles with their period_ms"));
    }
    let mut stamps = StampReader::new(&time.unwrap_or_else(|| TimeColumn::new("IPOC", TimeUnit::Ms)));
    let telegrams = parse(text, path, element)?;
    check_counter(&telegrams, path, mapping.is_some_and(|mapping| mapping.time.is_some()))?;
    for (telegram, number) in telegrams.iter().zip(1u64..) {
        let stamp_ns = telegram.ipoc.and_then(|ipoc| stamps.of_units(ipoc)).ok_or_else(|| {
            let remedy = "record whole telegrams: IPOC is their time";
            LogError::bad_record(path, format!("telegram {number}"), "no IPOC".into(), remedy)
        })?;
        // If the robot has more axes than a telegram, the other axes are missing in every row.
        let joints_deg = telegram.joints_deg.unwrap_or([f64::NAN; AXES.len()]);
        let joint = |axis: usize| joints_deg.get(axis).copied().unwrap_or(f64::NAN);
        let joints = Joints::from_fn(robot.axes(), joint);
        raw.push(RawRobotRow { place: number, stamp_ns, joints, ..RawRobotRow::default() }, &meaning)?;
    }
    raw.finish(&meaning)
}

/// Rejects a counter that increases by one with each telegram, unless the mapping has a time unit. Such a counter counts
/// telegrams, and the file does not contain their period.
fn check_counter(telegrams: &[Telegram], path: &Path, unit_is_given: bool) -> Result<(), LogError> {
    let ipocs: Vec<i64> = telegrams.iter().filter_map(|telegram| telegram.ipoc).collect();
    let mut steps: Vec<i64> = ipocs.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    steps.sort_unstable();
    match steps.get(steps.len() / 2) {
        Some(1) if !unit_is_given => {
            let problem = "IPOC increases by 1 with each telegram: it counts telegrams, not milliseconds";
            let remedy = "state their period in a mapping file (--log-mapping): [time] with unit = \"cycles\" and period_ms; \
                          or record with an RSI cycle of 4 or 12 ms";
            Err(LogError::content(path, problem, remedy))
        }
        _ => Ok(()),
    }
}

/// Reads the joints in `element` and the counter of each telegram.
fn parse(text: &str, path: &Path, element: &str) -> Result<Vec<Telegram>, LogError> {
    let mut reader = Reader::from_str(text);
    reader.config_mut().check_end_names = false;
    let mut telegrams = Vec::new();
    let mut current = Telegram::default();
    let mut in_ipoc = false;
    loop {
        let bad = |problem: String| {
            let place = format!("telegram {}", telegrams.len() + 1);
            let remedy = "write the <Rob> telegrams one after the other; remove an incomplete last one";
            LogError::bad_record(path, place, problem, remedy)
        };
        match reader.read_event().map_err(|error| bad(error.to_string()))? {
            Event::Start(tag) | Event::Empty(tag) if is_named(&tag, element) => {
                current.joints_deg = Some(axes(&tag).map_err(bad)?);
            }
            Event::Start(tag) => in_ipoc = is_named(&tag, "IPOC"),
            Event::Text(content) if in_ipoc => {
                let text = content.xml10_content().into_owned();
                current.ipoc = Some(
                    text.trim()
                        .parse()
                        .map_err(|_| bad(format!("IPOC `{}` is not a number", text.trim())))?,
                );
            }
            Event::End(tag) => {
                in_ipoc = false;
                if tag.local_name().as_ref() == "Rob" {
                    telegrams.push(std::mem::take(&mut current));
                }
            }
            Event::Eof => return Ok(telegrams),
            _ => {}
        }
    }
}

fn is_named(tag: &BytesStart<'_>, name: &str) -> bool {
    tag.local_name().as_ref() == name
}

/// The six axes of a position \[deg\]; NaN for a missing axis.
fn axes(tag: &BytesStart<'_>) -> Result<[f64; AXES.len()], String> {
    let mut joints_deg = [f64::NAN; AXES.len()];
    for attribute in tag.attributes() {
        let attribute = attribute.map_err(|error| error.to_string())?;
        let key = attribute.key.as_ref();
        if let Some(axis) = AXES.iter().position(|axis| *axis == key) {
            let text = attribute.value;
            joints_deg[axis] =
                text.trim().parse().map_err(|_| format!("{} = `{text}` is not a number", AXES[axis]))?;
        }
    }
    Ok(joints_deg)
}
