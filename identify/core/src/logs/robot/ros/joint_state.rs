//! Decodes a `sensor_msgs/JointState` message from its CDR bytes.

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

/// The fields of a message that are used.
pub(in crate::logs) struct RosJointState {
    /// `header.stamp` \[ns\]; 0 if the publisher did not set it.
    pub stamp_ns: i64,
    /// Names of the joints. If they are equal to those of the message before, both messages share the memory.
    pub names: Rc<[String]>,
    pub position: Vec<f64>,
    pub velocity: Vec<f64>,
    pub effort: Vec<f64>,
}

impl RosJointState {
    /// Decodes a message. `names_before` are the names of the message before, if there is one. The error is a
    /// description of the problem.
    pub fn decode(bytes: &[u8], names_before: Option<&Rc<[String]>>) -> Result<Self, String> {
        // A message begins with four bytes, of which the second determines the encoding.
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
