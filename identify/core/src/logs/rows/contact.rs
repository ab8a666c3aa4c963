//! Poses at which a ball on the flange is seated in a socket: joints and the name of the socket.
//!
//! Files differ, so a mapping in TOML names the columns and their units; `config/contact.toml` explains each key.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{Kind, Validate, Violation};

use super::pose_rows::{JointColumns, check_joints, mapped, rows};
use crate::kinematics::Joints;
use crate::logs::source::Source;
use crate::logs::tables::csv_text::{Column, Row, Table};
use crate::logs::{CsvLayout, JointColumn, LogError};

/// Columns of a table of seated balls.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactMapping {
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// The column with the socket's name.
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

/// One pose with a ball seated in a socket.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeatedRow {
    /// Joint variables of the model \[rad, m\].
    pub q_rad: Joints,
    /// The socket, by its place among the names that the file was read with.
    pub socket: usize,
    /// Line of the source file, so that a row can be found again.
    pub line: u64,
}

/// The rows of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Contacts {
    /// Rows in the order of the file, which is that of the robot's motion: backlash depends on the previous pose.
    pub rows: Vec<SeatedRow>,
}

impl Contacts {
    /// Reads the table at `path`, with these names of the sockets.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &ContactMapping, sockets: &[&str]) -> Result<Self, LogError> {
        Self::read(&Source::open(path)?.whole()?, path, mapping, sockets)
    }

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(
        bytes: &[u8],
        path: &Path,
        mapping: &ContactMapping,
        sockets: &[&str],
    ) -> Result<Self, LogError> {
        let find = |table: &Table<'_>| {
            Ok((mapped(table, &mapping.socket)?, JointColumns::find(table, &mapping.joints)?))
        };
        let read = |(socket, joints): &mut (Column, JointColumns<'_>), table: &Table<'_>, row: &Row| {
            let name = table.text(row, socket);
            let Some(number) = sockets.iter().position(|known| *known == name) else {
                let problem =
                    format!("no socket is called `{name}`; the table of sockets has {}", sockets.join(", "));
                return Err(table.bad(
                    row,
                    socket,
                    problem,
                    "correct the name here, or give the socket there",
                ));
            };
            Ok(SeatedRow { q_rad: joints.read(table, row)?, socket: number, line: row.line })
        };
        rows(Source::in_memory(bytes, path), &mapping.csv, find, read).map(|rows| Self { rows })
    }
}
