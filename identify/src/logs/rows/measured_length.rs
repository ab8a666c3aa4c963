//! Poses with one measured length each: a draw-wire sensor or a telescoping bar without encoders.
//!
//! There is no common file format, so a mapping in TOML says which columns to read and how. An example that explains
//! each key is `config/measured_length.toml`.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use super::pose_rows::{JointColumns, check_joints, mapped, rows};
use crate::kinematics::Joints;
use crate::logs::tables::csv_text::{Column, Row, Table};
use crate::logs::{CsvLayout, JointColumn, LengthUnit, LogError, bytes_of};

/// No wire or bar is longer \[m\]; more means a wrong unit.
const LENGTH_M_MAX: f64 = 20.0;

/// The column of the measured length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LengthColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of its values.
    pub unit: LengthUnit,
}

/// The columns of the position that the controller itself gives for the flange.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlangeColumns {
    /// Names in the header: x, y, z in the robot's base.
    pub columns: [String; 3],
    /// Unit of their values.
    pub unit: LengthUnit,
}

/// Which columns hold what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredLengthMapping {
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// The measured length.
    pub length: LengthColumn,
    /// Joints 1 to 6, in this order.
    pub joints: Vec<JointColumn>,
    /// The controller's own position, where the file has it: rows that contradict their joint angles are then found.
    pub flange: Option<FlangeColumns>,
}

impl Validate for MeasuredLengthMapping {
    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        check_joints(&self.joints)
    }
}

/// One pose and the length measured there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredLength {
    /// Joint variables of the model \[rad\].
    pub q_rad: Joints,
    /// The measured length \[m\].
    pub length_m: f64,
    /// Where the controller says the flange is \[m\].
    pub flange_m: Option<[f64; 3]>,
    /// Line of the source file, so that a screened row can be found again.
    pub line: u64,
}

/// The rows of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredLengths {
    /// In the order of the file.
    pub rows: Vec<MeasuredLength>,
}

impl MeasuredLengths {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &MeasuredLengthMapping) -> Result<Self, LogError> {
        Self::read(&bytes_of(path)?, path, mapping)
    }

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &MeasuredLengthMapping) -> Result<Self, LogError> {
        let find = |table: &Table<'_>| Columns::find(table, mapping);
        rows(bytes, path, &mapping.csv, find, Columns::read).map(|rows| Self { rows })
    }
}

/// The mapping's columns, found in a file.
struct Columns<'a> {
    length: (Column, LengthUnit),
    joints: JointColumns<'a>,
    flange: Option<([Column; 3], LengthUnit)>,
}

impl<'a> Columns<'a> {
    fn find(table: &Table<'_>, mapping: &'a MeasuredLengthMapping) -> Result<Self, LogError> {
        let column = |name: &str| mapped(table, name);
        let flange = match &mapping.flange {
            Some(FlangeColumns { columns: [x, y, z], unit }) => {
                Some(([column(x)?, column(y)?, column(z)?], *unit))
            }
            None => None,
        };
        Ok(Self {
            length: (column(&mapping.length.column)?, mapping.length.unit),
            joints: JointColumns::find(table, &mapping.joints)?,
            flange,
        })
    }

    fn read(&self, table: &Table<'_>, row: &Row) -> Result<MeasuredLength, LogError> {
        let (length, unit) = &self.length;
        let length_m = table.number(row, length)? * unit.to_m();
        if !(0.0..=LENGTH_M_MAX).contains(&length_m) {
            return Err(table.bad(
                row,
                length,
                format!("{length_m} m is no length that is measured here (0 to {LENGTH_M_MAX} m)"),
                "check the length's unit in the mapping file",
            ));
        }
        let q_rad = self.joints.read(table, row)?;
        let flange_m = match &self.flange {
            Some((columns, unit)) => {
                let mut flange_m = [0.0; 3];
                for (value_m, column) in flange_m.iter_mut().zip(columns) {
                    *value_m = table.number(row, column)? * unit.to_m();
                }
                Some(flange_m)
            }
            None => None,
        };
        Ok(MeasuredLength { q_rad, length_m, flange_m, line: row.line })
    }
}
