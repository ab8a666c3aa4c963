//! ROS 2 bags with `sensor_msgs/JointState`: joints are found by name, whatever their order and whoever else is in it.
//!
//! A bag has two times: when the recorder received a message, and `header.stamp`, which the publisher set (with
//! ros2_control the time of the controller manager, not that of the encoders). The stamp is taken where every message has
//! one; which it was is the name of the log's clock.

mod joint_state;
mod mcap_bag;
mod sqlite_bag;

use std::path::Path;
use std::rc::Rc;

use shared::config::{AngleUnit, RobotConfig};

use super::mapping::RobotLogMapping;
use super::raw::{Meaning, RawLog, RawRow};
use super::{ForceKind, LogError, LogFormat, Origin, RobotLog};
use joint_state::JointState;

/// Names that drivers give the six joints, from base to flange; a prefix such as `left_` may stand before all six.
const FAMILIES: [[&str; 6]; 4] = [
    ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"],
    ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6"],
    ["joint_a1", "joint_a2", "joint_a3", "joint_a4", "joint_a5", "joint_a6"],
    [
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    ],
];

/// Messages of one topic, in the order of the bag.
struct Topic {
    name: String,
    messages: Vec<Message>,
}

/// A joint state and where and when it was recorded.
struct Message {
    /// Number within its topic, from 1.
    number: u64,
    recorded_ns: i64,
    state: JointState,
}

/// Joint states of a bag, and what is odd about the bag itself.
#[derive(Default)]
struct Bag {
    topics: Vec<Topic>,
    remarks: Vec<String>,
}

impl Bag {
    fn topic(&mut self, name: &str) -> &mut Topic {
        let index = self.topics.iter().position(|topic| topic.name == name).unwrap_or_else(|| {
            self.topics.push(Topic { name: name.to_owned(), messages: Vec::new() });
            self.topics.len() - 1
        });
        &mut self.topics[index]
    }
}

impl Topic {
    fn push(&mut self, recorded_ns: i64, data: &[u8], path: &Path) -> Result<(), LogError> {
        let number = self.messages.len() as u64 + 1;
        let state = JointState::decode(data, self.messages.last().map(|last| &last.state.names)).map_err(
            |problem| LogError::BadRecord {
                path: path.to_owned(),
                place: format!("message {number} on {}", self.name),
                problem,
                remedy: "the bag is damaged or its messages are not sensor_msgs/JointState; record it again",
            },
        )?;
        self.messages.push(Message { number, recorded_ns, state });
        Ok(())
    }

    /// Every joint that any message names, in the order of the first that does.
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

/// Reads a bag.
pub(super) fn read(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    format: LogFormat,
    mapping: Option<&RobotLogMapping>,
) -> Result<RobotLog, LogError> {
    let bag = match format {
        LogFormat::Ros2Db3 => sqlite_bag::read(bytes, path)?,
        _ => mcap_bag::read(bytes, path)?,
    };
    let (topic, names) = choose(&bag, path, mapping)?;
    let meaning = match mapping {
        Some(mapping) => Meaning::new(robot, &mapping.conversion(), names.clone())?,
        None => Meaning::of_controller(robot, AngleUnit::Rad, names.clone(), format, path)?,
    };
    let mut raw = RawLog::new(path, "message");
    let stamped = topic.messages.iter().all(|message| message.state.stamp_ns != 0);
    let clock = if stamped { "header.stamp" } else { "receive time of the recorder" };
    raw.clock = mapping.and_then(|mapping| mapping.clock.clone()).unwrap_or_else(|| clock.into());
    raw.origin = mapping.and_then(|mapping| mapping.values).unwrap_or(Origin::Measured);
    raw.remarks.clone_from(&bag.remarks);
    raw.force = mapping.and_then(|mapping| mapping.force.as_ref()).map(|_| ForceKind::JointTorques);
    if !stamped {
        raw.remarks.push("messages without header.stamp: the time of their reception jitters".into());
    }
    let to_rad = units(mapping);
    for message in &topic.messages {
        raw.push(row(message, &names, &to_rad, stamped))?;
    }
    raw.finish(&meaning)
}

/// What values of the joints are multiplied by: a mapping may say that they are degrees, against REP 103.
fn units(mapping: Option<&RobotLogMapping>) -> [f64; 6] {
    let mut to_rad = [1.0; 6];
    if let Some(mapping) = mapping {
        to_rad.iter_mut().zip(&mapping.joints).for_each(|(factor, joint)| *factor = joint.unit.to_rad());
    }
    to_rad
}

fn row(message: &Message, names: &[String; 6], to_rad: &[f64; 6], stamped: bool) -> RawRow {
    let state = &message.state;
    let place = names.each_ref().map(|name| state.names.iter().position(|other| other == name));
    let values = |of: &[f64]| -> [f64; 6] {
        std::array::from_fn(|joint| place[joint].and_then(|place| of.get(place)).copied().unwrap_or(f64::NAN))
    };
    let scaled = |of: &[f64]| {
        let values = values(of);
        std::array::from_fn(|joint| values[joint] * to_rad[joint])
    };
    let whole = |values: [f64; 6]| values.iter().all(|value| value.is_finite()).then_some(values);
    RawRow {
        place: message.number,
        stamp_ns: if stamped { state.stamp_ns } else { message.recorded_ns },
        joints: scaled(&state.position),
        speeds: whole(scaled(&state.velocity)),
        torques: whole(values(&state.effort)),
        force: None,
    }
}

/// The topic that has all six joints, and what they are called there.
fn choose<'a>(
    bag: &'a Bag,
    path: &Path,
    mapping: Option<&RobotLogMapping>,
) -> Result<(&'a Topic, [String; 6]), LogError> {
    let content = |problem: String, remedy: &str| LogError::Content {
        path: path.to_owned(),
        problem,
        remedy: remedy.into(),
    };
    let wanted = mapping.and_then(|mapping| mapping.topic.as_deref());
    let topics: Vec<&Topic> =
        bag.topics.iter().filter(|topic| wanted.is_none_or(|wanted| topic.name == wanted)).collect();
    let with_joints: Vec<(&Topic, [String; 6])> = topics
        .iter()
        .filter_map(|topic| Some((*topic, six_joints(&topic.joint_names(), mapping)?)))
        .collect();
    match with_joints.as_slice() {
        [one] => Ok(one.clone()),
        [] if topics.is_empty() => Err(content(
            match wanted {
                Some(wanted) => format!("no sensor_msgs/JointState on topic {wanted}"),
                None => "no messages of type sensor_msgs/JointState".into(),
            },
            "record the topic /joint_states",
        )),
        [] => {
            let found: Vec<String> = topics
                .iter()
                .map(|topic| format!("{}: {}", topic.name, topic.joint_names().join(", ")))
                .collect();
            Err(content(
                format!("no topic has the six joints of one robot; there are {}", found.join("; ")),
                "name joints 1 to 6 with [[joints]] column = \"...\" in a mapping file (--log-mapping)",
            ))
        }
        several => {
            let names: Vec<&str> = several.iter().map(|(topic, _)| topic.name.as_str()).collect();
            Err(content(
                format!("several topics have six joints: {}", names.join(", ")),
                "choose with topic = \"...\" in a mapping file (--log-mapping)",
            ))
        }
    }
}

/// The names of joints 1 to 6 among those found: the mapping's, or a family with one and the same prefix.
fn six_joints(found: &[&str], mapping: Option<&RobotLogMapping>) -> Option<[String; 6]> {
    if let Some(mapping) = mapping {
        let names: Vec<String> = mapping.joints.iter().map(|joint| joint.column.clone()).collect();
        let all = names.iter().all(|name| found.contains(&name.as_str()));
        return names.try_into().ok().filter(|_| all);
    }
    let mut candidates = FAMILIES.iter().flat_map(|family| {
        let prefixes = found.iter().filter_map(|name| name.strip_suffix(family[0]));
        prefixes.map(|prefix| family.map(|name| format!("{prefix}{name}"))).collect::<Vec<_>>()
    });
    let mut complete =
        candidates.by_ref().filter(|names| names.iter().all(|name| found.contains(&name.as_str())));
    let first = complete.next();
    // Two robots in one topic: which is meant must be said.
    first.filter(|_| complete.next().is_none())
}
