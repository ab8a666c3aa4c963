//! Reads the encoders of the bar from a ROS 2 bag, in which they are joints of `sensor_msgs/JointState` messages.

use std::path::Path;

use shared::config::BallBarConfig;
use shared::recording::schema::MAX_ENCODERS;

use super::mapping::{BarLogMapping, EncoderColumn, EncoderUnit};
use super::samples::{BarLogKind, EncoderReader, RawBarLog, RawBarRow};
use super::{LogError, LogFormat, OtherBarLog};
use crate::kinematics::BAR_JOINTS;
use crate::logs::robot::ros::{Bag, UNSTAMPED, Wanted, clock_name};

/// Beginning of the names of the joints, as published by `ballbard`. All names may have the same prefix, such as `ball_`.
const USUAL: &str = "bar_joint_";

const WANTED: Wanted = Wanted {
    what: "the bar's encoders",
    remedy: "name their joints bar_joint_1 to bar_joint_5, one for each encoder of the bar's configuration, or assign them by \
             [[encoders]] joint = 1, column = \"...\" in a mapping file (--recording-mapping)",
    choose: "choose with topic = \"...\" in a mapping file (--recording-mapping)",
    record: "record the topic on which the encoders are published",
};

/// Reads the encoders of the bar from a bag.
pub(super) fn read(
    bytes: &[u8],
    path: &Path,
    bar: &BallBarConfig,
    format: LogFormat,
    mapping: Option<&BarLogMapping>,
) -> Result<OtherBarLog, LogError> {
    let bag = Bag::open(bytes, path, format)?;
    let topic = mapping.and_then(|mapping| mapping.topic.as_deref());
    let (topic, encoders) = bag.choose(path, topic, &WANTED, |found| encoders_among(found, bar, mapping))?;
    let wraps_at = BarLogMapping::wraps_at_of(mapping);
    let reading = |EncoderColumn { joint, column, unit, .. }: &EncoderColumn| {
        EncoderReader::new(*joint, unit.unwrap_or(EncoderUnit::Rad), wraps_at, bar, (path, column))
    };
    let readings = encoders.iter().map(reading).collect::<Result<Vec<EncoderReader>, LogError>>()?;
    let stamped = topic.is_stamped();
    let kind = BarLogKind {
        name: "ROS 2 bag with JointState",
        row: "message",
        has_validity: false,
        has_origins: false,
        is_dated: true,
    };
    let mut raw = RawBarLog::new(path, kind, readings.clone());
    bag.remarks.iter().for_each(|remark| raw.remark(remark));
    if !stamped {
        raw.remark(UNSTAMPED);
    }
    for message in &topic.messages {
        let state = &message.state;
        let mut row = RawBarRow {
            place: message.number,
            stamp_ns: message.stamp_ns(stamped),
            valid: [true; MAX_ENCODERS],
            ..RawBarRow::default()
        };
        let mut is_of_bar = false;
        for (count, (encoder, reading)) in row.counts.iter_mut().zip(encoders.iter().zip(&readings)) {
            let place = state.names.iter().position(|name| *name == encoder.column);
            is_of_bar |= place.is_some();
            let value = place.and_then(|place| state.position.get(place)).copied();
            *count = value.and_then(|value| count_of(value, reading));
        }
        // A message without any joint of the bar is from another publisher on the same topic.
        if is_of_bar {
            raw.push(row)?;
        }
    }
    let clock = mapping.and_then(|mapping| mapping.clock.clone());
    raw.finish(clock.unwrap_or_else(|| clock_name(stamped).into()))
}

/// Converts the position of a joint, which is a count or an angle, to a count. `None` if the position is invalid, such as
/// NaN, which drivers publish for a missing value.
fn count_of(value: f64, reading: &EncoderReader) -> Option<i64> {
    /// Largest number up to which an `f64` represents all whole numbers.
    const EXACT: f64 = 9_007_199_254_740_992.0;
    if reading.is_counts() {
        return (value.fract() == 0.0 && value.abs() <= EXACT).then_some(value as i64);
    }
    reading.count_of_angle(value)
}

/// The encoders in the order of the mapping, or without a mapping in the order of the bar's configuration. `None` if one of
/// the encoders is not among the joints `found`.
fn encoders_among(
    found: &[&str],
    bar: &BallBarConfig,
    mapping: Option<&BarLogMapping>,
) -> Option<Vec<EncoderColumn>> {
    let is_found = |encoder: &EncoderColumn| found.contains(&encoder.column.as_str());
    if let Some(mapping) = mapping {
        return Some(mapping.encoders.clone()).filter(|encoders| encoders.iter().all(is_found));
    }
    let prefixes = found.iter().flat_map(|name| {
        (1..=BAR_JOINTS).filter_map(move |joint| name.strip_suffix(&format!("{USUAL}{joint}")))
    });
    let mut prefixes: Vec<&str> = prefixes.collect();
    prefixes.sort_unstable();
    prefixes.dedup();
    // If a topic contains two bars, a mapping must name the joints of one of them.
    let [prefix] = prefixes[..] else { return None };
    let column = |joint: u8| format!("{prefix}{USUAL}{joint}");
    let encoder = |joint: u8| EncoderColumn { joint, column: column(joint), ..EncoderColumn::default() };
    let encoders = bar.encoders.iter().map(|configured| encoder(configured.joint));
    encoders.map(|encoder| Some(encoder).filter(is_found)).collect()
}
