//! Finds the columns of the joints. Candidates are groups of columns with related names. The best candidate is selected
//! by names, units and ranges.

use std::collections::BTreeMap;

use shared::config::{AngleUnit, RobotConfig};

use super::columns::TableColumn;
use super::{Notes, listed};
use crate::logs::{JointColumn, JointUnit};

/// Words in the names of columns that belong to joints but do not contain joint angles.
const NOT_ANGLES: &str = "vel velocity speed qd dq qdd acc tau torque moment effort current strom amp temp temperature force \
                          error dev";
/// Words in the names of columns with commanded angles.
const COMMANDED: &str = "cmd command commanded target soll desired ref reference planned set";

/// Common names of joints that are not numbered.
const NAMED_JOINTS: &[[&str; 6]] = &[
    ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"],
    ["base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3"],
    ["s", "l", "u", "r", "b", "t"],
];

/// Candidates for the joints. A candidate has `axes` columns, whose names differ only in the number or the common
/// name of the joint.
fn families(columns: &[TableColumn], axes: usize) -> Vec<Vec<&TableColumn>> {
    // A pattern is a name with `#` in place of the joint. The map contains, for each pattern, its columns by the
    // number of the joint.
    let mut by_pattern: BTreeMap<String, BTreeMap<usize, &TableColumn>> = BTreeMap::new();
    for column in columns.iter().filter(|column| column.is_number()) {
        let bytes = column.plain.as_bytes();
        for (at, byte) in bytes.iter().enumerate().filter(|(_, byte)| byte.is_ascii_digit()) {
            let is_digit = |index: Option<usize>| {
                index.and_then(|index| bytes.get(index)).is_some_and(u8::is_ascii_digit)
            };
            if !is_digit(at.checked_sub(1)) && !is_digit(Some(at + 1)) {
                let pattern = format!("{}#{}", &column.plain[..at], &column.plain[at + 1..]);
                by_pattern.entry(pattern).or_default().entry(usize::from(byte - b'0')).or_insert(column);
            }
        }
        for (set, names) in NAMED_JOINTS.iter().enumerate() {
            for (joint, name) in names.iter().enumerate() {
                if let Some(at) = column.find(name) {
                    let pattern =
                        format!("{set}{}#{}", &column.plain[..at], &column.plain[at + name.len()..]);
                    by_pattern.entry(pattern).or_default().entry(joint + 1).or_insert(column);
                }
            }
        }
    }
    let consecutive = |by_number: &BTreeMap<usize, _>| {
        // Numbers begin at 0 if there is a column with 0, otherwise at 1.
        let first = usize::from(!by_number.contains_key(&0));
        (first..first + axes)
            .map(|number| by_number.get(&number).copied())
            .collect::<Option<Vec<&TableColumn>>>()
    };
    by_pattern.values().filter_map(consecutive).collect()
}

/// Whether the values of all columns, interpreted in this unit, are within the limits of their joints plus a margin.
fn are_within(family: &[&TableColumn], robot: &RobotConfig, unit: AngleUnit) -> bool {
    /// Margin beyond the limits \[deg\]. The zero positions of controllers and models differ by multiples of a quarter turn.
    const MARGIN_DEG: f64 = 190.0;
    family.iter().zip(&robot.joint_limits_deg).all(|(column, [low, high])| {
        let limits_deg = low - MARGIN_DEG..=high + MARGIN_DEG;
        column.numbers.iter().all(|number| limits_deg.contains(&(number * unit.to_rad()).to_degrees()))
    })
}

/// Unit of an angle according to the header.
fn stated_unit(column: &TableColumn) -> Option<AngleUnit> {
    [AngleUnit::Deg, AngleUnit::Rad].into_iter().find(|unit| column.unit == Some(unit.suffix()))
}

/// Returns the columns of the joints with their unit. These are the columns of the candidate with the highest score.
pub(super) fn joints(
    columns: &[TableColumn],
    robot: &RobotConfig,
    header: bool,
    notes: &mut Notes,
) -> Option<Vec<JointColumn>> {
    // A robot with prismatic joints has fewer limits in degrees than axes. Columns of prismatic joints cannot be
    // recognised by their range.
    let axes = robot.joint_limits_deg.len();
    if axes < robot.axes() {
        return None;
    }
    let mut choices = families(columns, axes);
    if choices.is_empty() && !header {
        choices.extend(first_neighbours(columns, robot));
        if !choices.is_empty() {
            notes.doubt(format!(
                "the table has no header: the first {axes} columns that can be angles are taken for the joints"
            ));
        }
    }
    // `max_by_key` returns the last of several equal maxima. The order is reversed, so that the first candidate is selected.
    let scored = choices.iter().rev().map(|family| (score(family, robot), family));
    let (_, family) = scored.filter(|(score, _)| *score > -5).max_by_key(|(score, _)| *score)?;
    let unit = angle_unit(family, notes);
    if !are_within(family, robot, unit) {
        notes.doubt(format!(
            "some joints leave the robot's limits by more than half a turn: is this a log of {}?",
            robot.name
        ));
    }
    if family.iter().any(|column| column.has_word(COMMANDED)) {
        notes.doubt(
            "these are commanded angles, according to the columns' names; measured ones are better".into(),
        );
    }
    let names: Vec<&str> = family.iter().map(|column| column.name.as_str()).collect();
    notes.reasons.insert(
        0,
        format!("{} are joints 1 to {axes}: inferred from the columns' names and ranges", listed(&names)),
    );
    let unit = if unit == AngleUnit::Deg { JointUnit::Deg } else { JointUnit::Rad };
    Some(family.iter().map(|column| JointColumn::new(column.name.clone(), unit)).collect())
}

/// Candidate in a table without header: the first consecutive columns that are within the joint limits in degrees. Columns
/// that always increase are excluded, because they contain times.
fn first_neighbours<'c>(columns: &'c [TableColumn], robot: &RobotConfig) -> Option<Vec<&'c TableColumn>> {
    let numeric: Vec<&TableColumn> = columns.iter().filter(|column| column.is_number()).collect();
    let are_angles = |family: &&[&TableColumn]| {
        are_within(family, robot, AngleUnit::Deg) && !family.iter().any(|column| column.rises())
    };
    numeric.windows(robot.joint_limits_deg.len()).find(are_angles).map(<[&TableColumn]>::to_vec)
}

/// Score of a candidate, with empirical weights. Values outside the joint limits outweigh all favourable properties
/// together. A score of -5 or less excludes a candidate.
fn score(family: &[&TableColumn], robot: &RobotConfig) -> i32 {
    let has = |words| i32::from(family.iter().any(|column| column.has_word(words)));
    let still = family.iter().all(|column| column.numbers.windows(2).all(|pair| pair[0] == pair[1]));
    let has_other_unit = family.iter().any(|column| column.unit.is_some() && stated_unit(column).is_none());
    let has_angle_unit = family.iter().all(|column| stated_unit(column).is_some());
    2 * i32::from(has_angle_unit)
        - has(COMMANDED)
        - 5 * has(NOT_ANGLES)
        - 5 * i32::from(has_other_unit)
        - 3 * i32::from(still)
        - 9 * i32::from(!are_within(family, robot, AngleUnit::Deg))
}

/// Unit of the angles, from the size of their values. A note states whether the header agrees.
pub(super) fn angle_unit(family: &[&TableColumn], notes: &mut Notes) -> AngleUnit {
    /// Largest angle in radians, because joints of robots turn by little more than one turn in each direction.
    const RAD_MAX: f64 = 6.7;
    let stated = family.iter().copied().find_map(stated_unit);
    let largest = family.iter().map(|column| column.largest()).fold(0.0, f64::max);
    let inferred = if largest > RAD_MAX { AngleUnit::Deg } else { AngleUnit::Rad };
    match stated {
        Some(stated) if stated == inferred => {
            notes.reason(format!("angles in {}, from the header; they reach {largest:.1}", stated.suffix()))
        }
        Some(stated) => notes.doubt(format!(
            "the header states {}, but the angles reach {largest:.1}, which suggests {}; {} is written here",
            stated.suffix(),
            inferred.suffix(),
            inferred.suffix()
        )),
        None => notes.reason(format!("angles in {}: they reach {largest:.1}", inferred.suffix())),
    }
    inferred
}
