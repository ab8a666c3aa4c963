//! Results of simulated contacts (a ball in sockets) and touches (a touch probe): rows, true values, errors, and files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared::config::{self, RobotConfig};

use super::arm::{Arm, ArmErrors};
use super::{SimulationWriteError, is_size};
use crate::kinematics::Chain;
use crate::logs::{JointColumn, LogError, SIMULATED, TipRow};
use crate::model::{Geometry, Model, ParameterId};

/// Result of a simulated experiment. `T` is the type of the table of sockets or faces.
#[derive(Debug, Clone)]
pub struct SimulatedRows<T> {
    /// Rows in the order of the robot's motion.
    pub rows: Vec<TipRow>,
    /// Table of the sockets or faces, with their known geometry.
    pub table: T,
    /// True parameters of robot and instrument.
    pub truth: RowTruth,
    /// The robot with its errors.
    pub robot: Chain,
}

impl<T: Serialize> SimulatedRows<T> {
    /// Writes four files to `directory`: `rows`, their mapping, the table, and `truth.toml`. Creates the directory if it
    /// does not exist. Returns the paths of the files.
    pub(super) fn write(
        &self,
        directory: &Path,
        [rows_file, mapping_file, table_file]: [&str; 3],
        rows: String,
        mapping: &impl Serialize,
    ) -> Result<[PathBuf; 4], SimulationWriteError> {
        let files = [
            (rows_file, rows),
            (mapping_file, config::to_toml(mapping)?),
            (table_file, config::to_toml(&self.table)?),
            ("truth.toml", config::to_toml(&self.truth)?),
        ];
        let unwritable = |path: PathBuf| move |source| LogError::Unwritable { path, source };
        std::fs::create_dir_all(directory).map_err(unwritable(directory.to_owned()))?;
        for (name, text) in &files {
            let path = directory.join(name);
            std::fs::write(&path, text).map_err(unwritable(path))?;
        }
        Ok(files.map(|(name, _)| directory.join(name)))
    }
}

/// The true values of simulated rows.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RowTruth {
    /// The robot's name.
    pub robot: String,
    /// Seed of poses and noise.
    pub seed: u64,
    /// Names of the sockets in the order of their parameters.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sockets: Vec<String>,
    /// Names of the faces in the order of their parameters.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub faces: Vec<String>,
    /// True parameters by name \[m|rad\].
    pub parameters: BTreeMap<String, f64>,
}

impl RowTruth {
    /// Reads the true values of all parameters of the model from `geometry`, and adds the terms of the arm's gear errors.
    pub(super) fn new(
        robot: &RobotConfig,
        seed: u64,
        model: &Model,
        mut geometry: Geometry,
        arm: &Arm,
    ) -> Self {
        let ids = model.ids().into_iter().filter(|id| id.term().is_none());
        let value = |id: ParameterId| Some((id.to_string(), *geometry.parameter_mut(id)?));
        let parameters = ids.filter_map(value).chain(arm.gear_terms()).collect();
        Self { robot: robot.name.clone(), seed, parameters, ..Self::default() }
    }
}

/// Why rows cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum RowSimulationError {
    /// The table contains fewer than two positions of sockets.
    #[error(
        "the table of sockets has distances but no positions; give a table with a [[socket]] block for each socket, at least two"
    )]
    NoPlaces,
    /// A size that is negative or not finite.
    #[error("{name} is {value}; give a finite number that is not negative")]
    Size {
        /// Name of the option.
        name: &'static str,
        /// Value of the option.
        value: f64,
    },
    /// The robot cannot reach a position.
    #[error(
        "the robot does not reach {place} from above within its limits; give another --place or a smaller {size}"
    )]
    Unreachable {
        /// Name of the point, such as "socket `A`".
        place: String,
        /// Object or option whose size should be reduced.
        size: &'static str,
    },
}

/// Checks that all sizes of errors are finite and not negative. An error contains the name of the option.
pub(super) fn check_sizes(
    errors: &ArmErrors,
    others: &[(&'static str, f64)],
) -> Result<(), RowSimulationError> {
    let wrong = errors.sizes().into_iter().chain(others.iter().copied()).find(|(_, size)| !is_size(*size));
    wrong.map_or(Ok(()), |(name, value)| Err(RowSimulationError::Size { name, value }))
}

/// Text of a file with simulated rows. The first line names `command` as the origin of the file. Each row contains the
/// joints, in the units of `joints`, and then the text that `cells` returns for the columns `columns`.
pub(super) fn rows_csv(
    command: &str,
    (joints, columns): (&[JointColumn], &str),
    rows: &[TipRow],
    cells: impl Fn(&TipRow) -> String,
) -> String {
    let mut table = format!("# {SIMULATED}: identify simulate {command}\n");
    table.extend(joints.iter().map(|joint| format!("{},", joint.column)));
    table += &format!("{columns}\n");
    for row in rows {
        let joints = row.joints_rad.iter().zip(joints);
        table.extend(joints.map(|(q, joint)| format!("{:.9},", q / joint.unit.to_si())));
        table += &format!("{}\n", cells(row));
    }
    table
}
