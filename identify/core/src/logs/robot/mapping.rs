//! The mapping of a robot log: a TOML file with the columns and units of the log. `config/robot_log.toml` explains each key.

use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, LogConversion, Validate, Violation};

use crate::logs::rows::pose_rows::{JointColumn, check_joints};
use crate::logs::tables::stamp::TimeColumn;
use crate::logs::{ForceColumns, JointConversion, ValueOrigin};

/// Layout of a text table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CsvLayout {
    /// Character between cells. If absent, it is the comma, semicolon or tab, whichever occurs most often in the header.
    pub delimiter: Option<char>,
    /// Whether numbers have a decimal comma, such as `1,5`.
    pub decimal_comma: bool,
    /// Number of lines before the header, which are skipped.
    pub skip_lines: usize,
    /// Whether there is a header. Without a header, the names of the columns are their numbers, `1`, `2` and so on.
    pub header: bool,
    /// Number of lines between the header and the first row of values, such as a line of units.
    pub unit_lines: usize,
    /// Name of the sheet with the table, if the file is a workbook with several sheets.
    pub sheet: Option<String>,
}

impl Default for CsvLayout {
    fn default() -> Self {
        Self {
            delimiter: None,
            decimal_comma: false,
            skip_lines: 0,
            header: true,
            unit_lines: 0,
            sheet: None,
        }
    }
}

impl CsvLayout {
    /// Checks that the delimiter can separate cells and is not also the decimal comma.
    pub(in crate::logs) fn check(&self) -> Result<(), Violation> {
        let (key, delimiter) = ("csv.delimiter", self.delimiter.unwrap_or(';'));
        Violation::unless(
            delimiter.is_ascii() && !matches!(delimiter, '"' | '#' | '\n' | '\r'),
            key,
            format!("`{}` cannot separate cells", delimiter.escape_default()),
            "use \",\", \";\", \" \" or \"\\t\"",
        )?;
        Violation::unless(
            !self.decimal_comma || delimiter != ',',
            key,
            "a comma separates cells and decimals alike",
            "files with decimal commas mostly have delimiter = \";\"",
        )
    }
}

/// Adds a multiple of one joint to another: `q[joint] += factor * q[from]`. Both values are those of the file,
/// after sign and offset.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Coupling {
    /// Number of the corrected joint, from 1.
    pub joint: usize,
    /// Number of the joint that moves the corrected joint, from 1.
    pub from: usize,
    /// Factor for the value of the joint `from`.
    pub factor: f64,
}

/// Names of columns, one for each joint, base to flange.
pub type Columns = Vec<String>;

/// Describes how to read a robot log.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotLogMapping {
    /// Name of the clock of the stamps.
    pub clock: Option<String>,
    /// Whether the values are measured or commanded. If a format contains both, this selects the values that are read.
    pub values: Option<ValueOrigin>,
    /// Topic to read if a bag contains several topics with joint states.
    pub topic: Option<String>,
    /// Layout of a text table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Column and unit of the stamps.
    pub time: Option<TimeColumn>,
    /// All joints, base to flange: `q = sign * (value - offset)`. Without joints in the mapping, the joints and their
    /// conversion are those of the robot's own log.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub joints: Vec<JointColumn>,
    /// Columns with joint speeds, in the joints' unit per second.
    pub speeds: Option<Columns>,
    /// Columns with joint torques or motor currents. They are not converted.
    pub torques: Option<Columns>,
    /// Columns of the force on the ball-bar, if the log contains it.
    pub force: Option<ForceColumns>,
    /// Contributions of joints of the file to other joints of the model.
    #[serde(default)]
    pub coupling: Vec<Coupling>,
}

impl RobotLogMapping {
    /// The mapping, if it names joints; `None` if joints and conversion are those of the robot's own log.
    pub fn with_joints(&self) -> Option<&Self> {
        (!self.joints.is_empty()).then_some(self)
    }

    /// The conversion of values of the file, in radians or metres, to joint variables of the model.
    pub fn conversion(&self) -> LogConversion {
        let mut conversion = LogConversion::direct(AngleUnit::Rad, self.joints.len());
        let matrix = &mut conversion.raw_to_joint;
        for Coupling { joint, from, factor } in &self.coupling {
            if let Some(cell) =
                matrix.get_mut(from.wrapping_sub(1)).and_then(|row| row.get_mut(joint.wrapping_sub(1)))
            {
                *cell += factor;
            }
        }
        for ((row, offset), joint) in matrix.iter_mut().zip(&mut conversion.raw_offset_rad).zip(&self.joints)
        {
            row.iter_mut().for_each(|cell| *cell *= joint.sign);
            *offset = joint.offset();
        }
        conversion
    }
}

impl Validate for RobotLogMapping {
    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        self.time.as_ref().map_or(Ok(()), TimeColumn::check)?;
        let axes = self.joints.len();
        if axes == 0 {
            let need_joints = [
                ("speeds", self.speeds.is_some()),
                ("torques", self.torques.is_some()),
                ("coupling", !self.coupling.is_empty()),
            ];
            for (key, is_given) in need_joints {
                Violation::unless(!is_given, key, "there are no [[joints]]", "write one for each joint")?;
            }
            return self.force.as_ref().map_or(Ok(()), ForceColumns::check);
        }
        check_joints(&self.joints)?;
        for (key, columns) in [("speeds", &self.speeds), ("torques", &self.torques)] {
            let count = columns.as_ref().map_or(axes, Vec::len);
            let problem = format!("{count} columns for {axes} joints");
            Violation::unless(count == axes, key, problem, "name one for each joint, base to flange")?;
        }
        self.force.as_ref().map_or(Ok(()), ForceColumns::check)?;
        for (index, Coupling { joint, from, factor }) in self.coupling.iter().enumerate() {
            let known = |joint: &usize| (1..=axes).contains(joint);
            Violation::unless(
                known(joint) && known(from) && joint != from && (-10.0..=10.0).contains(factor),
                format!("coupling[{index}]"),
                format!("invalid coupling of joint {joint} to {from} by {factor}"),
                "write two different joints, counted from 1, and a factor such as 1 or -1",
            )?;
        }
        let is_regular = JointConversion::new(&self.conversion()).is_ok();
        let problem = "together they leave a joint undetermined";
        Violation::unless(is_regular, "coupling", problem, "check joint, from and factor of each")
    }
}
