//! Reads ROS 2 bags in MCAP files. Bags of a recorder that was killed are read up to the place where they are incomplete.

use std::collections::HashMap;
use std::path::Path;

use mcap::McapError;
use mcap::records::{Record, SchemaHeader};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use shared::recording::{parse_record, up_to_broken_chunk};

use super::bag::Bag;
use crate::logs::LogError;

/// Longest valid record of a bag, in bytes. It is far longer than the chunks that recorders write, and far shorter than memory.
const RECORD_BYTES_MAX: usize = 256 << 20;

/// Reads the joint states of a bag. A damaged or incomplete bag is read up to the damage, with a remark.
pub(super) fn read(bytes: &[u8], path: &Path) -> Result<Bag, LogError> {
    let mut bag = Bag::default();
    let mut channels = JointStateChannels::default();
    let options = LinearReaderOptions::default()
        .with_record_length_limit(RECORD_BYTES_MAX)
        .with_prevalidate_chunk_crcs(true);
    let mut reader = LinearReader::new_with_options(options);
    // The library would continue to read after a broken chunk, so it only receives the bytes before this chunk.
    let mut source = up_to_broken_chunk(bytes);
    while let Some(event) = reader.next_event() {
        let record = match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let wanted = wanted.min(source.len());
                let (taken, rest) = source.split_at(wanted);
                reader.insert(wanted).copy_from_slice(taken);
                reader.notify_read(wanted);
                source = rest;
                continue;
            }
            Ok(LinearReadEvent::Record { data, opcode }) => parse_record(opcode, data),
            Err(error) => Err(error),
        };
        match record {
            Ok(record) => channels.take(record, &mut bag, path)?,
            Err(error) => {
                broken_off(&mut bag, &error, path)?;
                break;
            }
        }
    }
    Ok(bag)
}

/// Adds a remark that the bag is damaged or incomplete after the messages that were read. This is an error if no joint
/// state was read before.
fn broken_off(bag: &mut Bag, error: &McapError, path: &Path) -> Result<(), LogError> {
    let messages: usize = bag.topics.iter().map(|topic| topic.messages.len()).sum();
    if messages == 0 {
        let problem = format!("not a whole MCAP file: {error}");
        let remedy = "if the recorder was killed, try `mcap recover` on it";
        return Err(LogError::content(path, problem, remedy));
    }
    bag.remarks.push(format!(
        "the bag is damaged after {messages} joint states ({error}); what follows is not read"
    ));
    Ok(())
}

/// The channels of a bag that contain joint states.
#[derive(Default)]
struct JointStateChannels {
    /// Ids of the schemas with the name of a joint state.
    joint_state_schemas: Vec<u16>,
    /// Topic of each channel with joint states, by the id of the channel.
    topics: HashMap<u16, String>,
}

impl JointStateChannels {
    /// Processes the next record: registers schemas and channels, and adds messages with joint states to the `bag`.
    fn take(&mut self, record: Record<'_>, bag: &mut Bag, path: &Path) -> Result<(), LogError> {
        match record {
            Record::Schema { header: SchemaHeader { id, name, .. }, .. } if is_joint_state(&name) => {
                self.joint_state_schemas.push(id);
            }
            Record::Channel(channel)
                if self.joint_state_schemas.contains(&channel.schema_id)
                    && channel.message_encoding == "cdr" =>
            {
                self.topics.insert(channel.id, channel.topic);
            }
            Record::Message { header, data } => {
                if let Some(topic) = self.topics.get(&header.channel_id) {
                    let recorded_ns = i64::try_from(header.log_time).unwrap_or(i64::MAX);
                    bag.topic(topic).push(recorded_ns, &data, path)?;
                }
            }
            _ => {}
        }
        Ok(())
    }
}

fn is_joint_state(schema: &str) -> bool {
    ["sensor_msgs/msg/JointState", "sensor_msgs/JointState"].contains(&schema)
}
