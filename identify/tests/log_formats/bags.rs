//! Generates small ROS 2 bags with joint states. Tests of the workspace read bags of other programs.

use std::collections::BTreeMap;
use std::io::Cursor;

use mcap::records::MessageHeader;
use rusqlite::{Connection, MAIN_DB};

/// One message with topic, stamp, names and positions.
pub struct JointState {
    pub topic: &'static str,
    pub stamp_ns: i64,
    pub names: Vec<String>,
    pub position: Vec<f64>,
}

impl JointState {
    /// The message in little-endian CDR. Each number is aligned to its size, counted from the end of the header.
    fn cdr(&self) -> Vec<u8> {
        let mut body = Vec::new();
        body.extend(((self.stamp_ns / 1_000_000_000) as i32).to_le_bytes());
        body.extend(((self.stamp_ns % 1_000_000_000) as u32).to_le_bytes());
        string(&mut body, "");
        align(&mut body, 4);
        body.extend((self.names.len() as u32).to_le_bytes());
        self.names.iter().for_each(|name| string(&mut body, name));
        for values in [&self.position[..], &[], &[]] {
            align(&mut body, 4);
            body.extend((values.len() as u32).to_le_bytes());
            if !values.is_empty() {
                align(&mut body, 8);
            }
            values.iter().for_each(|value| body.extend(value.to_le_bytes()));
        }
        [&[0, 1, 0, 0], &body[..]].concat()
    }
}

fn align(body: &mut Vec<u8>, size: usize) {
    body.resize(body.len().next_multiple_of(size), 0);
}

fn string(body: &mut Vec<u8>, text: &str) {
    align(body, 4);
    body.extend((text.len() as u32 + 1).to_le_bytes());
    body.extend(text.as_bytes());
    body.push(0);
}

const TYPE: &str = "sensor_msgs/msg/JointState";

pub fn mcap(messages: &[JointState]) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut writer = mcap::Writer::new(&mut file).unwrap();
    let schema = writer.add_schema(TYPE, "ros2msg", b"string[] name").unwrap();
    let mut channels = BTreeMap::new();
    for message in messages {
        let channel_id = *channels
            .entry(message.topic)
            .or_insert_with(|| writer.add_channel(schema, message.topic, "cdr", &BTreeMap::new()).unwrap());
        let time = message.stamp_ns as u64;
        let header = MessageHeader { channel_id, sequence: 0, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, &message.cdr()).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    file.into_inner()
}

pub fn db3(messages: &[JointState]) -> Vec<u8> {
    let connection = Connection::open_in_memory().unwrap();
    connection
        .execute_batch(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);",
        )
        .unwrap();
    let mut topics: Vec<&str> = messages.iter().map(|message| message.topic).collect();
    topics.sort_unstable();
    topics.dedup();
    for (id, topic) in topics.iter().enumerate() {
        let insert = "INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr')";
        connection.execute(insert, (id as i64, topic, TYPE)).unwrap();
    }
    for message in messages {
        let id = topics.iter().position(|topic| *topic == message.topic).unwrap() as i64;
        let insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
        connection.execute(insert, (id, message.stamp_ns, message.cdr())).unwrap();
    }
    connection.serialize(MAIN_DB).unwrap().to_vec()
}
