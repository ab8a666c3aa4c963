//! Poses with one measured length each: a draw-wire sensor or a telescoping bar without encoders.
//!
//! There is no common file format, so a mapping in TOML says which columns to read and how. An example that explains
//! each key is `config/measured_length.toml`.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, Validate, Violation};

use super::LogError;
use super::csv_text::{Column, Format, Row, Table, decode};

/// Fewest rows that make a table.
pub(super) const ROWS_MIN: usize = 10;
/// No joint turns further than this from its zero \[rad\]; more means a wrong unit.
const JOINT_RAD_MAX: f64 = 4.0 * std::f64::consts::PI;
/// No wire or bar is longer \[m\]; more means a wrong unit.
const LENGTH_M_MAX: f64 = 20.0;

/// Unit of a length column.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LengthUnit {
    /// Metres.
    M,
    /// Millimetres.
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

/// The column of the measured length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LengthColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of its values.
    pub unit: LengthUnit,
}

/// The column of one joint: `q = sign * (value * unit - offset)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of its values.
    pub unit: AngleUnit,
    /// +1, or -1 where the file counts the other way than the model.
    #[serde(default = "positive")]
    pub sign: f64,
    /// Value of the file at the model's zero \[deg\].
    #[serde(default)]
    pub offset_deg: f64,
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
    /// Character between cells; one ASCII character.
    #[serde(default = "comma")]
    pub delimiter: char,
    /// Numbers are written `1,5`.
    #[serde(default)]
    pub decimal_comma: bool,
    /// The measured length.
    pub length: LengthColumn,
    /// Joints 1 to 6, in this order.
    pub joints: Vec<JointColumn>,
    /// The controller's own position, where the file has it: rows that contradict their joint angles are then found.
    pub flange: Option<FlangeColumns>,
}

fn positive() -> f64 {
    1.0
}

pub(super) fn comma() -> char {
    ','
}

impl Validate for MeasuredLengthMapping {
    fn validate(&self) -> Result<(), Violation> {
        check_format(self.delimiter, self.decimal_comma)?;
        check_joints(&self.joints)
    }
}

/// A delimiter that can separate the cells.
pub(super) fn check_format(delimiter: char, decimal_comma: bool) -> Result<(), Violation> {
    if !delimiter.is_ascii() || matches!(delimiter, '"' | '#' | '\n' | '\r') {
        return Err(Violation::new(
            "delimiter",
            format!("`{}` cannot separate cells", delimiter.escape_default()),
            "use \",\", \";\" or \"\\t\"",
        ));
    }
    if decimal_comma && delimiter == ',' {
        return Err(Violation::new(
            "delimiter",
            "a comma separates cells and decimals alike",
            "files with decimal commas mostly have delimiter = \";\"",
        ));
    }
    Ok(())
}

/// Six joints with signs and offsets that are some.
pub(super) fn check_joints(joints: &[JointColumn]) -> Result<(), Violation> {
    if joints.len() != 6 {
        return Err(Violation::new(
            "joints",
            format!("{} joints are given", joints.len()),
            "write one [[joints]] block for each of the six joints",
        ));
    }
    for (index, joint) in joints.iter().enumerate() {
        if joint.sign.abs() != 1.0 {
            return Err(Violation::new(
                format!("joints[{index}].sign"),
                format!("{} is no sign", joint.sign),
                "write 1 or -1",
            ));
        }
        if !(-360.0..=360.0).contains(&joint.offset_deg) {
            return Err(Violation::new(
                format!("joints[{index}].offset_deg"),
                format!("{} is out of range (at most 360)", joint.offset_deg),
                "offsets are in degrees",
            ));
        }
    }
    Ok(())
}

/// One pose and the length measured there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredLength {
    /// Joint variables of the model \[rad\].
    pub q_rad: [f64; 6],
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
        let bytes =
            std::fs::read(path).map_err(|source| LogError::Unreadable { path: path.to_owned(), source })?;
        Self::read(&bytes, path, mapping)
    }

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &MeasuredLengthMapping) -> Result<Self, LogError> {
        let text = decode(bytes, path)?;
        let format = Format { delimiter: mapping.delimiter as u8, decimal_comma: mapping.decimal_comma };
        let mut table = Table::open(text, path, format)?;
        let columns = Columns::find(&table, mapping)?;
        let mut rows = Vec::new();
        while let Some(row) = table.next_row() {
            rows.push(columns.read(&table, &row?)?);
        }
        if rows.len() < ROWS_MIN {
            return Err(LogError::TooFewRows { path: path.to_owned(), rows: rows.len(), needed: ROWS_MIN });
        }
        Ok(Self { rows })
    }
}

/// The joints' columns, found in a file.
pub(super) struct JointColumns<'a>(Vec<(Column, &'a JointColumn)>);

impl<'a> JointColumns<'a> {
    pub(super) fn find(table: &Table<'_>, joints: &'a [JointColumn]) -> Result<Self, LogError> {
        let found = joints.iter().map(|joint| Ok((mapped(table, &joint.column)?, joint)));
        found.collect::<Result<_, LogError>>().map(Self)
    }

    /// Joint variables of a row \[rad\].
    pub(super) fn read(&self, table: &Table<'_>, row: &Row) -> Result<[f64; 6], LogError> {
        let mut q_rad = [0.0; 6];
        for (q, (column, joint)) in q_rad.iter_mut().zip(&self.0) {
            let value_rad = table.number(row, column)? * joint.unit.to_rad();
            *q = joint.sign * (value_rad - joint.offset_deg.to_radians());
            if q.abs() > JOINT_RAD_MAX {
                return Err(table.bad(
                    row,
                    column,
                    format!("{:.1} rad is more than two turns", *q),
                    "the column looks like degrees: check the joint's unit in the mapping file",
                ));
            }
        }
        Ok(q_rad)
    }
}

/// A column that the mapping names.
pub(super) fn mapped(table: &Table<'_>, name: &str) -> Result<Column, LogError> {
    table.column(name, "Correct the column's name in the mapping file, or the header.")
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
