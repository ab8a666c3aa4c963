//! Common functions for the tables of single poses in this folder: they find the columns of the joints that a mapping names,
//! and read a table row by row.

use std::collections::{HashMap, HashSet};
use std::fmt::Debug;
use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{AXES_MAX, AXES_MIN, JointKind, RobotConfig, Validate, Violation};
use shared::output::named;

use crate::kinematics::Joints;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::{CsvLayout, LogError};
use crate::model::SetUp;

/// Smallest number of rows of a table.
const ROWS_MIN: usize = 10;
/// Largest angle of a joint \[rad\]; a larger number means that the unit is wrong.
const JOINT_RAD_MAX: f64 = 4.0 * std::f64::consts::PI;

/// Unit of a length column.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LengthUnit {
    /// Metres, the SI unit of length.
    #[default]
    M,
    /// Millimetres, a thousandth of a metre.
    Mm,
}

impl LengthUnit {
    /// Metres in one unit.
    pub const fn to_m(self) -> f64 {
        match self {
            Self::M => 1.0,
            Self::Mm => 1e-3,
        }
    }
}

/// Unit of a joint's column.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointUnit {
    /// Radians, for a revolute joint.
    Rad,
    /// Degrees, for a revolute joint.
    Deg,
    /// Metres, for a prismatic joint.
    M,
    /// Millimetres, for a prismatic joint.
    Mm,
}

impl JointUnit {
    /// Radians or metres in one unit.
    pub fn to_si(self) -> f64 {
        match self {
            Self::Rad | Self::M => 1.0,
            Self::Deg => 1f64.to_radians(),
            Self::Mm => 1e-3,
        }
    }

    /// Symbol of the unit.
    pub const fn suffix(self) -> &'static str {
        match self {
            Self::Rad => "rad",
            Self::Deg => "deg",
            Self::M => "m",
            Self::Mm => "mm",
        }
    }

    pub(in crate::logs) const fn kind(self) -> JointKind {
        match self {
            Self::Rad | Self::Deg => JointKind::Revolute,
            Self::M | Self::Mm => JointKind::Prismatic,
        }
    }
}

/// The column of one joint: `q = sign * (value * unit - offset)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of the values in the column.
    pub unit: JointUnit,
    /// +1, or -1 if the joint in the file has the opposite sign of the joint in the model.
    #[serde(default = "positive")]
    pub sign: f64,
    /// Value in the file at the model's zero, for a revolute joint \[deg\].
    #[serde(default)]
    pub offset_deg: f64,
    /// Value in the file at the model's zero, for a prismatic joint \[m\].
    #[serde(default, skip_serializing_if = "is_zero")]
    pub offset_m: f64,
}

impl JointColumn {
    /// A column whose values have the sign and the zero of the model.
    pub const fn new(column: String, unit: JointUnit) -> Self {
        Self { column, unit, sign: 1.0, offset_deg: 0.0, offset_m: 0.0 }
    }

    /// Value in the file at the model's zero \[rad, m\].
    pub(in crate::logs) fn offset(&self) -> f64 {
        match self.unit.kind() {
            JointKind::Revolute => self.offset_deg.to_radians(),
            JointKind::Prismatic => self.offset_m,
        }
    }
}

pub(super) fn is_zero(number: &f64) -> bool {
    *number == 0.0
}

fn positive() -> f64 {
    1.0
}

/// The columns of the joints in a table that is written: `q1_deg` and so on in degrees, `q1_mm` and so on for prismatic joints.
pub fn joint_columns(robot: &RobotConfig) -> Vec<JointColumn> {
    let joint = |(number, kind): (usize, JointKind)| {
        let unit = match kind {
            JointKind::Revolute => JointUnit::Deg,
            JointKind::Prismatic => JointUnit::Mm,
        };
        JointColumn::new(format!("q{number}_{}", unit.suffix()), unit)
    };
    (1..).zip(robot.joint_kinds()).map(joint).collect()
}

/// The keys for the joints, which the mappings of all tables of single poses have.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct JointTableMapping {
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// All joints, base to flange.
    pub joints: Vec<JointColumn>,
}

impl Validate for JointTableMapping {
    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        check_joints(&self.joints)
    }
}

impl JointTableMapping {
    /// Reads the joint variables \[rad, m\] of each row of the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(&self, path: &Path) -> Result<Vec<Joints>, LogError> {
        let mut table = CsvTable::open(LogSource::open(path)?, &self.csv)?;
        let joints = JointColumns::find(&table, &self.joints)?;
        rows(&mut table, |row| joints.read(row))
    }
}

/// Checks that the joints of a mapping are the axes of the robot.
///
/// # Errors
/// [`LogError::Content`] if the number or the kinds of the joints differ from those of the axes.
pub fn joints_of_robot(joints: &[JointColumn], robot: &RobotConfig, path: &Path) -> Result<(), LogError> {
    let kinds = joints.iter().map(|joint| joint.unit.kind());
    if kinds.eq(robot.joint_kinds()) {
        return Ok(());
    }
    let units: Vec<&str> = robot.joint_kinds().map(JointKind::si_symbol).collect();
    let problem = format!("the mapping's {} joints are not the axes of {}", joints.len(), robot.name);
    let units = units.join(", ");
    let remedy = format!("write one [[joints]] block for each axis, base to flange, in units like {units}");
    Err(LogError::content(path, problem, remedy))
}

/// Checks the standard uncertainty of an instrument's scale \[ppm\]. An uncertainty of more than a tenth means that
/// the unit is wrong.
pub(super) fn check_scale_u(scale_u_ppm: Option<f64>) -> Result<(), Violation> {
    let remedy = "write the standard uncertainty in ppm: 1000 for 0.1 %, 0 if the scale is exact";
    scale_u_ppm.map_or(Ok(()), |u_ppm| Violation::unless_within("scale_u_ppm", u_ppm, [0.0, 1e5], remedy))
}

/// Checks the number of the joints, and the sign and offset of each joint.
pub(in crate::logs) fn check_joints(joints: &[JointColumn]) -> Result<(), Violation> {
    let count = joints.len();
    let remedy = "write one [[joints]] block for each joint of the robot";
    let is_arm = (AXES_MIN..=AXES_MAX).contains(&count);
    Violation::unless(is_arm, "joints", format!("{count} joints are given"), remedy)?;
    for (index, joint) in joints.iter().enumerate() {
        let (key, problem) = (format!("joints[{index}].sign"), format!("invalid sign {}", joint.sign));
        Violation::unless(joint.sign.abs() == 1.0, key, problem, "write 1 or -1")?;
        let (offset, key) = match joint.unit.kind() {
            JointKind::Revolute => (joint.offset_m, "offset_m"),
            JointKind::Prismatic => (joint.offset_deg, "offset_deg"),
        };
        Violation::unless(
            offset == 0.0 && joint.offset_m.is_finite(),
            format!("joints[{index}].{key}"),
            format!("{offset} is an offset in another unit than that of the joint"),
            "write offset_deg for angles, offset_m for lengths",
        )?;
        let key = format!("joints[{index}].offset_deg");
        Violation::unless_within(key, joint.offset_deg, [-360.0, 360.0], "offsets are in degrees")?;
    }
    Ok(())
}

/// Reads all rows of a table with `read`.
pub(super) fn rows<R>(
    table: &mut CsvTable<'_>,
    mut read: impl FnMut(&CsvRow<'_>) -> Result<R, LogError>,
) -> Result<Vec<R>, LogError> {
    let mut rows = Vec::new();
    while let Some(row) = table.next_row()? {
        rows.push(read(&row)?);
    }
    LogError::unless_enough(table.path(), rows.len(), ROWS_MIN)?;
    Ok(rows)
}

/// Removes rows that only differ from an earlier row by their `line`, and returns a remark if there are any. Such a copy
/// adds no information and would make the uncertainties too small. A pose that is measured again usually has other noise. It
/// looks like a copy only if its joints are commanded and the reading is coarse. If such a pose is removed, the
/// uncertainties can only become too large.
pub fn drop_copies<R: Clone + Debug>(rows: &mut Vec<R>, line: impl Fn(&mut R) -> &mut u64) -> Option<String> {
    /// Largest number of lines that are listed in the remark.
    const NAMED: usize = 8;
    let (count, mut seen, mut copies) = (rows.len(), HashSet::new(), Vec::new());
    rows.retain(|row| {
        let mut values = row.clone();
        let number = std::mem::take(line(&mut values));
        // Different numbers have different texts in this format.
        let is_first = seen.insert(format!("{values:?}"));
        if !is_first {
            copies.push(number);
        }
        is_first
    });
    (!copies.is_empty()).then(|| {
        format!(
            "{} of {count} rows are copies of earlier rows (line {}) and are not used; find out why the file repeats them",
            copies.len(),
            named(&copies, NAMED)
        )
    })
}

/// The different names in a column, numbered in the order in which they occur first in the file.
#[derive(Default)]
pub(super) struct Names(HashMap<String, usize>);

impl Names {
    /// The number of the name in this row, from 0. The number is 0 if the file has no column of names.
    pub fn place(&mut self, row: &CsvRow<'_>, column: Option<&CsvColumn>) -> Result<usize, LogError> {
        let Some(column) = column else { return Ok(0) };
        let name = row.text(column).trim();
        if name.is_empty() {
            let problem = "no name is given".to_owned();
            return Err(row.bad(column, problem, "write it, or remove the row"));
        }
        let next = self.0.len();
        Ok(*self.0.entry(name.to_owned()).or_insert(next))
    }

    /// The names in the order of their numbers.
    pub fn in_order(self) -> Vec<String> {
        let mut names: Vec<(String, usize)> = self.0.into_iter().collect();
        names.sort_by_key(|(_, place)| *place);
        names.into_iter().map(|(name, _)| name).collect()
    }
}

/// The names of stations and targets of a tracker, or of anchors and attachments of a wire.
#[derive(Default)]
pub(super) struct SetUpNames([Names; 2]);

impl SetUpNames {
    /// The numbers of station and target in a row, by the names in two columns. A number is 0 if the file does
    /// not have the column.
    pub fn place(
        &mut self,
        row: &CsvRow<'_>,
        [station, target]: &[Option<CsvColumn>; 2],
    ) -> Result<SetUp, LogError> {
        let [stations, targets] = &mut self.0;
        let station = stations.place(row, station.as_ref())?;
        Ok(SetUp { station, target: targets.place(row, target.as_ref())? })
    }

    /// The names of the stations and of the targets, each in the order of their numbers.
    pub fn in_order(self) -> [Vec<String>; 2] {
        self.0.map(Names::in_order)
    }
}

/// The columns of the joints in an open table.
pub(super) struct JointColumns<'a>(Vec<(CsvColumn, &'a JointColumn)>);

impl<'a> JointColumns<'a> {
    pub fn find(table: &CsvTable<'_>, joints: &'a [JointColumn]) -> Result<Self, LogError> {
        let names: Vec<&str> = joints.iter().map(|joint| joint.column.as_str()).collect();
        let columns = table.columns(&names, REMEDY)?;
        Ok(Self(columns.into_iter().zip(joints).collect()))
    }

    /// Joint variables of a row \[rad, m\].
    pub fn read(&self, row: &CsvRow<'_>) -> Result<Joints, LogError> {
        let mut q_rad = Joints::zeros(self.0.len());
        for (q, (column, joint)) in q_rad.iter_mut().zip(&self.0) {
            *q = joint.sign * (row.number(column)? * joint.unit.to_si() - joint.offset());
            if joint.unit.kind() == JointKind::Revolute && q.abs() > JOINT_RAD_MAX {
                let remedy = if joint.unit == JointUnit::Deg {
                    "correct or remove the row, or check the joint's offset in the mapping file"
                } else {
                    "the column looks like degrees: check the joint's unit in the mapping file"
                };
                return Err(row.bad(column, format!("{:.1} rad is more than two turns", *q), remedy));
            }
        }
        Ok(q_rad)
    }
}

/// Reads a standard uncertainty in mm or mrad and converts it to m or rad; `None` without a column.
pub(super) fn uncertainty(row: &CsvRow<'_>, column: Option<&CsvColumn>) -> Result<Option<f64>, LogError> {
    /// Largest standard uncertainty \[m, rad\]; a larger number means that the unit is wrong.
    const UNCERTAINTY_MAX: f64 = 0.1;
    let Some(column) = column else { return Ok(None) };
    let value = row.number(column)? * 1e-3;
    if value > 0.0 && value <= UNCERTAINTY_MAX {
        return Ok(Some(value));
    }
    let (given, most) = (value * 1e3, UNCERTAINTY_MAX * 1e3);
    let problem = format!("the standard uncertainty {given} is not above 0 and up to {most}");
    Err(row.bad(column, problem, "correct the row, or the column's name or unit in the mapping file"))
}

/// What the user can do if a column that the mapping names is missing.
pub(super) const REMEDY: &str = "Correct the column's name in the mapping file, or the header.";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logs::LengthRow;

    #[test]
    fn copies_of_a_row_are_removed_and_their_lines_named() {
        let row = |length_m, line| LengthRow { length_m, line, ..LengthRow::default() };
        let mut rows = vec![row(0.5, 2), row(0.5 + 1e-15, 3), row(0.5, 4), row(0.6, 5), row(0.5, 6)];
        let remark = drop_copies(&mut rows, |row| &mut row.line).unwrap_or_default();
        assert_eq!(rows.iter().map(|row| row.line).collect::<Vec<_>>(), [2, 3, 5]);
        assert!(remark.contains("2 of 5 rows") && remark.contains("(line 4, 6)"), "{remark}");
        assert_eq!(drop_copies(&mut rows, |row| &mut row.line), None);
    }
}
