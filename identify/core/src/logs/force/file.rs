//! Reads a force from a separate file, such as the log of a load cell.
//!
//! The file is a table with time stamps in the column `t_s` and the columns of [`ForceLayout::find_usual`]. With a comment
//! `# clock: bar` the stamps are on the ball-bar's clock (UTC), otherwise on the robot's clock. A [`ForceLogMapping`]
//! describes tables with other columns. The result is a [`ForceLog`] in newtons or newton metres.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::config::{RobotConfig, Validate, Violation};

use super::columns::{ForceColumns, ForceLayout, unknown};
use super::{ForceClock, ForceKind, ForceLog};
use crate::kinematics::Joints;
use crate::logs::robot::mapping::CsvLayout;
use crate::logs::robot::table::TIME_COLUMN;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::CsvTable;
use crate::logs::tables::stamp::{StampColumn, TimeColumn, TimeUnit};
use crate::logs::{JointConversion, LogError, ROWS_MIN, Stream};

/// Describes how to read a force from a table. `config/force_log.toml` explains each key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForceLogMapping {
    /// Clock of the stamps.
    #[serde(default)]
    pub clock: ForceClock,
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Column and unit of the stamps.
    pub time: TimeColumn,
    /// Columns of the force.
    pub force: ForceColumns,
}

impl Validate for ForceLogMapping {
    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        self.time.check()?;
        self.force.check()?;
        let remedy = "name the columns of the force; without any it is read from a robot's log";
        Violation::unless(!self.force.columns.is_empty(), "force.columns", "there are none", remedy)
    }
}

impl ForceLog {
    /// Reads the file at `path`. Torques in the file are on the axes of the robot's log; they are converted
    /// to the model's joints.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(
        path: &Path,
        robot: &RobotConfig,
        mapping: Option<&ForceLogMapping>,
    ) -> Result<Self, LogError> {
        Self::read_from(LogSource::open(path)?, robot, mapping)
    }

    /// Like [`Self::load`], but for bytes in memory. `path` is only used in error messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(
        bytes: &[u8],
        path: &Path,
        robot: &RobotConfig,
        mapping: Option<&ForceLogMapping>,
    ) -> Result<Self, LogError> {
        Self::read_from(LogSource::in_memory(bytes, path), robot, mapping)
    }

    fn read_from(
        source: LogSource<'_>,
        robot: &RobotConfig,
        mapping: Option<&ForceLogMapping>,
    ) -> Result<Self, LogError> {
        let path = source.path;
        let mut table =
            CsvTable::open(source, mapping.map_or(&CsvLayout::default(), |mapping| &mapping.csv))?;
        let own_time = TimeColumn::new(TIME_COLUMN, TimeUnit::S);
        let time = mapping.map_or(&own_time, |mapping| &mapping.time);
        let remedy =
            "Name the column of time stamps `t_s` (seconds), or name it in a mapping (--force-mapping).";
        let stamps = StampColumn::find(&table, time, remedy)?;
        let layout = match mapping {
            Some(mapping) => ForceLayout::find_named(&table, path, &mapping.force, robot)?,
            None => ForceLayout::find_usual(&table, robot)?,
        };
        let layout = layout.ok_or_else(|| unknown(&table, path))?;
        let forces = rows(&mut table, path, stamps, &layout)?;
        let clock = mapping.map_or_else(|| declared_clock(&table, path), |mapping| Ok(mapping.clock))?;
        Self::new(clock, layout.kind(&table)?, forces).on_joints(robot)
    }

    /// Converts torques on the axes of the robot's log to those of the model's joints.
    fn on_joints(mut self, robot: &RobotConfig) -> Result<Self, LogError> {
        if self.kind == ForceKind::JointTorques {
            let conversion = JointConversion::from_robot(robot)?;
            self.values.iter_mut().for_each(|row| *row = conversion.to_joint_torque(row));
        }
        Ok(self)
    }
}

/// The clock that a comment in the table names; without such a comment, the robot's.
fn declared_clock(table: &CsvTable<'_>, path: &Path) -> Result<ForceClock, LogError> {
    let Some(name) = table.comment("clock") else {
        return Ok(ForceClock::default());
    };
    let known = [ForceClock::Robot, ForceClock::Bar]
        .into_iter()
        .find(|clock| name.eq_ignore_ascii_case(clock.name()));
    let remedy = "write `# clock: robot` or `# clock: bar`: stamps must be of one of the two, whose relation is found \
                  from the motion";
    known.ok_or_else(|| LogError::content(path, format!("its clock is `{name}`"), remedy))
}

/// All rows of the table \[N or N m\], without rows that have the same stamp and values as the row before.
fn rows(
    table: &mut CsvTable<'_>,
    path: &Path,
    mut stamps: StampColumn,
    layout: &ForceLayout,
) -> Result<Stream<Joints>, LogError> {
    let mut forces = Stream::default();
    let mut before: Option<(i64, u64)> = None;
    while let Some(row) = table.next_row()? {
        let stamp = stamps.next_ns(&row)?;
        let values = layout.row(&row)?;
        match before {
            // A logger that polls faster than its source updates writes the same row several times.
            Some((last, _)) if stamp == last && forces.last() == Some(&values) => continue,
            Some((last, line)) if stamp <= last => {
                return Err(LogError::time_not_increasing(path, "line", (line, last), (row.line, stamp)));
            }
            _ => {}
        }
        before = Some((stamp, row.line));
        forces.push(stamp, values);
    }
    LogError::unless_enough(path, forces.len(), ROWS_MIN)?;
    Ok(forces)
}
