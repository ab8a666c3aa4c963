//! One `sensor_msgs/JointState` from its CDR bytes.

use std::rc::Rc;

use byteorder::{BigEndian, LittleEndian};
use serde::Deserialize;

#[derive(Deserialize)]
struct RosTime {
    sec: i32,
    nanosec: u32,
}

#[derive(Deserialize)]
struct RosHeader {
    stamp: RosTime,
    #[allow(dead_code, reason = "lies between the fields that are used")]
    frame_id: String,
}

/// Fields in the order of the message definition.
#[derive(Deserialize)]
struct CdrJointState {
    header: RosHeader,
    name: Vec<String>,
    position: Vec<f64>,
    velocity: Vec<f64>,
    effort: Vec<f64>,
}

/// What is used of a message.
pub(in crate::logs) struct RosJointState {
    /// `header.stamp`, 0 where it was not set \[ns\].
    pub stamp_ns: i64,
    /// Shared with the message before where they are the same.
    pub names: Rc<[String]>,
    pub position: Vec<f64>,
    pub velocity: Vec<f64>,
    pub effort: Vec<f64>,
}

impl RosJointState {
    /// Decodes a message; the error is what is wrong, in words.
    pub fn decode(bytes: &[u8], names_before: Option<&Rc<[String]>>) -> Result<Self, String> {
        // The second of the four bytes before the message states how it is encoded.
        let Some((&[_, encoding, _, _], body)) = bytes.split_first_chunk::<4>() else {
            return Err(format!("{} bytes are too short for a message", bytes.len()));
        };
        let message: CdrJointState = match encoding {
            0 => cdr_encoding::from_bytes::<CdrJointState, BigEndian>(body),
            1 => cdr_encoding::from_bytes::<CdrJointState, LittleEndian>(body),
            other => return Err(format!("encoding {other} is not plain CDR")),
        }
        .map_err(|error| format!("not a whole JointState ({error})"))?
        .0;
        let RosTime { sec, nanosec } = message.header.stamp;
        let names = match names_before {
            Some(before) if **before == *message.name => Rc::clone(before),
            _ => message.name.into(),
        };
        Ok(Self {
            stamp_ns: i64::from(sec) * 1_000_000_000 + i64::from(nanosec),
            names,
            position: message.position,
            velocity: message.velocity,
            effort: message.effort,
        })
    }
}
