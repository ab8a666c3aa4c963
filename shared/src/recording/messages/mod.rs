//! Encodes and decodes the messages of a recording. Values are encoded in CDR, types are defined
//! in the schema language ros2msg.
//!
//! CDR is OMG XCDR1 in little endian, after an encapsulation header of 4 bytes. The texts of the schemas follow the
//! definition of "ros2msg" in the MCAP registry.

use byteorder::LittleEndian;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::schema::{CycleRecord, EncoderSample, Event, EventKind, MAX_ENCODERS};
use crate::time::{DcNs, MonoNs, NS_PER_S, UtcNs};

/// Encapsulation header of plain little-endian CDR.
const CDR_LITTLE_ENDIAN: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// A topic of the recording. Its messages are in CDR.
#[derive(Debug, PartialEq, Eq)]
pub struct Topic {
    /// Name of the topic in MCAP.
    pub topic: &'static str,
    /// Name of the message type in ROS 2.
    pub schema_name: &'static str,
    /// Definition of the type, and of the types that it contains, in ros2msg.
    pub schema_text: &'static str,
}

/// All topics of a recording.
pub static TOPICS: [&Topic; 5] = [&CYCLE, &EVENT, &JOINT_STATE, &LOG, &DIAGNOSTICS];

pub(super) static CYCLE: Topic = Topic {
    topic: "/ballbard/cycle",
    schema_name: "ballbard_msgs/msg/BusCycle",
    schema_text: include_str!("bus_cycle.ros2msg"),
};

pub(super) static EVENT: Topic = Topic {
    topic: "/ballbard/event",
    schema_name: "ballbard_msgs/msg/Event",
    schema_text: include_str!("event.ros2msg"),
};

pub(super) static JOINT_STATE: Topic = Topic {
    topic: "/ballbard/joint_states",
    schema_name: "sensor_msgs/msg/JointState",
    schema_text: include_str!("joint_state.ros2msg"),
};

pub(super) static LOG: Topic = Topic {
    topic: "/ballbard/log",
    schema_name: "rcl_interfaces/msg/Log",
    schema_text: include_str!("log.ros2msg"),
};

/// The diagnostics, on the topic that other ROS programs expect.
pub(super) static DIAGNOSTICS: Topic = Topic {
    topic: "/diagnostics",
    schema_name: "diagnostic_msgs/msg/DiagnosticArray",
    schema_text: include_str!("diagnostic_array.ros2msg"),
};

/// Coordinate frame in the headers of the messages: the base of the bar.
const FRAME_ID: &str = "ball_bar_base";

/// Why bytes cannot be decoded as a message of their topic.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// The bytes do not begin with the header of little-endian CDR.
    #[error("not little-endian CDR")]
    Encapsulation,
    /// The bytes end too early, continue after the message, or contain an invalid value.
    #[error("not a whole message of this type: {0}")]
    Content(String),
}

/// `builtin_interfaces/Time`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct Time {
    sec: i32,
    nanosec: u32,
}

impl From<UtcNs> for Time {
    fn from(time: UtcNs) -> Self {
        let sec = time.0.div_euclid(NS_PER_S);
        Self {
            sec: sec.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32,
            nanosec: time.0.rem_euclid(NS_PER_S) as u32,
        }
    }
}

impl Time {
    fn to_utc(self) -> UtcNs {
        UtcNs(i64::from(self.sec) * NS_PER_S + i64::from(self.nanosec))
    }
}

/// `std_msgs/Header`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Header {
    stamp: Time,
    frame_id: String,
}

impl Header {
    fn new(time: UtcNs) -> Self {
        Self { stamp: time.into(), frame_id: FRAME_ID.to_owned() }
    }
}

/// `ballbard_msgs/BusCycle`. The type `Origin` is `u32`, or [`Absent`] in files of older programs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct CycleMessage<Origin> {
    header: Header,
    cycle: u64,
    dc_time_ns: i64,
    send_monotonic_ns: i64,
    receive_monotonic_ns: i64,
    sample_time_uncertainty_ns: u32,
    flags: u32,
    origin: Origin,
    working_counter: u16,
    working_counter_expected: u16,
    encoders: Vec<EncoderSample>,
}

/// Represents a field that messages of older programs do not have. It takes no bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Absent;

impl From<Absent> for u32 {
    fn from(_: Absent) -> Self {
        0
    }
}

impl From<Absent> for String {
    fn from(_: Absent) -> Self {
        Self::new()
    }
}

/// How the cycles of a file mark a new origin of the counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CycleLayout {
    /// Only the first record of a new origin has a flag. If that record is lost, the origin of later records is unknown.
    OriginFlag,
    /// Each record contains the number of its origin.
    OriginNumber,
}

impl CycleLayout {
    /// Determines the layout from the schema in the file.
    pub fn of_schema(text: &[u8]) -> Self {
        const FIELD: &[u8] = b"uint32 origin ";
        if text.windows(FIELD.len()).any(|window| window == FIELD) {
            Self::OriginNumber
        } else {
            Self::OriginFlag
        }
    }
}

/// `ballbard_msgs/Event`. The type `Code` is `String`, or [`Absent`] for files of older programs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct EventMessage<Code> {
    header: Header,
    cycle: u64,
    kind: u8,
    text: String,
    code: Code,
}

/// `rcl_interfaces/Log`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct LogMessage {
    stamp: Time,
    level: u8,
    name: String,
    msg: String,
    file: String,
    function: String,
    line: u32,
}

/// `diagnostic_msgs/DiagnosticArray`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct DiagnosticsMessage {
    header: Header,
    status: Vec<DiagnosticStatus>,
}

/// `diagnostic_msgs/DiagnosticStatus`: state of one component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct DiagnosticStatus {
    /// 0 for OK, 1 for a warning, 2 for an error.
    pub level: u8,
    pub name: String,
    pub message: String,
    pub hardware_id: String,
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/KeyValue`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct KeyValue {
    pub key: String,
    pub value: String,
}

/// `sensor_msgs/JointState`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct JointStateMessage {
    header: Header,
    name: Vec<String>,
    position: Vec<f64>,
    velocity: Vec<f64>,
    effort: Vec<f64>,
}

fn to_cdr<T: Serialize>(message: &T) -> Result<Vec<u8>, MessageError> {
    let mut bytes = CDR_LITTLE_ENDIAN.to_vec();
    cdr_encoding::to_writer::<T, LittleEndian, _>(&mut bytes, message)
        .map_err(|error| MessageError::Content(error.to_string()))?;
    Ok(bytes)
}

fn from_cdr<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, MessageError> {
    let body = bytes.strip_prefix(&CDR_LITTLE_ENDIAN).ok_or(MessageError::Encapsulation)?;
    let (message, used) = cdr_encoding::from_bytes::<T, LittleEndian>(body)
        .map_err(|error| MessageError::Content(error.to_string()))?;
    if used == body.len() {
        Ok(message)
    } else {
        Err(MessageError::Content(format!("{} bytes are left over", body.len() - used)))
    }
}

/// Encodes a bus cycle in CDR.
pub(super) fn encode_cycle(record: &CycleRecord) -> Result<Vec<u8>, MessageError> {
    to_cdr(&CycleMessage {
        header: Header::new(record.sample_time),
        cycle: record.cycle,
        dc_time_ns: record.dc_time.0,
        send_monotonic_ns: record.send_time.0,
        receive_monotonic_ns: record.receive_time.0,
        sample_time_uncertainty_ns: record.sample_time_uncertainty_ns,
        flags: record.flags,
        origin: record.origin,
        working_counter: record.working_counter,
        working_counter_expected: record.working_counter_expected,
        encoders: record.encoders().to_vec(),
    })
}

/// Decodes a bus cycle from CDR. If the file has no origin numbers, the origin is 0.
pub(super) fn decode_cycle(bytes: &[u8], layout: CycleLayout) -> Result<CycleRecord, MessageError> {
    match layout {
        CycleLayout::OriginNumber => cycle_record(from_cdr::<CycleMessage<u32>>(bytes)?),
        CycleLayout::OriginFlag => cycle_record(from_cdr::<CycleMessage<Absent>>(bytes)?),
    }
}

fn cycle_record<Origin: Into<u32>>(message: CycleMessage<Origin>) -> Result<CycleRecord, MessageError> {
    let count = message.encoders.len();
    let mut encoders = [EncoderSample::default(); MAX_ENCODERS];
    let used = encoders.get_mut(..count).ok_or_else(|| {
        MessageError::Content(format!("{count} encoders, a bar has at most {MAX_ENCODERS}"))
    })?;
    used.copy_from_slice(&message.encoders);
    Ok(CycleRecord {
        cycle: message.cycle,
        sample_time: message.header.stamp.to_utc(),
        sample_time_uncertainty_ns: message.sample_time_uncertainty_ns,
        dc_time: DcNs(message.dc_time_ns),
        send_time: MonoNs(message.send_monotonic_ns),
        receive_time: MonoNs(message.receive_monotonic_ns),
        working_counter: message.working_counter,
        working_counter_expected: message.working_counter_expected,
        flags: message.flags,
        origin: message.origin.into(),
        encoder_count: count as u8,
        encoders,
    })
}

/// Encodes an event in CDR.
pub(super) fn encode_event(event: &Event) -> Result<Vec<u8>, MessageError> {
    to_cdr(&EventMessage {
        header: Header::new(event.time),
        cycle: event.cycle,
        kind: event.kind as u8,
        text: event.text.clone(),
        code: event.code.clone(),
    })
}

/// Decodes an event from CDR, with or without a code. Both types cannot match the same bytes, because
/// all bytes must be used.
pub(super) fn decode_event(bytes: &[u8]) -> Result<Event, MessageError> {
    from_cdr::<EventMessage<String>>(bytes)
        .and_then(event)
        .or_else(|error| from_cdr::<EventMessage<Absent>>(bytes).map_err(|_| error).and_then(event))
}

fn event<Code: Into<String>>(message: EventMessage<Code>) -> Result<Event, MessageError> {
    let EventMessage { header, cycle, kind, text, code } = message;
    let kind = EventKind::from_u8(kind)
        .ok_or_else(|| MessageError::Content(format!("event of unknown kind {kind}")))?;
    Ok(Event { time: header.stamp.to_utc(), cycle, kind, text, code: code.into() })
}

/// Encodes joint angles for plotting, one element for each encoder: name, position \[rad\] and velocity \[rad/s\]. Unknown
/// positions and velocities are NaN; viewers show a gap for them.
pub(super) fn encode_joint_state(
    time: UtcNs,
    names: &[String],
    position_rad: Vec<f64>,
    velocity_rad_s: Vec<f64>,
) -> Result<Vec<u8>, MessageError> {
    to_cdr(&JointStateMessage {
        header: Header::new(time),
        name: names.to_vec(),
        position: position_rad,
        velocity: velocity_rad_s,
        effort: Vec::new(),
    })
}

/// Encodes an event as a line of a log.
pub(super) fn encode_log(event: &Event) -> Result<Vec<u8>, MessageError> {
    const INFO: u8 = 20;
    const WARN: u8 = 30;
    let (level, kind) = match event.kind {
        EventKind::Marker => (INFO, "marker"),
        EventKind::Gap => (WARN, "gap"),
        EventKind::Bus => (WARN, "bus"),
        EventKind::Clock => (WARN, "clock"),
        EventKind::Disk => (WARN, "disk"),
    };
    let function = if event.code.is_empty() { kind } else { &event.code };
    to_cdr(&LogMessage {
        stamp: event.time.into(),
        level,
        name: "ballbard".into(),
        msg: event.text.clone(),
        file: String::new(),
        function: function.into(),
        line: 0,
    })
}

/// Encodes the diagnostics of the second before `time`.
pub(super) fn encode_diagnostics(
    time: UtcNs,
    status: Vec<DiagnosticStatus>,
) -> Result<Vec<u8>, MessageError> {
    to_cdr(&DiagnosticsMessage { header: Header::new(time), status })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const NUMBER: CycleLayout = CycleLayout::OriginNumber;

    prop_compose! {
        fn any_cycle()(
            cycle in any::<u64>(),
            seconds in i64::from(i32::MIN)..i64::from(i32::MAX),
            nanoseconds in 0..NS_PER_S,
            times in any::<[i64; 3]>(),
            words in any::<(u32, u32, u32, u16, u16)>(),
            samples in prop::collection::vec(any::<(u8, u32, u32, u16, bool)>(), 0..=MAX_ENCODERS),
        ) -> CycleRecord {
            let mut encoders = [EncoderSample::default(); MAX_ENCODERS];
            for (encoder, &(joint, count, latch, status, valid)) in encoders.iter_mut().zip(&samples) {
                *encoder = EncoderSample { joint, count, latch, status, valid };
            }
            CycleRecord {
                cycle,
                sample_time: UtcNs(seconds * NS_PER_S + nanoseconds),
                sample_time_uncertainty_ns: words.0,
                dc_time: DcNs(times[0]),
                send_time: MonoNs(times[1]),
                receive_time: MonoNs(times[2]),
                working_counter: words.3,
                working_counter_expected: words.4,
                flags: words.1,
                origin: words.2,
                encoder_count: samples.len() as u8,
                encoders,
            }
        }
    }

    proptest! {
        #[test]
        fn a_cycle_survives_the_file(record in any_cycle()) {
            prop_assert_eq!(decode_cycle(&encode_cycle(&record).unwrap(), NUMBER), Ok(record));
        }

        #[test]
        fn a_cut_cycle_is_refused(record in any_cycle(), cut in any::<prop::sample::Index>()) {
            let bytes = encode_cycle(&record).unwrap();
            prop_assert!(decode_cycle(&bytes[..cut.index(bytes.len())], NUMBER).is_err());
        }

        #[test]
        fn any_bytes_are_decoded_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let framed = [&CDR_LITTLE_ENDIAN[..], &bytes].concat();
            let _ = decode_cycle(&framed, NUMBER);
            let _ = decode_cycle(&framed, CycleLayout::OriginFlag);
            let _ = decode_event(&framed);
        }

        #[test]
        fn an_event_survives_the_file_with_its_code_and_one_of_an_older_file_has_none(
            cycle in any::<u64>(),
            seconds in i64::from(i32::MIN)..i64::from(i32::MAX),
            text in any::<String>(),
            code in "[a-z_]*",
        ) {
            // CDR ends a text with a zero byte.
            prop_assume!(!text.contains('\0'));
            let event = Event { time: UtcNs(seconds * NS_PER_S), cycle, kind: EventKind::Bus, text, code };
            prop_assert_eq!(decode_event(&encode_event(&event).unwrap()), Ok(event.clone()));
            let Event { time, cycle, kind, text, .. } = event;
            let older =
                EventMessage { header: Header::new(time), cycle, kind: kind as u8, text: text.clone(), code: Absent };
            let plain = Event { time, cycle, kind, text, code: String::new() };
            prop_assert_eq!(decode_event(&to_cdr(&older).unwrap()), Ok(plain));
        }
    }
}
