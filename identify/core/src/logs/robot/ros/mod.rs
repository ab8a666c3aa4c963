//! Reads robot logs from ROS 2 bags with `sensor_msgs/JointState` messages. Joints are found by their names. They may be in
//! any order, and a message may contain other joints, too.
//!
//! A message in a bag has two times. One is the time at which the recorder received the message. The other is
//! `header.stamp`, which the publisher set; with ros2_control this is the time of the controller manager, not of the
//! encoders. `header.stamp` is used if every message of the topic has it, otherwise the receive time. The clock of the log
//! is named after the time that is used.

mod bag;
mod joint_state;
mod mcap_bag;
mod sqlite_bag;

use std::path::Path;

use shared::config::{AngleUnit, RobotConfig};

use super::mapping::RobotLogMapping;
use super::raw::{Meaning, RawLog, RawRobotRow};
use crate::kinematics::Joints;
use crate::logs::{ForceColumns, ForceKind, LogError, LogFormat, RobotLog};
use bag::RecordedJointState;

pub(in crate::logs) use bag::{Bag, UNSTAMPED, Wanted, clock_name};

/// Families of joint names that drivers use, each from base to flange. All names of a family may have the same
/// prefix, such as `left_`.
fn families(axes: usize) -> Vec<Vec<String>> {
    const UR: [&str; 6] = [
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    ];
    let numbered = |stem: &str| (1..=axes).map(|joint| format!("{stem}{joint}")).collect();
    let mut families = vec![numbered("joint_"), numbered("joint"), numbered("joint_a")];
    if axes == UR.len() {
        families.push(UR.map(str::to_owned).to_vec());
    }
    families
}

const JOINTS: Wanted = Wanted {
    what: "the joints of one robot",
    remedy: "name its joints with [[joints]] column = \"...\" in a mapping file (--log-mapping)",
    choose: "choose with topic = \"...\" in a mapping file (--log-mapping)",
    record: "record the topic /joint_states",
};

/// Reads the joints of a robot from a bag. `mapping` may contain the topic, the names of the joints and their conversion.
pub(in crate::logs) fn read(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    format: LogFormat,
    mapping: Option<&RobotLogMapping>,
) -> Result<RobotLog, LogError> {
    let bag = Bag::open(bytes, path, format)?;
    let topic = mapping.and_then(|mapping| mapping.topic.as_deref());
    let joint_mapping = mapping.and_then(RobotLogMapping::with_joints);
    let (topic, names) =
        bag.choose(path, topic, &JOINTS, |found| joints_among(found, robot.axes(), joint_mapping))?;
    LogError::unless_distinct(path, &names)?;
    let meaning = match joint_mapping {
        Some(mapping) => Meaning::mapped(robot, mapping, names, path)?,
        None => Meaning::of_controller(robot, AngleUnit::Rad, names, format, path)?,
    };
    let stamped = topic.is_stamped();
    let mut raw = RawLog::measured(path, "message", mapping, clock_name(stamped));
    raw.log.quality.remarks.clone_from(&bag.remarks);
    raw.force = mapping
        .and_then(|mapping| mapping.force.as_ref())
        .map(|force| kind_of_efforts(force, path))
        .transpose()?;
    if !stamped {
        raw.remark(UNSTAMPED);
    }
    for message in &topic.messages {
        raw.push(row(message, &meaning.logged.names, stamped), &meaning)?;
    }
    raw.finish(&meaning)
}

/// The kind of the force in the mapping. A bag only contains the efforts of the joints, so columns in the mapping are an error.
fn kind_of_efforts(force: &ForceColumns, path: &Path) -> Result<ForceKind, LogError> {
    if force.columns.is_empty() {
        return Ok(force.kind());
    }
    let columns = force.columns.join(", ");
    let problem = format!("the mapping names columns of a force ({columns}), but a bag has no columns");
    let remedy = "remove `columns` under [force] and write unit = \"Nm\" to use the efforts of the joints, or give the force in a table \
                  of its own with --force-log";
    Err(LogError::content(path, problem, remedy))
}

fn row(message: &RecordedJointState, names: &[String], stamped: bool) -> RawRobotRow {
    let state = &message.state;
    let value = |name: &String, numbers: &[f64]| {
        let place = state.names.iter().position(|other| other == name);
        place.and_then(|place| numbers.get(place)).copied().unwrap_or(f64::NAN)
    };
    let by_name = |numbers: &[f64]| -> Joints { names.iter().map(|name| value(name, numbers)).collect() };
    let if_complete = |values: Joints| values.iter().all(|value| value.is_finite()).then_some(values);
    RawRobotRow {
        place: message.number,
        stamp_ns: message.stamp_ns(stamped),
        joints: by_name(&state.position),
        speeds: if_complete(by_name(&state.velocity)),
        torques: if_complete(by_name(&state.effort)),
        force: None,
    }
}

/// Finds the names of the robot's joints in `found`. With a mapping they are the names in the mapping. Otherwise they are a
/// family whose names all have the same prefix. `None` if names are missing, or if several families match.
fn joints_among(found: &[&str], axes: usize, mapping: Option<&RobotLogMapping>) -> Option<Vec<String>> {
    let are_found = |names: &Vec<String>| names.iter().all(|name| found.contains(&name.as_str()));
    if let Some(mapping) = mapping {
        let names: Vec<String> = mapping.joints.iter().map(|joint| joint.column.clone()).collect();
        return Some(names).filter(are_found);
    }
    let families = families(axes);
    let candidates = families.iter().flat_map(|family| {
        let prefixes = found.iter().filter_map(|name| name.strip_suffix(family[0].as_str()));
        prefixes.map(|prefix| family.iter().map(|name| format!("{prefix}{name}")).collect::<Vec<_>>())
    });
    let mut complete = candidates.filter(are_found);
    let first = complete.next();
    // If a topic contains two robots, a mapping must name the joints of one of them.
    first.filter(|_| complete.next().is_none())
}
