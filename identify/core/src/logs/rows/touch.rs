//! Reads tables of poses at which a tip on the flange touches something fixed. Each row has the joints and the name of the
//! touched part. A ball is seated in a socket ([`ContactMapping`]). A probe touches a flat face ([`TouchMapping`]), and may
//! have a dial gauge, whose reading is then in the row.
//!
//! Files have different columns, so a mapping in TOML names the columns and their units. `config/contact.toml` and
//! `config/touch.toml` explain each key.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{Kind, Validate, Violation};

use super::pose_rows::{JointColumns, Names, REMEDY, check_joints, rows};
use crate::kinematics::Joints;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::{CsvLayout, JointColumn, LengthUnit, LogError};

/// Largest absolute reading of a gauge \[m\]. A larger number means that the unit is wrong.
const READING_M_MAX: f64 = 0.2;

/// A pose of the robot at which the tip touches a socket or a face.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TipRow {
    /// Joint variables of the model \[rad, m\].
    pub joints_rad: Joints,
    /// Index of the socket or face in the list of names.
    pub part: usize,
    /// Travel of a gauge's plunger along the face's normal, positive inwards \[m\]; zero without a gauge.
    pub reading_m: f64,
    /// Line number in the file, by which messages name the row.
    pub line: u64,
}

/// Describes how to read a table of balls seated in sockets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactMapping {
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Column with the name of the socket.
    pub socket: String,
    /// All joints, base to flange.
    pub joints: Vec<JointColumn>,
}

impl Validate for ContactMapping {
    const KIND: Option<Kind> = Some(Kind::ContactMapping);

    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        check_joints(&self.joints)
    }
}

impl ContactMapping {
    /// Reads the table at `path`. `sockets` are the known names of sockets. The rows are in the order of the file. It must
    /// be the order of the robot's motion, because backlash depends on the previous pose.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(&self, path: &Path, sockets: &[&str]) -> Result<Vec<TipRow>, LogError> {
        self.read(&LogSource::open(path)?.whole()?, path, sockets)
    }

    /// Like [`Self::load`], but for bytes in memory. `path` is only used in error messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(&self, bytes: &[u8], path: &Path, sockets: &[&str]) -> Result<Vec<TipRow>, LogError> {
        let socket = |row: &CsvRow<'_>, column: &CsvColumn| {
            let name = row.text(column);
            sockets.iter().position(|known| *known == name).ok_or_else(|| {
                let known = sockets.join(", ");
                let problem = format!("no socket is called `{name}`; the table of sockets has {known}");
                row.bad(column, problem, "correct the name here, or give the socket there")
            })
        };
        tip_rows(LogSource::in_memory(bytes, path), &self.csv, (&*self.socket, None, &*self.joints), socket)
    }
}

/// The column of a gauge's reading.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReadingColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of the values in the column.
    pub unit: LengthUnit,
}

/// Describes how to read a table of touched faces.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TouchMapping {
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Column with the name of the face.
    pub face: String,
    /// Column of a dial gauge's reading; `None` without a gauge.
    pub reading: Option<ReadingColumn>,
    /// All joints, base to flange.
    pub joints: Vec<JointColumn>,
}

impl Validate for TouchMapping {
    const KIND: Option<Kind> = Some(Kind::TouchMapping);

    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        check_joints(&self.joints)
    }
}

/// A table of touched faces.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Touches {
    /// Rows in the order of the file. It must be the order of the robot's motion, because backlash depends
    /// on the previous pose.
    pub rows: Vec<TipRow>,
    /// Names of the faces, in the order in which they occur first in the file.
    pub faces: Vec<String>,
}

impl Touches {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &TouchMapping) -> Result<Self, LogError> {
        Self::read(&LogSource::open(path)?.whole()?, path, mapping)
    }

    /// Like [`Self::load`], but for bytes in memory. `path` is only used in error messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &TouchMapping) -> Result<Self, LogError> {
        let mut names = Names::default();
        let face = |row: &CsvRow<'_>, column: &CsvColumn| names.place(row, Some(column));
        let columns = (&*mapping.face, mapping.reading.as_ref(), &*mapping.joints);
        let rows = tip_rows(LogSource::in_memory(bytes, path), &mapping.csv, columns, face)?;
        Ok(Self { rows, faces: names.in_order() })
    }
}

/// Reads all rows of a table. Its columns are the name of the touched part, the reading of a gauge if there is one, and the
/// joints. `part` returns the index of the part of a row.
fn tip_rows(
    source: LogSource<'_>,
    layout: &CsvLayout,
    (name, gauge, joints): (&str, Option<&ReadingColumn>, &[JointColumn]),
    mut part: impl FnMut(&CsvRow<'_>, &CsvColumn) -> Result<usize, LogError>,
) -> Result<Vec<TipRow>, LogError> {
    let mut table = CsvTable::open(source, layout)?;
    let name = table.column(name, REMEDY)?;
    let gauge = gauge.map(|gauge| Ok((table.column(&gauge.column, REMEDY)?, gauge.unit))).transpose()?;
    let joints = JointColumns::find(&table, joints)?;
    rows(&mut table, |row| {
        let part = part(row, &name)?;
        let mut reading_m = 0.0;
        if let Some((column, unit)) = &gauge {
            reading_m = row.number(column)? * unit.to_m();
            if reading_m.abs() > READING_M_MAX {
                let problem = format!("the gauge reads {reading_m} m");
                let remedy = "check the reading's unit in the mapping file";
                return Err(row.bad(column, problem, remedy));
            }
        }
        Ok(TipRow { joints_rad: joints.read(row)?, part, reading_m, line: row.line })
    })
}
