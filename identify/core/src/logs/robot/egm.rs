//! Reads logs of ABB Externally Guided Motion. The controller sends `EgmRobot` messages over UDP. The file contains these
//! messages in protobuf's delimited form: before each message is its length, as a varint.
//!
//! The fields are those of ABB's public `egm.proto` (proto2, package `abb.egm`), without fields that are not used. Joints
//! are in degrees. The times of `feedBack` and `planned` are UTC since RobotWare 6.07. Older controllers only set
//! `header.tm`, which counts milliseconds of the controller's own clock and wraps after 49 days.

use std::path::Path;

use prost::Message;
use shared::config::RobotConfig;

use super::mapping::RobotLogMapping;
use super::raw::{Meaning, RawLog, RawRobotRow};
use crate::kinematics::Joints;
use crate::logs::{LogError, LogFormat, RobotLog, ValueOrigin};

#[derive(Clone, PartialEq, Message)]
struct EgmHeader {
    #[prost(uint32, optional, tag = "1")]
    seqno: Option<u32>,
    #[prost(uint32, optional, tag = "2")]
    tm: Option<u32>,
}

#[derive(Clone, PartialEq, Message)]
struct EgmJoints {
    #[prost(double, repeated, packed = "false", tag = "1")]
    joints: Vec<f64>,
}

#[derive(Clone, Copy, PartialEq, Message)]
struct EgmClock {
    #[prost(uint64, required, tag = "1")]
    sec: u64,
    #[prost(uint64, required, tag = "2")]
    usec: u64,
}

/// `EgmFeedBack` or `EgmPlanned`, which have the same fields.
#[derive(Clone, PartialEq, Message)]
struct EgmPosition {
    #[prost(message, optional, tag = "1")]
    joints: Option<EgmJoints>,
    #[prost(message, optional, tag = "4")]
    time: Option<EgmClock>,
}

#[derive(Clone, PartialEq, Message)]
struct EgmRobot {
    #[prost(message, optional, tag = "1")]
    header: Option<EgmHeader>,
    #[prost(message, optional, tag = "2")]
    feed_back: Option<EgmPosition>,
    #[prost(message, optional, tag = "3")]
    planned: Option<EgmPosition>,
}

impl EgmRobot {
    /// The planned position for commanded values, otherwise the feedback.
    fn position(&self, origin: Option<ValueOrigin>) -> Option<&EgmPosition> {
        if origin == Some(ValueOrigin::Commanded) { self.planned.as_ref() } else { self.feed_back.as_ref() }
    }
}

impl EgmPosition {
    /// Time of the position \[ns since 1970\]; `None` if the controller did not set it.
    fn utc_ns(&self) -> Option<i64> {
        let EgmClock { sec, usec } = self.time.filter(|time| time.sec > 0)?;
        i64::try_from(sec)
            .ok()?
            .checked_mul(1_000_000_000)?
            .checked_add(i64::try_from(usec).ok()?.checked_mul(1000)?)
    }
}

/// Reads a file of EGM messages. `mapping` may select commanded values.
pub(in crate::logs) fn read(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    mapping: Option<&RobotLogMapping>,
) -> Result<RobotLog, LogError> {
    let messages = decode(bytes, path)?;
    let names = (1..=robot.axes()).map(|joint| format!("joint {joint}")).collect();
    let meaning = Meaning::of_degrees(robot, mapping, names, LogFormat::Egm, path)?;
    let origin = mapping.and_then(|mapping| mapping.values);
    let utc: Option<Vec<i64>> = messages.iter().map(|message| message.position(origin)?.utc_ns()).collect();
    let clock = if utc.is_some() { "controller, UTC" } else { "controller, ms of its own" };
    let mut raw = RawLog::measured(path, "message", mapping, clock);
    raw.remark_unused_force(mapping);
    let stamps_ns = match utc {
        Some(stamps_ns) => stamps_ns,
        None => controller_stamps(&messages, path)?,
    };
    for ((message, stamp_ns), number) in messages.iter().zip(stamps_ns).zip(1..) {
        let joints = message.position(origin).and_then(|position| position.joints.as_ref());
        let values = joints.map_or(&[][..], |joints| &joints.joints);
        let value = |joint: usize| values.get(joint).copied().unwrap_or(f64::NAN);
        let joints = Joints::from_fn(robot.axes(), value);
        raw.push(RawRobotRow { place: number, stamp_ns, joints, ..RawRobotRow::default() }, &meaning)?;
    }
    raw.finish(&meaning)
}

/// Decodes all messages of a file.
fn decode(bytes: &[u8], path: &Path) -> Result<Vec<EgmRobot>, LogError> {
    let mut rest = bytes;
    let mut messages = Vec::new();
    while !rest.is_empty() {
        let offset = bytes.len() - rest.len();
        let message = EgmRobot::decode_length_delimited(&mut rest).map_err(|error| {
            let place = format!("message {} (byte {offset})", messages.len() + 1);
            let remedy =
                "write each EgmRobot message after its length as a varint; remove an incomplete last one";
            LogError::bad_record(path, place, error.to_string(), remedy)
        })?;
        messages.push(message);
    }
    Ok(messages)
}

/// Stamps \[ns\] from the controller's milliseconds in `header.tm`, continued when this counter wraps.
fn controller_stamps(messages: &[EgmRobot], path: &Path) -> Result<Vec<i64>, LogError> {
    let mut unwrapped_ms = 0i64;
    let mut last: Option<u32> = None;
    let mut stamps_ns = Vec::with_capacity(messages.len());
    for (message, number) in messages.iter().zip(1u64..) {
        let tm = message.header.as_ref().and_then(|header| header.tm).ok_or_else(|| {
            let problem = "it has neither feedBack.time nor header.tm".into();
            let remedy =
                "a log without time stamps cannot be used; record the controller's messages unchanged";
            LogError::bad_record(path, format!("message {number}"), problem, remedy)
        })?;
        unwrapped_ms += last.map_or(i64::from(tm), |last| i64::from(tm.wrapping_sub(last) as i32));
        last = Some(tm);
        stamps_ns.push(unwrapped_ms.saturating_mul(1_000_000));
    }
    Ok(stamps_ns)
}
