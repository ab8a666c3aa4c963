//! Poses at which a tip on the flange touches a flat face: joints and the name of the face, and with a dial gauge its reading.
//!
//! Files differ, so a mapping in TOML names the columns and their units; `config/touch.toml` explains each key.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{Kind, Validate, Violation};

use super::pose_rows::{JointColumns, Names, check_joints, mapped, rows};
use crate::kinematics::Joints;
use crate::logs::source::Source;
use crate::logs::tables::csv_text::{Column, Row, Table};
use crate::logs::{CsvLayout, JointColumn, LengthUnit, LogError};

/// Largest reading of a gauge \[m\]; more means a wrong unit.
const READING_M_MAX: f64 = 0.2;

/// The column of a gauge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReadingColumn {
    /// Name in the header.
    pub column: String,
    /// Unit of its values.
    pub unit: LengthUnit,
}

/// Columns of a table of touched faces.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TouchMapping {
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// The column with the face's name.
    pub face: String,
    /// Column of a dial gauge's reading.
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

/// One pose with the tip on a face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TouchedRow {
    /// Joint variables of the model \[rad, m\].
    pub q_rad: Joints,
    /// The face, by its place in [`Touches::faces`].
    pub face: usize,
    /// How far the plunger is pushed in \[m\]; zero without a gauge.
    pub reading_m: f64,
    /// Line of the source file, so that a row can be found again.
    pub line: u64,
}

/// The rows of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Touches {
    /// Rows in the order of the file, which is that of the robot's motion: backlash depends on the previous pose.
    pub rows: Vec<TouchedRow>,
    /// Names of the faces, in the order in which the file names them.
    pub faces: Vec<String>,
}

impl Touches {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &TouchMapping) -> Result<Self, LogError> {
        Self::read(&Source::open(path)?.whole()?, path, mapping)
    }

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &TouchMapping) -> Result<Self, LogError> {
        type Found<'a> = (Column, Option<(Column, LengthUnit)>, JointColumns<'a>);
        let find = |table: &Table<'_>| -> Result<Found<'_>, LogError> {
            let face = mapped(table, &mapping.face)?;
            let gauge = |gauge: &ReadingColumn| Ok((mapped(table, &gauge.column)?, gauge.unit));
            let reading = mapping.reading.as_ref().map(gauge).transpose()?;
            Ok((face, reading, JointColumns::find(table, &mapping.joints)?))
        };
        let mut names = Names::default();
        let read = |(face, reading, joints): &mut Found<'_>, table: &Table<'_>, row: &Row| {
            let face = names.place(table, row, Some(&*face))?;
            let reading_m = match reading {
                Some((column, unit)) => {
                    let reading_m = table.number(row, column)? * unit.to_m();
                    if reading_m.abs() > READING_M_MAX {
                        let problem = format!("the gauge reads {reading_m} m");
                        let remedy = "check the reading's unit in the mapping file";
                        return Err(table.bad(row, column, problem, remedy));
                    }
                    reading_m
                }
                None => 0.0,
            };
            Ok(TouchedRow { q_rad: joints.read(table, row)?, face, reading_m, line: row.line })
        };
        let rows = rows(Source::in_memory(bytes, path), &mapping.csv, find, read)?;
        Ok(Self { rows, faces: names.in_order() })
    }
}
