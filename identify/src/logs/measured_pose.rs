//! Poses of the robot with the position, or the whole pose, that a tracker measured there.
//!
//! There is no common file format, so a mapping in TOML says which columns to read and how. An example that explains
//! each key is `config/measured_pose.toml`.

use std::path::Path;

use nalgebra::{Rotation3, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, Validate, Violation};

use super::csv_text::{Column, Format, Row, Table};
use super::pose_rows::{JointColumns, check_format, check_joints, comma, mapped, rows};
use super::{JointColumn, LengthUnit, LogError, bytes_of};

/// No tracker sees further \[m\]; more means a wrong unit.
const POSITION_M_MAX: f64 = 100.0;
/// No angle of an orientation is larger \[rad\]; more means a wrong unit.
const ANGLE_RAD_MAX: f64 = 2.0 * std::f64::consts::TAU;

/// The columns of the measured position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PositionColumns {
    /// Names in the header: x, y, z in the tracker's frame.
    pub columns: [String; 3],
    /// Unit of their values.
    pub unit: LengthUnit,
}

/// Which axes the angles of an orientation turn about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EulerFrame {
    /// Each turn is about an axis that the turns before it have moved (intrinsic): `R = R1 R2 R3`.
    Moving,
    /// All are about the tracker's own axes (extrinsic): `R = R3 R2 R1`.
    Fixed,
}

/// The columns of the measured orientation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RotationColumns {
    /// Names in the header: the first, second and third turn.
    pub columns: [String; 3],
    /// Unit of their values.
    pub unit: AngleUnit,
    /// Axes of the turns in the order of the columns, such as `xyz` or `zyz`.
    pub order: String,
    /// Whether the turns carry the axes along.
    pub frame: EulerFrame,
}

impl RotationColumns {
    /// Axes of the three turns; none where `order` is not an order.
    fn axes(&self) -> Option<[Vector3<f64>; 3]> {
        let axis = |letter: u8| match letter {
            b'x' => Some(Vector3::x()),
            b'y' => Some(Vector3::y()),
            b'z' => Some(Vector3::z()),
            _ => None,
        };
        let &[a, b, c] = self.order.as_bytes() else { return None };
        if a == b || b == c {
            return None;
        }
        Some([axis(a)?, axis(b)?, axis(c)?])
    }

    /// `tracker_from_probe` of three angles \[rad\].
    fn rotation(&self, angles_rad: [f64; 3]) -> Option<Rotation3<f64>> {
        let [first, second, third] = self.axes()?;
        let turn = |axis: Vector3<f64>, angle_rad: f64| Rotation3::new(axis * angle_rad);
        let [a, b, c] = [turn(first, angles_rad[0]), turn(second, angles_rad[1]), turn(third, angles_rad[2])];
        Some(match self.frame {
            EulerFrame::Moving => a * b * c,
            EulerFrame::Fixed => c * b * a,
        })
    }
}

/// Which columns hold what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredPoseMapping {
    /// Character between cells; one ASCII character.
    #[serde(default = "comma")]
    pub delimiter: char,
    /// Numbers are written `1,5`.
    #[serde(default)]
    pub decimal_comma: bool,
    /// The measured position.
    pub position: PositionColumns,
    /// The measured orientation; absent where only positions were measured.
    pub rotation: Option<RotationColumns>,
    /// Joints 1 to 6, in this order.
    pub joints: Vec<JointColumn>,
}

impl Validate for MeasuredPoseMapping {
    fn validate(&self) -> Result<(), Violation> {
        check_format("delimiter", self.delimiter, self.decimal_comma)?;
        if let Some(rotation) = &self.rotation
            && rotation.axes().is_none()
        {
            return Err(Violation::new(
                "rotation.order",
                format!("`{}` is no order of turns", rotation.order),
                "write three letters of x, y, z with different neighbours, such as \"xyz\"",
            ));
        }
        check_joints(&self.joints)
    }
}

/// A pose of the robot and what the tracker measured there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPose {
    /// Joint variables of the model \[rad\].
    pub q_rad: [f64; 6],
    /// Of the probe, in the tracker's frame \[m\].
    pub position_m: Vector3<f64>,
    /// `tracker_from_probe`, where the file has it.
    pub rotation: Option<Rotation3<f64>>,
    /// Line of the source file, so that a row can be found again.
    pub line: u64,
}

/// The rows of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredPoses {
    /// In the order of the file, which is that of the robot's motion: backlash goes by the pose before.
    pub rows: Vec<MeasuredPose>,
}

impl MeasuredPoses {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        Self::read(&bytes_of(path)?, path, mapping)
    }

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        let format = Format { delimiter: mapping.delimiter as u8, decimal_comma: mapping.decimal_comma };
        let find = |table: &Table<'_>| Columns::find(table, mapping);
        rows(bytes, path, format, find, Columns::read).map(|rows| Self { rows })
    }
}

/// The mapping's columns, found in a file.
struct Columns<'a> {
    position: ([Column; 3], LengthUnit),
    rotation: Option<([Column; 3], &'a RotationColumns)>,
    joints: JointColumns<'a>,
}

fn three(table: &Table<'_>, [a, b, c]: &[String; 3]) -> Result<[Column; 3], LogError> {
    Ok([mapped(table, a)?, mapped(table, b)?, mapped(table, c)?])
}

/// Three numbers of a row in SI units, none of them larger than `largest`.
fn numbers(
    table: &Table<'_>,
    row: &Row,
    columns: &[Column; 3],
    (to_si, si): (f64, &str),
    largest: f64,
) -> Result<[f64; 3], LogError> {
    let mut values = [0.0; 3];
    for (value, column) in values.iter_mut().zip(columns) {
        *value = table.number(row, column)? * to_si;
        if value.abs() > largest {
            return Err(table.bad(
                row,
                column,
                format!("{value:.3} {si} is more than anything measured here (at most {largest:.1} {si})"),
                "check the column's unit in the mapping file",
            ));
        }
    }
    Ok(values)
}

impl<'a> Columns<'a> {
    fn find(table: &Table<'_>, mapping: &'a MeasuredPoseMapping) -> Result<Self, LogError> {
        let rotation = match &mapping.rotation {
            Some(rotation) => Some((three(table, &rotation.columns)?, rotation)),
            None => None,
        };
        Ok(Self {
            position: (three(table, &mapping.position.columns)?, mapping.position.unit),
            rotation,
            joints: JointColumns::find(table, &mapping.joints)?,
        })
    }

    fn read(&self, table: &Table<'_>, row: &Row) -> Result<MeasuredPose, LogError> {
        let (columns, unit) = &self.position;
        let position_m = numbers(table, row, columns, (unit.to_m(), "m"), POSITION_M_MAX)?;
        let rotation = match &self.rotation {
            Some((columns, how)) => {
                let unit = (how.unit.to_rad(), "rad");
                how.rotation(numbers(table, row, columns, unit, ANGLE_RAD_MAX)?)
            }
            None => None,
        };
        let q_rad = self.joints.read(table, row)?;
        Ok(MeasuredPose { q_rad, position_m: position_m.into(), rotation, line: row.line })
    }
}
