//! Generates ROS 2 bags with joint states as seeds. Messages are not compressed, so that the
//! fuzzer can change their content.

use std::collections::BTreeMap;
use std::io::Cursor;

use mcap::records::MessageHeader;

const TYPE: &str = "sensor_msgs/msg/JointState";

/// A bag of 52 messages at 125 Hz on one topic. Every joint has a position, a speed and an effort.
pub fn bag(names: &[&str]) -> Vec<u8> {
    let mut writer = mcap::WriteOptions::new()
        .profile("ros2")
        .use_chunks(false)
        .create(Cursor::new(Vec::new()))
        .expect("a sink in memory");
    let schema = writer.add_schema(TYPE, "ros2msg", b"string[] name").expect("schema");
    let channel_id = writer.add_channel(schema, "/joint_states", "cdr", &BTreeMap::new()).expect("channel");
    for row in 0..52_u32 {
        let header = MessageHeader {
            channel_id,
            sequence: row,
            log_time: u64::from(row),
            publish_time: u64::from(row),
        };
        writer.write_to_known_channel(&header, &message(names, row)).expect("message");
    }
    writer.finish().expect("summary");
    writer.into_inner().into_inner()
}

/// A message in little-endian CDR. Each number is aligned to its own size. Alignment is counted from the end of
/// the header of four bytes.
fn message(names: &[&str], row: u32) -> Vec<u8> {
    let mut body = Vec::new();
    body.extend(1_795_000_000_u32.to_le_bytes());
    body.extend((8_000_000 * row).to_le_bytes());
    string(&mut body, "base");
    count(&mut body, names.len());
    names.iter().for_each(|name| string(&mut body, name));
    for factor in [0.3, 0.1, 20.0] {
        count(&mut body, names.len());
        align(&mut body, 8);
        for joint in 0..names.len() {
            body.extend((factor * (0.1 * f64::from(row) + joint as f64).sin()).to_le_bytes());
        }
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

fn align(body: &mut Vec<u8>, size: usize) {
    body.resize(body.len().next_multiple_of(size), 0);
}

fn count(body: &mut Vec<u8>, count: usize) {
    align(body, 4);
    body.extend((count as u32).to_le_bytes());
}

fn string(body: &mut Vec<u8>, text: &str) {
    count(body, text.len() + 1);
    body.extend(text.as_bytes());
    body.push(0);
}
