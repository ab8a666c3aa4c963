//! Simulated rows: what those of a ball in sockets and of a touch probe have in common, and the lengths of a draw-wire.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Point3, Vector3};
use rand::Rng;
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use shared::config::RobotConfig;

use super::arm::{Arm, ArmErrors};
use super::{Experiment, SimulateError, Stream, Truth, WriteError, is_size, random};
use crate::instrument::LengthRow;
use crate::kinematics::{Chain, Joints, flange_chain};
use crate::logs::{JointColumn, LogError, SIMULATED};
use crate::model::{Geometry, Model, ParameterId};

/// What a simulated experiment gives: `R` is a row, `T` the table of what is known of sockets or faces.
#[derive(Debug, Clone)]
pub struct SimulatedRows<R, T> {
    /// Rows in the order of the robot's motion.
    pub rows: Vec<R>,
    /// What is known of the sockets or faces.
    pub table: T,
    /// What a calibration should find.
    pub truth: RowTruth,
    /// The robot with its errors.
    pub robot: Chain,
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
    /// All parameters of a geometry, with the errors of the arm's gears.
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
    /// The table has no places.
    #[error(
        "a table of distances does not contain the places of the sockets; give one with a [[socket]] block for each of at least two"
    )]
    NoPlaces,
    /// A size that is negative or not finite.
    #[error("{name} is {value}; give a finite number that is not negative")]
    Size {
        /// Name of the option.
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// The robot does not get there.
    #[error(
        "the robot does not reach {place} from above within its limits; give another --place or a smaller {size}"
    )]
    Unreachable {
        /// Such as "socket `A`".
        place: String,
        /// What may be smaller.
        size: &'static str,
    },
}

/// Sizes of an experiment by their options.
pub(super) fn check_sizes(
    errors: &ArmErrors,
    others: &[(&'static str, f64)],
) -> Result<(), RowSimulationError> {
    let wrong = errors.sizes().into_iter().chain(others.iter().copied()).find(|(_, size)| !is_size(*size));
    wrong.map_or(Ok(()), |(name, value)| Err(RowSimulationError::Size { name, value }))
}

/// The text of simulated rows. `command` has made them, `columns` are those after the joints, `row` gives joints and the other cells.
pub(super) fn rows_csv<'r, R: 'r>(
    command: &str,
    (joints, columns): (&[JointColumn], &str),
    rows: &'r [R],
    row: impl Fn(&'r R) -> (&'r Joints, String),
) -> String {
    let mut table = format!("# {SIMULATED}: identify simulate {command}\n");
    table.extend(joints.iter().map(|joint| format!("{},", joint.column)));
    table += &format!("{columns}\n");
    for (joints_rad, cells) in rows.iter().map(row) {
        table.extend(
            joints_rad.iter().zip(joints).map(|(q, joint)| format!("{:.9},", q / joint.unit.to_si())),
        );
        table += &format!("{cells}\n");
    }
    table
}

/// Writes texts by their names into `directory`, which is made if it is missing; returns their paths.
pub(super) fn write_texts<const N: usize>(
    directory: &Path,
    files: [(&str, String); N],
) -> Result<[PathBuf; N], WriteError> {
    let unwritable = |path: PathBuf| move |source| LogError::Unwritable { path, source };
    std::fs::create_dir_all(directory).map_err(unwritable(directory.to_owned()))?;
    for (name, text) in &files {
        let path = directory.join(name);
        std::fs::write(&path, text).map_err(unwritable(path))?;
    }
    Ok(files.map(|(name, _)| directory.join(name)))
}

/// Where the wire is held, in the flange's frame \[m\].
pub const ATTACHMENT_M: [f64; 3] = [0.12, 0.03, 0.05];
/// The wire comes out of the instrument there, in the robot's base \[m\].
const ANCHOR_M: [f64; 3] = [0.6, -1.1, 0.1];
/// The instrument shows so much more than the wire's length \[m\].
const OFFSET_M: f64 = 0.15;

/// `count` random postures within the joint limits, each with the length that an instrument with this noise \[m\] shows; and what
/// is true of the robot to its flange.
///
/// # Errors
/// [`SimulateError`] where the experiment makes no sense.
pub fn wire_rows(
    experiment: &Experiment<'_>,
    count: usize,
    noise_m: f64,
) -> Result<(Vec<LengthRow>, Truth), SimulateError> {
    experiment.check()?;
    let (flange, [_, bar]) = (flange_chain(experiment.robot), experiment.nominal());
    let truth = Truth::new(experiment, &flange, &bar);
    let robot = truth.robot_chain(&flange);
    let limits = experiment.robot.joint_limits();
    let mut postures = random(experiment.seed, Stream::Postures);
    let mut noise = random(experiment.seed, Stream::Wire);
    let mut reading = experiment.robot_reading();
    let row = |_| {
        let q_rad = Joints::random(&limits, &mut postures);
        let held: Vector3<f64> = (robot.forward(&q_rad) * Point3::from(ATTACHMENT_M)).coords;
        let error_m = noise_m * noise.sample::<f64, _>(StandardNormal);
        let length_m = (held - Vector3::from(ANCHOR_M)).norm() + OFFSET_M + error_m;
        LengthRow { joints_rad: reading.of(&q_rad), length_m, ..LengthRow::default() }
    };
    Ok(((0..count).map(row).collect(), truth))
}
