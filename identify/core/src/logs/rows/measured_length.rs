//! Reads tables of measured lengths. Each row is a pose of the robot with the length of a draw-wire sensor or of a
//! telescoping bar without encoders.
//!
//! Instruments write different columns, so a mapping in TOML names the columns and their units.
//! `config/measured_length.toml` explains each key.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{Kind, Validate, Violation};

use super::pose_rows::{
    JointColumns, REMEDY, SetUpNames, check_joints, check_scale_u, is_zero, rows, uncertainty,
};
use crate::kinematics::Joints;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::{CsvLayout, JointColumn, LengthUnit, LogError, PositionColumns};
use crate::model::SetUp;

/// Largest length of a wire or bar \[m\]. A larger number means that the unit is wrong.
const LENGTH_M_MAX: f64 = 20.0;
/// Largest absolute value of `offset_mm`.
const OFFSET_MM_MAX: f64 = 1e3 * LENGTH_M_MAX;

/// The column of the measured length.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LengthColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of the values in the column.
    pub unit: LengthUnit,
    /// Known constant error \[mm\], which is subtracted from every length.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub offset_mm: f64,
}

/// The column of the standard uncertainty of each row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LengthUncertaintyColumn {
    /// Name in the header. The values are in mm.
    pub length_mm: String,
}

/// Describes how to read a table of measured lengths.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredLengthMapping {
    /// Standard uncertainty of the wire's scale \[ppm\]. If absent, it is that of a usual wire. 0 means that
    /// the scale is exact.
    pub scale_u_ppm: Option<f64>,
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Column of the measured length.
    pub length: LengthColumn,
    /// All joints, base to flange.
    pub joints: Vec<JointColumn>,
    /// Columns with the controller's position of the flange in the robot's base. Rows are not used if this
    /// position contradicts the joints.
    pub flange: Option<PositionColumns>,
    /// Column of the uncertainty of each row, if the file has this column.
    pub uncertainty: Option<LengthUncertaintyColumn>,
    /// Column with the name of the anchor, if there are several.
    pub anchor: Option<String>,
    /// Column with the name of the attachment on the flange, if there are several.
    pub attachment: Option<String>,
}

impl Validate for MeasuredLengthMapping {
    const KIND: Option<Kind> = Some(Kind::WireMapping);

    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        check_scale_u(self.scale_u_ppm)?;
        let remedy = "write the constant error of the lengths in mm, or leave it out";
        Violation::unless_within(
            "length.offset_mm",
            self.length.offset_mm,
            [-OFFSET_MM_MAX, OFFSET_MM_MAX],
            remedy,
        )?;
        check_joints(&self.joints)
    }
}

/// A pose of the robot, with the length measured at this pose.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LengthRow {
    /// Joint variables of the model \[rad, m\].
    pub joints_rad: Joints,
    /// Measured length \[m\].
    pub length_m: f64,
    /// Flange position from the controller \[m\].
    pub flange_m: Option<[f64; 3]>,
    /// Standard uncertainty of the length \[m\]; `None` if the file does not contain it.
    pub uncertainty_m: Option<f64>,
    /// Indices of the anchor (as station) and the attachment (as target) in [`MeasuredLengths`]; 0 if the file
    /// does not name them.
    pub set_up: SetUp,
    /// Line number in the file, by which reports name the row.
    pub line: u64,
}

/// A table of measured lengths.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredLengths {
    /// Rows in the order of the file.
    pub rows: Vec<LengthRow>,
    /// Names of the anchors in the order of the file; empty if the file does not name anchors.
    pub anchors: Vec<String>,
    /// Names of the attachments in the order of the file; empty if the file does not name attachments.
    pub attachments: Vec<String>,
}

impl MeasuredLengths {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &MeasuredLengthMapping) -> Result<Self, LogError> {
        Self::read(&LogSource::open(path)?.whole()?, path, mapping)
    }

    /// Like [`Self::load`], but for bytes in memory. `path` is only used in error messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &MeasuredLengthMapping) -> Result<Self, LogError> {
        let mut table = CsvTable::open(LogSource::in_memory(bytes, path), &mapping.csv)?;
        let columns = LengthTableColumns::find(&table, mapping)?;
        let mut names = SetUpNames::default();
        let rows = rows(&mut table, |row| columns.read(row, &mut names))?;
        let [anchors, attachments] = names.in_order();
        Ok(Self { rows, anchors, attachments })
    }
}

/// The columns of a mapping in an open table.
struct LengthTableColumns<'a> {
    length: (CsvColumn, &'a LengthColumn),
    uncertainty: Option<CsvColumn>,
    /// Columns with the names of anchor and attachment.
    set_up: [Option<CsvColumn>; 2],
    joints: JointColumns<'a>,
    flange: Option<([CsvColumn; 3], LengthUnit)>,
}

impl<'a> LengthTableColumns<'a> {
    fn find(table: &CsvTable<'_>, mapping: &'a MeasuredLengthMapping) -> Result<Self, LogError> {
        let column = |name: &str| table.column(name, REMEDY);
        let flange = mapping.flange.as_ref().map(|flange| {
            let [x, y, z] = flange.columns.each_ref().map(|name| column(name));
            Ok(([x?, y?, z?], flange.unit))
        });
        let uncertainty = mapping.uncertainty.as_ref().map(|uncertainty| &uncertainty.length_mm);
        Ok(Self {
            length: (column(&mapping.length.column)?, &mapping.length),
            joints: JointColumns::find(table, &mapping.joints)?,
            flange: flange.transpose()?,
            uncertainty: table.if_named(uncertainty, REMEDY)?,
            set_up: [
                table.if_named(mapping.anchor.as_ref(), REMEDY)?,
                table.if_named(mapping.attachment.as_ref(), REMEDY)?,
            ],
        })
    }

    fn read(&self, row: &CsvRow<'_>, names: &mut SetUpNames) -> Result<LengthRow, LogError> {
        let set_up = names.place(row, &self.set_up)?;
        let (column, LengthColumn { unit, offset_mm, .. }) = &self.length;
        let length_m = row.number(column)? * unit.to_m() - offset_mm * 1e-3;
        if !(length_m > 0.0 && length_m <= LENGTH_M_MAX) {
            return Err(row.bad(
                column,
                format!("the length {length_m} m must be above 0 and at most {LENGTH_M_MAX} m"),
                "check `unit` and `offset_mm` under [length] in the mapping file, or remove the row",
            ));
        }
        let joints_rad = self.joints.read(row)?;
        let flange_m = match &self.flange {
            Some(([x, y, z], unit)) => {
                let number_m = |column: &CsvColumn| Ok(row.number(column)? * unit.to_m());
                Some([number_m(x)?, number_m(y)?, number_m(z)?])
            }
            None => None,
        };
        let uncertainty_m = uncertainty(row, self.uncertainty.as_ref())?;
        Ok(LengthRow { joints_rad, length_m, flange_m, uncertainty_m, set_up, line: row.line })
    }
}
