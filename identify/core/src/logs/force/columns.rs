//! Finds the columns of a force in a table, and reads their values.
//!
//! The columns and their unit are those of a mapping file ([`ForceColumns`]), or those with one of the known names
//! ([`ForceLayout::find_usual`]). The result, a [`ForceLayout`], converts each row to newtons or newton metres.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{AXES_MAX, AXES_MIN, RobotConfig, Violation};

use super::{ALONG_COLUMN, FORCE_MAX, ForceKind};
use crate::kinematics::Joints;
use crate::logs::LogError;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};

const SIGN_COLUMN: &str = "force_sign";
const VECTOR_COLUMNS: [&str; 3] = ["force_x_N", "force_y_N", "force_z_N"];
/// External force at the tool that UR's controllers estimate, in the axes of the robot's base \[N\].
const RTDE_COLUMNS: [&str; 3] = ["actual_TCP_force_0", "actual_TCP_force_1", "actual_TCP_force_2"];
/// A pound-force \[N\].
const LBF_N: f64 = 4.448_221_615_260_5;

/// Unit of a force.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ForceUnit {
    /// Newton, the SI unit of force.
    N,
    /// Kilonewton, a thousand newtons.
    #[serde(rename = "kN")]
    KN,
    /// Pounds-force.
    #[serde(rename = "lbf")]
    Lbf,
    /// Newton metres, for torques of the joints.
    Nm,
    /// Only the sign is known: -1, 0 or 1.
    #[serde(rename = "sign")]
    Sign,
}

impl ForceUnit {
    /// Factor to newtons or newton metres.
    const fn to_si(self) -> f64 {
        match self {
            Self::N | Self::Nm | Self::Sign => 1.0,
            Self::KN => 1e3,
            Self::Lbf => LBF_N,
        }
    }
}

/// Axes of a force that has three components.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ForceFrame {
    /// Axes of the flange.
    #[default]
    Flange,
    /// Axes of the robot's base.
    Base,
}

/// Columns of the force in a log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForceColumns {
    /// Names of the columns. One column is the force along the bar. Three are the components x, y, z. In newton metres, the
    /// columns are the torques of the joints, in their order. Without columns, the force is computed from the torques of the
    /// robot's log (columns `torques`, or `effort` of ROS 2).
    #[serde(default)]
    pub columns: Vec<String>,
    /// Unit of all columns.
    pub unit: ForceUnit,
    /// Axes to which three components refer.
    #[serde(default)]
    pub frame: ForceFrame,
}

impl ForceColumns {
    /// Meaning of the columns.
    pub fn kind(&self) -> ForceKind {
        match (self.columns.len(), self.frame) {
            _ if self.unit == ForceUnit::Nm => ForceKind::JointTorques,
            (1, _) if self.unit == ForceUnit::Sign => ForceKind::Sign,
            (1, _) => ForceKind::Along,
            (3, ForceFrame::Flange) => ForceKind::InFlange,
            (3, ForceFrame::Base) => ForceKind::InBase,
            _ => ForceKind::JointTorques,
        }
    }

    /// Checks that the number of columns fits the unit.
    pub(in crate::logs) fn check(&self) -> Result<(), Violation> {
        let fits = match (self.columns.len(), self.unit) {
            (columns, ForceUnit::Nm) => columns == 0 || (AXES_MIN..=AXES_MAX).contains(&columns),
            (1, _) => true,
            (3, unit) => unit != ForceUnit::Sign,
            _ => false,
        };
        Violation::unless(
            fits,
            "force",
            format!("{} columns in {:?} are not a force", self.columns.len(), self.unit),
            "write one column along the bar (N, kN, lbf or sign), three components (N, kN, lbf), or torques of all \
             joints (Nm)",
        )
    }
}

/// The columns of the force in an open table.
pub(in crate::logs) struct ForceLayout {
    kind: ForceKind,
    columns: Vec<CsvColumn>,
    /// Factor to newtons or newton metres.
    to_si: f64,
    /// Whether a comment `# force_frame: base` or `# force_frame: flange` in the table names the axes.
    frame_in_comment: bool,
}

impl ForceLayout {
    /// Finds the columns that a mapping names. `None` if the mapping names no columns, because the force is then computed
    /// from the torques of the robot's log.
    pub fn find_named(
        table: &CsvTable<'_>,
        path: &Path,
        force: &ForceColumns,
        robot: &RobotConfig,
    ) -> Result<Option<Self>, LogError> {
        let (columns, axes) = (force.columns.len(), robot.axes());
        if force.kind() == ForceKind::JointTorques && columns != 0 && columns != axes {
            let name = &robot.name;
            let problem =
                format!("the mapping names {columns} torques under [force], {name} has {axes} axes");
            return Err(LogError::content(path, problem, "name one column for each axis, base to flange"));
        }
        let remedy = "Correct the name under [force] in the mapping file.";
        let columns = table.columns(&force.columns, remedy)?;
        let layout = Self { kind: force.kind(), columns, to_si: force.unit.to_si(), frame_in_comment: false };
        Ok((!layout.columns.is_empty()).then_some(layout))
    }

    /// Finds columns with one of the known names, or returns `None`. The names are: `force_N`; `force_sign`; `force_x_N` to
    /// `force_z_N` (in the axes of the flange unless a comment is `# force_frame: base`); the estimated force of a UR
    /// controller; torques such as `joint1_Nm`.
    pub fn find_usual(table: &CsvTable<'_>, robot: &RobotConfig) -> Result<Option<Self>, LogError> {
        let torques: Vec<String> =
            (1..=robot.axes()).map(|joint| format!("{}{joint}_Nm", robot.log.column)).collect();
        let torques: Vec<&str> = torques.iter().map(String::as_str).collect();
        let known: [(ForceKind, &[&str]); 5] = [
            (ForceKind::Along, &[ALONG_COLUMN]),
            (ForceKind::Sign, &[SIGN_COLUMN]),
            (ForceKind::InFlange, &VECTOR_COLUMNS),
            (ForceKind::InBase, &RTDE_COLUMNS),
            (ForceKind::JointTorques, &torques),
        ];
        let Some((kind, names)) =
            known.into_iter().find(|(_, names)| names.iter().any(|name| table.has(name)))
        else {
            return Ok(None);
        };
        let remedy = "A force needs all of its components, or leave all of them out.";
        let columns = table.columns(names, remedy)?;
        Ok(Some(Self { kind, columns, to_si: 1.0, frame_in_comment: kind == ForceKind::InFlange }))
    }

    /// Meaning of the columns. Call this after the last row has been read, because the comment with the axes may be
    /// anywhere in the table.
    pub fn kind(&self, table: &CsvTable<'_>) -> Result<ForceKind, LogError> {
        match table.comment("force_frame").filter(|_| self.frame_in_comment) {
            None => Ok(self.kind),
            Some(frame) if frame.eq_ignore_ascii_case("flange") => Ok(ForceKind::InFlange),
            Some(frame) if frame.eq_ignore_ascii_case("base") => Ok(ForceKind::InBase),
            Some(frame) => {
                let remedy = "write `# force_frame: base` or `# force_frame: flange`";
                Err(LogError::content(table.path(), format!("the axes of its force are `{frame}`"), remedy))
            }
        }
    }

    /// The numbers of one row \[N or N m\].
    pub fn row(&self, row: &CsvRow<'_>) -> Result<Joints, LogError> {
        let mut values = Joints::zeros(self.columns.len());
        for (value, column) in values.iter_mut().zip(&self.columns) {
            *value = row.number(column)? * self.to_si;
            if value.abs() > FORCE_MAX {
                let problem = format!("{value:.3e} N or Nm is more than any robot meets");
                return Err(row.bad(column, problem, "check the unit, or correct or remove the row"));
            }
            if self.kind == ForceKind::Sign && !(-1.0..=1.0).contains(value) {
                let remedy = "give -1, 0 or 1; a force in newtons belongs into `force_N`";
                return Err(row.bad(column, format!("invalid sign {value}"), remedy));
            }
        }
        Ok(values)
    }
}

/// The error for a table without a known column of a force.
pub(in crate::logs) fn unknown(table: &CsvTable<'_>, path: &Path) -> LogError {
    LogError::MissingColumn {
        path: path.to_owned(),
        column: ALONG_COLUMN.into(),
        found: table.names(),
        remedy: "A force is in `force_N` (along the bar), `force_sign`, `force_x_N` to `force_z_N` or torques such as \
                 `joint1_Nm`; for other columns or units write a mapping (--force-mapping)."
            .into(),
    }
}
