//! Proposes a mapping for a table that has none, for `identify inspect --propose`. Inputs are the bytes of the table and the
//! robot's configuration. First, the layout is found by counting numbers. Then the columns of joints, times, lengths and
//! positions are recognised by their names, units and ranges. Finally, signs and order of the joints and the form of the
//! orientation are chosen so that the residuals of the nominal robot are smallest. None of these choices is certain, so the
//! mapping lists the reason of each one.

mod columns;
mod joints;
mod layout;
mod times;
mod trial;

use std::path::Path;

use shared::config::{self, RobotConfig};

use crate::logs::{
    ContactMapping, CsvLayout, JointColumn, LengthColumn, LogError, MeasuredLengthMapping,
    MeasuredPoseMapping, PositionColumns, RobotLogMapping, RowsAsText, own_columns,
};
use columns::{TRACKERS, TableColumn, columns, label_column, triple};
use joints::joints;
use layout::layout;
use times::time;
use trial::ResidualTrial;

/// Words in the name of a column with lengths.
const LENGTHS: &str = "length cable wire rope distance laenge länge seil draw";
/// Words in the name of a column with the socket of a ball.
const SOCKETS: &str = "socket nest seat cone";

/// Mapping of a table, by the content of the table.
#[derive(Debug, Clone, PartialEq)]
pub enum Mapping {
    /// Robot log: joints over time.
    RobotLog(Box<RobotLogMapping>),
    /// Joints and positions of the flange that a tracker measured.
    MeasuredPoses(MeasuredPoseMapping),
    /// Joints and a length.
    MeasuredLengths(MeasuredLengthMapping),
    /// Joints and the socket of a ball.
    Contacts(ContactMapping),
}

/// A proposed mapping, with the reasons for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// Mapping for the table.
    pub mapping: Mapping,
    /// Reasons and open questions.
    pub notes: Notes,
}

/// Reasons for the choices in a mapping, and open questions.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Notes {
    /// Reason of each choice.
    pub reasons: Vec<String>,
    /// Open questions: content that looks wrong, and what the user can try.
    pub doubts: Vec<String>,
}

impl Notes {
    fn reason(&mut self, sentence: String) {
        self.reasons.push(sentence);
    }

    fn doubt(&mut self, sentence: String) {
        self.doubts.push(sentence);
    }
}

impl Proposal {
    /// The mapping as TOML text, with reasons and open questions as comments.
    ///
    /// # Errors
    /// If a value cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let body = match &self.mapping {
            Mapping::RobotLog(mapping) => config::to_toml(mapping),
            Mapping::MeasuredPoses(mapping) => config::to_toml(mapping),
            Mapping::MeasuredLengths(mapping) => config::to_toml(mapping),
            Mapping::Contacts(mapping) => config::to_toml(mapping),
        }?;
        let what = match self.mapping {
            Mapping::RobotLog(_) => "a robot's log, for --log-mapping",
            Mapping::MeasuredPoses(_) => "measured poses, for `identify calibrate tracker --mapping`",
            Mapping::MeasuredLengths(_) => "measured lengths, for `identify calibrate wire --mapping`",
            Mapping::Contacts(_) => "a ball in sockets, for `identify calibrate contact --mapping`",
        };
        let mut text = format!("# Proposed by `identify inspect`: {what}. Read it before you use it.\n");
        text.extend(self.notes.reasons.iter().map(|reason| format!("# - {reason}\n")));
        text.extend(self.notes.doubts.iter().map(|doubt| format!("# ! {doubt}\n")));
        Ok(text + "\n" + &body)
    }
}

/// Reasons why no mapping can be proposed.
#[derive(Debug, thiserror::Error)]
pub enum ProposeError {
    /// The file cannot be read as a table.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The table has no rows of numbers.
    #[error(
        "{path}: no rows of numbers with a column for each of {joints} joints; check that --robot is the robot that was logged, or \
         give another table"
    )]
    NoTable {
        /// Path of the file.
        path: String,
        /// Number of joints of the robot.
        joints: usize,
    },
    /// No columns can be recognised as joints.
    #[error(
        "{path}: the columns of the robot's {joints} joints cannot be recognised by name, unit and range; found {found}. Write a \
         mapping as config/robot_log.toml explains"
    )]
    NoJoints {
        /// Path of the file.
        path: String,
        /// Number of joints of the robot.
        joints: usize,
        /// Names of the columns in the table.
        found: String,
    },
    /// The table has joints, but neither times nor a measured quantity.
    #[error(
        "{path}: the table has joints, but neither time stamps nor a measured position, length or socket; found {found}. Export \
         one of these too, or write a mapping that names its column, as the files in config/ explain"
    )]
    NothingMeasured {
        /// Path of the file.
        path: String,
        /// Names of the columns in the table.
        found: String,
    },
}

/// Proposes a mapping for a table that was recorded with `robot`. `path` is only used in messages. If several sheets of a
/// workbook have a suitable table, the mapping is for the first of them.
///
/// # Errors
/// [`ProposeError`].
pub fn propose(bytes: &[u8], path: &Path, robot: &RobotConfig) -> Result<Proposal, ProposeError> {
    // `sheets` is empty unless the file is a workbook with several sheets.
    let sheets = RowsAsText::sheets(bytes);
    let proposals = sheets.iter().map(|sheet| (sheet.as_str(), for_sheet(bytes, path, robot, Some(sheet))));
    let (usable, others): (Vec<_>, Vec<_>) = proposals.partition(|(_, proposal)| proposal.is_ok());
    let names: Vec<&str> = usable.iter().map(|(sheet, _)| *sheet).collect();
    let Some((_, first)) = usable.into_iter().chain(others).next() else {
        return for_sheet(bytes, path, robot, None);
    };
    let mut first = first?;
    if names.len() > 1 {
        let names = names.join(", ");
        first.notes.doubt(format!("sheets {names} all have such a table; the first is taken"));
    }
    Ok(first)
}

/// Proposes a mapping for one sheet of a workbook, or for a text file (`sheet` is `None`).
fn for_sheet(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    sheet: Option<&str>,
) -> Result<Proposal, ProposeError> {
    let text = RowsAsText::new(bytes, path, sheet)?;
    let shown = path.display().to_string();
    let no_table = || ProposeError::NoTable { path: shown.clone(), joints: robot.axes() };
    let csv =
        CsvLayout { sheet: sheet.map(str::to_owned), ..layout(&text, robot.axes()).ok_or_else(no_table)? };
    let columns = columns(&text, &csv)?;
    let found = || columns.iter().map(|column| column.name.as_str()).collect::<Vec<_>>().join(", ");
    // Names of the columns of the robot's own log, from its configuration.
    let log_columns = own_columns(robot);
    let is_own_log = log_columns.iter().all(|name| columns.iter().any(|column| column.name == *name));
    // Notes on the joints are collected separately, because they are replaced if the table is the robot's own log. In the
    // mapping, they come before the other notes.
    let mut joint_notes = Notes::default();
    let joints = joints(&columns, robot, csv.header, &mut joint_notes);
    if joints.is_none() && !is_own_log {
        return Err(ProposeError::NoJoints { path: shown, joints: robot.axes(), found: found() });
    }
    let joints = joints.unwrap_or_default();
    let is_joint = |column: &TableColumn| joints.iter().any(|joint| joint.column == column.name);
    let taken = |column: &TableColumn| is_joint(column) || (is_own_log && log_columns.contains(&column.name));
    // Recognise the content of all columns that are not joints.
    let others: Vec<&TableColumn> = columns.iter().filter(|column| !taken(column)).collect();
    let mut notes = Notes::default();
    let time = time(&others, &mut notes);
    // Open questions on the time are only kept for a robot's log, because no other mapping contains the time.
    let time_doubts = std::mem::take(&mut notes.doubts);
    let length = others.iter().find(|column| column.has_word(LENGTHS)).copied();
    let position = triple(&others, &["x", "y", "z"]);
    let of_tracker = position.is_some_and(|xyz| xyz[0].has_word(TRACKERS));
    let socket = others.iter().find(|column| column.has_word(SOCKETS));
    let trial = ResidualTrial { bytes, path, robot };
    // The most specific content determines the kind of mapping. For example, a log with times may also
    // contain the controller's own positions.
    let mapping = match (time, length, position, socket) {
        (_, _, _, Some(socket)) => contacts(csv, joints, socket, &mut notes),
        (_, Some(length), _, _) => {
            let mapping = lengths(csv, joints, length, &others, &mut notes);
            let flange = position.filter(|_| !of_tracker);
            Mapping::MeasuredLengths(trial.with_flange(mapping, flange, &mut notes))
        }
        (Some(time), _, _, _) if !of_tracker => {
            notes.doubts = time_doubts;
            let joints = if is_own_log {
                let reason = format!("{} are the columns of the robot's own log", listed(&log_columns));
                joint_notes = Notes { reasons: vec![reason], ..Notes::default() };
                Vec::new()
            } else {
                joints
            };
            let time = Some(time);
            Mapping::RobotLog(Box::new(RobotLogMapping { csv, time, joints, ..RobotLogMapping::default() }))
        }
        (_, _, Some(xyz), _) => {
            let mapping = poses(csv, joints, xyz, &others, &mut notes);
            Mapping::MeasuredPoses(trial.corrected(mapping, &others, &mut notes))
        }
        _ => return Err(ProposeError::NothingMeasured { path: shown, found: found() }),
    };
    notes.reasons.splice(0..0, joint_notes.reasons);
    notes.doubts.splice(0..0, joint_notes.doubts);
    Ok(Proposal { mapping, notes })
}

fn contacts(csv: CsvLayout, joints: Vec<JointColumn>, socket: &TableColumn, notes: &mut Notes) -> Mapping {
    let socket = socket.name.clone();
    notes.reason(format!(
        "column `{socket}` contains the socket in which the ball is seated: inferred from its name"
    ));
    Mapping::Contacts(ContactMapping { csv, socket, joints })
}

fn lengths(
    csv: CsvLayout,
    joints: Vec<JointColumn>,
    length: &TableColumn,
    others: &[&TableColumn],
    notes: &mut Notes,
) -> MeasuredLengthMapping {
    let (unit, why) = length.length_unit();
    notes.reason(format!("`{}` is the measured length: inferred from the column's name; {why}", length.name));
    MeasuredLengthMapping {
        csv,
        length: LengthColumn { column: length.name.clone(), unit, offset_mm: 0.0 },
        joints,
        anchor: label_column(others, "wire's anchor", &["anchor", "station"], notes),
        attachment: label_column(others, "place on the flange", &["attachment", "target"], notes),
        ..MeasuredLengthMapping::default()
    }
}

fn poses(
    csv: CsvLayout,
    joints: Vec<JointColumn>,
    xyz: [&TableColumn; 3],
    others: &[&TableColumn],
    notes: &mut Notes,
) -> MeasuredPoseMapping {
    let columns = xyz.map(|column| column.name.clone());
    let (unit, why) = xyz[0].length_unit();
    notes.reason(format!(
        "{} are positions that the tracker measured: inferred from the columns' names; {why}",
        listed(&columns)
    ));
    MeasuredPoseMapping {
        csv,
        position: PositionColumns { columns, unit },
        station: label_column(others, "tracker's station", &["station", "setup"], notes),
        target: label_column(others, "target that was seen", &["target", "reflector", "smr"], notes),
        joints,
        ..MeasuredPoseMapping::default()
    }
}

fn listed<S: AsRef<str>>(names: &[S]) -> String {
    names.iter().map(|name| format!("`{}`", name.as_ref())).collect::<Vec<_>>().join(", ")
}
