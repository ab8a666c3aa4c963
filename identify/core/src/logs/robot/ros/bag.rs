//! The joint states of a ROS 2 bag, grouped by topic. [`Bag::choose`] finds the topic of a robot or of the ball-bar by
//! the names of its joints.

use std::path::Path;
use std::rc::Rc;

use super::joint_state::RosJointState;
use super::{mcap_bag, sqlite_bag};
use crate::logs::{LogError, LogFormat};

/// Messages of one topic, in the order of the bag.
pub(in crate::logs) struct BagTopic {
    pub name: String,
    pub messages: Vec<RecordedJointState>,
}

/// A joint state, with its place in the bag and the time of its recording.
pub(in crate::logs) struct RecordedJointState {
    /// Number of the message within its topic, from 1.
    pub number: u64,
    /// Time at which the recorder received the message \[ns since 1970\].
    pub recorded_ns: i64,
    pub state: RosJointState,
}

/// The joint states of a bag, and remarks on its quality.
#[derive(Default)]
pub(in crate::logs) struct Bag {
    pub topics: Vec<BagTopic>,
    pub remarks: Vec<String>,
}

/// Texts of messages about the joints that are searched for in a bag.
pub(in crate::logs) struct Wanted {
    /// Description of the joints, such as `the six joints of one robot`.
    pub what: &'static str,
    /// What the user can do if no topic has these joints.
    pub remedy: &'static str,
    /// What the user can do if several topics have these joints.
    pub choose: &'static str,
    /// What the user can do if the bag, or the wanted topic, has no joint states.
    pub record: &'static str,
}

impl Bag {
    /// Reads the joint states of a bag.
    pub fn open(bytes: &[u8], path: &Path, format: LogFormat) -> Result<Self, LogError> {
        match format {
            LogFormat::Ros2Db3 => sqlite_bag::read(bytes, path),
            _ => mcap_bag::read(bytes, path),
        }
    }

    /// The topic with this name, which is added if it is new.
    pub(super) fn topic(&mut self, name: &str) -> &mut BagTopic {
        let index = self.topics.iter().position(|topic| topic.name == name).unwrap_or_else(|| {
            self.topics.push(BagTopic { name: name.to_owned(), messages: Vec::new() });
            self.topics.len() - 1
        });
        &mut self.topics[index]
    }

    /// Finds the only topic with the wanted joints. Returns the topic and the result of `names_of` for its joint names. If
    /// `topic` is given, only the topic with this name is searched.
    pub fn choose<N>(
        &self,
        path: &Path,
        topic: Option<&str>,
        wanted: &Wanted,
        names_of: impl Fn(&[&str]) -> Option<N>,
    ) -> Result<(&BagTopic, N), LogError> {
        let topics: Vec<&BagTopic> =
            self.topics.iter().filter(|found| topic.is_none_or(|topic| found.name == topic)).collect();
        let mut with_joints: Vec<(&BagTopic, N)> =
            topics.iter().filter_map(|topic| Some((*topic, names_of(&topic.joint_names())?))).collect();
        if with_joints.len() > 1 {
            let names: Vec<&str> = with_joints.iter().map(|(topic, _)| topic.name.as_str()).collect();
            let problem = format!("several topics have {}: {}", wanted.what, names.join(", "));
            return Err(LogError::content(path, problem, wanted.choose));
        }
        if let Some(the_only) = with_joints.pop() {
            return Ok(the_only);
        }
        if topics.is_empty() {
            let problem = match topic {
                Some(topic) => format!("no sensor_msgs/JointState on topic {topic}"),
                None => "no messages of type sensor_msgs/JointState".into(),
            };
            return Err(LogError::content(path, problem, wanted.record));
        }
        let found = topics.iter().map(|topic| format!("{}: {}", topic.name, topic.joint_names().join(", ")));
        let found: Vec<String> = found.collect();
        let problem = format!("no topic has {}; there are {}", wanted.what, found.join("; "));
        Err(LogError::content(path, problem, wanted.remedy))
    }
}

impl BagTopic {
    /// Decodes the bytes of the next message and adds it.
    pub(super) fn push(&mut self, recorded_ns: i64, data: &[u8], path: &Path) -> Result<(), LogError> {
        let number = self.messages.len() as u64 + 1;
        let names_before = self.messages.last().map(|last| &last.state.names);
        let state = RosJointState::decode(data, names_before).map_err(|problem| {
            let place = format!("message {number} on {}", self.name);
            let remedy = "the bag is damaged or its messages are not sensor_msgs/JointState; record it again";
            LogError::bad_record(path, place, problem, remedy)
        })?;
        self.messages.push(RecordedJointState { number, recorded_ns, state });
        Ok(())
    }

    /// Whether every message has a stamp by its publisher.
    pub fn is_stamped(&self) -> bool {
        self.messages.iter().all(|message| message.state.stamp_ns != 0)
    }

    /// The names of all joints in any message, in the order in which they occur first.
    fn joint_names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        let mut last: Option<&Rc<[String]>> = None;
        for message in &self.messages {
            if last.is_some_and(|last| Rc::ptr_eq(last, &message.state.names)) {
                continue;
            }
            last = Some(&message.state.names);
            for name in message.state.names.iter() {
                if !names.contains(&name.as_str()) {
                    names.push(name);
                }
            }
        }
        names
    }
}

impl RecordedJointState {
    /// The stamp of the message \[ns\]: the publisher's stamp if the topic is `stamped` ([`BagTopic::is_stamped`]),
    /// otherwise the time at which the recorder received the message.
    pub fn stamp_ns(&self, stamped: bool) -> i64 {
        if stamped { self.state.stamp_ns } else { self.recorded_ns }
    }
}

/// Name of the clock of a topic's stamps.
pub(in crate::logs) const fn clock_name(stamped: bool) -> &'static str {
    if stamped { "header.stamp" } else { "receive time of the recorder" }
}

/// Remark on messages without stamps.
pub(in crate::logs) const UNSTAMPED: &str =
    "messages without header.stamp: the time of their reception jitters";
