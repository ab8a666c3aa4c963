//! ROS 2 bags with `sensor_msgs/JointState`: joints are found by name, whatever their order and whoever else is in it.
//!
//! A bag has two times: when the recorder received a message, and `header.stamp`, which the publisher set (with
//! ros2_control the time of the controller manager, not that of the encoders). The stamp is taken where every message has
//! one; which it was is the name of the log's clock.

mod bag;
mod joint_state;
mod mcap_bag;
mod sqlite_bag;

use std::path::Path;

use shared::config::{AngleUnit, RobotConfig};

use super::mapping::RobotLogMapping;
use super::raw::{Meaning, RawLog, RawRow};
use super::{ForceColumns, ForceKind, LogError, LogFormat, Origin, RobotLog};
use bag::Message;

pub(super) use bag::{Bag, UNSTAMPED, Wanted, clock_name};

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

const SIX_JOINTS: Wanted = Wanted {
    what: "the six joints of one robot",
    remedy: "name joints 1 to 6 with [[joints]] column = \"...\" in a mapping file (--log-mapping)",
    choose: "choose with topic = \"...\" in a mapping file (--log-mapping)",
    record: "record the topic /joint_states",
};

/// Reads a bag.
pub(super) fn read(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    format: LogFormat,
    mapping: Option<&RobotLogMapping>,
) -> Result<RobotLog, LogError> {
    let bag = Bag::open(bytes, path, format)?;
    let topic = mapping.and_then(|mapping| mapping.topic.as_deref());
    let (topic, names) = bag.choose(path, topic, &SIX_JOINTS, |found| six_joints(found, mapping))?;
    let meaning = match mapping {
        Some(mapping) => Meaning::new(robot, &mapping.conversion(), names.clone())?,
        None => Meaning::of_controller(robot, AngleUnit::Rad, names.clone(), format, path)?,
    };
    let mut raw = RawLog::new(path, "message");
    let stamped = topic.is_stamped();
    let clock = clock_name(stamped);
    raw.clock = mapping.and_then(|mapping| mapping.clock.clone()).unwrap_or_else(|| clock.into());
    raw.origin = mapping.and_then(|mapping| mapping.values).unwrap_or(Origin::Measured);
    raw.remarks.clone_from(&bag.remarks);
    raw.force = mapping
        .and_then(|mapping| mapping.force.as_ref())
        .map(|force| of_efforts(force, path))
        .transpose()?;
    if !stamped {
        raw.remarks.push(UNSTAMPED.into());
    }
    let to_rad = units(mapping);
    for message in &topic.messages {
        raw.push(row(message, &names, &to_rad, stamped))?;
    }
    raw.finish(&meaning)
}

/// A force is in a bag as efforts of the joints; columns are of tables.
fn of_efforts(force: &ForceColumns, path: &Path) -> Result<ForceKind, LogError> {
    if force.columns.is_empty() {
        return Ok(force.kind());
    }
    Err(LogError::Content {
        path: path.to_owned(),
        problem: format!("the mapping looks for a force in columns ({}), a bag has none", force.columns.join(", ")),
        remedy: "leave out `columns` under [force], then it is taken from the joints' efforts (unit = \"Nm\"); or give \
                 the force in a table of its own with --force-log"
            .into(),
    })
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
        stamp_ns: message.stamp_ns(stamped),
        joints: scaled(&state.position),
        speeds: whole(scaled(&state.velocity)),
        torques: whole(values(&state.effort)),
        force: None,
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
