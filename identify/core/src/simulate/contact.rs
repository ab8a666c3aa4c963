//! Simulates a robot with known errors that seats the ball on its flange in the sockets of a plate. The result is the input
//! of a calibration by contact, and the true parameters (`identify simulate contact`).

use std::path::{Path, PathBuf};

use nalgebra::{Point3, Vector3};
use shared::config::RobotConfig;

use super::SimulationWriteError;
use super::arm::ArmErrors;
use super::probing::{BALL_M, Probing, TRIES};
use super::rows::{RowSimulationError, RowTruth, SimulatedRows, check_sizes, rows_csv};
use crate::instrument::{KnownDistance, PlacedSocket, SocketTable};
use crate::kinematics::Pose;
use crate::logs::{ContactMapping, CsvLayout, TipRow, joint_columns};
use crate::model::{Model, Owner};

/// Side of the plate, as a fraction of the robot's reach.
const SIDE: f64 = 0.2;

/// All inputs of a simulated experiment with a ball in sockets. Equal experiments give equal results.
#[derive(Debug, Clone)]
pub struct ContactExperiment<'a> {
    /// Configuration of the nominal robot.
    pub robot: &'a RobotConfig,
    /// Nominal positions of the sockets; `None` for six sockets on several levels, scaled to the robot. The true positions
    /// differ from the nominal ones by random errors, with the standard deviation in the table.
    pub sockets: Option<SocketTable>,
    /// Position of the plate's frame in the robot's base frame \[m\]. If `None`, the plate is placed where the robot reaches
    /// it in most postures.
    pub place_m: Option<[f64; 3]>,
    /// Whether the resulting table contains the distances between the sockets instead of their positions.
    pub distances: bool,
    /// Number of simulated rows.
    pub rows: usize,
    /// Errors of the robot.
    pub errors: ArmErrors,
    /// Standard deviation of the position of the seated ball along each axis \[um\].
    pub seating_um: f64,
    /// Seed of poses, noise and the sockets' errors.
    pub seed: u64,
}

impl<'a> ContactExperiment<'a> {
    /// The default experiment with this robot.
    pub fn new(robot: &'a RobotConfig) -> Self {
        Self {
            robot,
            sockets: None,
            place_m: None,
            distances: false,
            rows: 200,
            errors: ArmErrors::default(),
            seating_um: 5.0,
            seed: 1,
        }
    }
}

/// Result of a simulated experiment.
pub type SimulatedContacts = SimulatedRows<SocketTable>;

/// Six sockets: four at the corners of a square, and two above the square at different heights.
fn usual_sockets(size_mm: f64) -> SocketTable {
    let places = [
        ("A", [0.0, 0.0, 0.0]),
        ("B", [1.0, 0.0, 0.0]),
        ("C", [1.0, 1.0, 0.0]),
        ("D", [0.0, 1.0, 0.0]),
        ("E", [0.3, 0.4, 0.4]),
        ("F", [0.7, 0.8, 0.6]),
    ];
    let rounded = |part: f64| (part * size_mm).round();
    let socket = |(name, at): (&str, [f64; 3])| PlacedSocket {
        name: name.into(),
        position_mm: at.map(rounded),
        u_um: None,
    };
    SocketTable { u_um: 5.0, sockets: places.map(socket).to_vec(), distances: Vec::new() }
}

/// The distances between all pairs of sockets, computed from their positions.
fn distances(table: &SocketTable) -> Vec<KnownDistance> {
    let pairs =
        table.sockets.iter().enumerate().flat_map(|(i, a)| table.sockets[..i].iter().map(move |b| (b, a)));
    let distance = |(a, b): (&PlacedSocket, &PlacedSocket)| KnownDistance {
        between: [a.name.clone(), b.name.clone()],
        distance_mm: (Vector3::from(a.position_mm) - Vector3::from(b.position_mm)).norm(),
        u_um: None,
    };
    pairs.map(distance).collect()
}

/// Simulates an experiment.
///
/// # Errors
/// [`RowSimulationError`].
pub fn run(experiment: &ContactExperiment<'_>) -> Result<SimulatedContacts, RowSimulationError> {
    let ContactExperiment { robot, seed, errors, seating_um, .. } = *experiment;
    check_sizes(&errors, &[("seating_um", seating_um)])?;
    let mut probing = Probing::new(robot, errors, seed);
    let table = experiment.sockets.clone().unwrap_or_else(|| usual_sockets(SIDE * probing.reach_m * 1e3));
    if table.sockets.len() < 2 {
        return Err(RowSimulationError::NoPlaces);
    }
    let plate = place(&table, experiment.place_m, &mut probing)?;
    let true_m = |socket: &PlacedSocket| {
        let error_m = Vector3::from_fn(|_, _| probing.noise(socket.u_um.unwrap_or(table.u_um)));
        (plate * Point3::from(Vector3::from(socket.position_mm) * 1e-3 + error_m)).coords
    };
    let sockets_m: Vec<Vector3<f64>> = table.sockets.iter().map(true_m).collect();
    let row = |row: usize| -> Result<TipRow, RowSimulationError> {
        let part = row % sockets_m.len();
        let ball_m = sockets_m[part] + Vector3::from_fn(|_, _| probing.noise(seating_um));
        let joints = probing.joints_at(ball_m, &Vector3::z(), TRIES);
        let joints = joints.ok_or_else(|| unreachable(&table.sockets[part].name))?;
        Ok(TipRow { joints_rad: probing.reported(&joints), part, ..TipRow::default() })
    };
    let rows = (0..experiment.rows).map(row).collect::<Result<Vec<_>, _>>()?;
    let model =
        Model::alone(&probing.arm.chain).with_set_ups(Owner::Contact, [sockets_m.len(), 1]).without_clocks();
    let mut geometry = model.geometry(&[]);
    (geometry.contact.ball_m, geometry.contact.sockets_m) = (BALL_M.into(), sockets_m);
    let truth = RowTruth {
        sockets: table.sockets.iter().map(|socket| socket.name.clone()).collect(),
        ..RowTruth::new(robot, seed, &model, geometry, &probing.arm)
    };
    let table = if experiment.distances {
        SocketTable { distances: distances(&table), sockets: Vec::new(), ..table }
    } else {
        table
    };
    Ok(SimulatedRows { rows, table, truth, robot: probing.arm.chain })
}

fn unreachable(socket: &str) -> RowSimulationError {
    RowSimulationError::Unreachable { place: format!("socket `{socket}`"), size: "plate" }
}

/// Pose of the plate in the robot's base frame, at which the robot reaches all sockets.
fn place(
    table: &SocketTable,
    place_m: Option<[f64; 3]>,
    probing: &mut Probing,
) -> Result<Pose, RowSimulationError> {
    let positions_mm = || table.sockets.iter().map(|socket| Vector3::from(socket.position_mm));
    let centre_mm = positions_mm().sum::<Vector3<f64>>() / table.sockets.len() as f64;
    let names = table.sockets.iter().map(|socket| socket.name.as_str());
    let socket = |(name, at_mm): (_, Vector3<f64>)| (name, at_mm * 1e-3, Vector3::z());
    let sockets: Vec<_> = names.zip(positions_mm()).map(socket).collect();
    probing.place(place_m, centre_mm, &sockets).map_err(unreachable)
}

/// Writes `contacts.csv`, its mapping `contact.toml`, `sockets.toml` and `truth.toml` to `directory`. Creates the directory
/// if it does not exist. Returns the paths of the files.
///
/// # Errors
/// [`SimulationWriteError`].
pub fn write(
    directory: &Path,
    simulated: &SimulatedContacts,
    robot: &RobotConfig,
) -> Result<[PathBuf; 4], SimulationWriteError> {
    let mapping =
        ContactMapping { csv: CsvLayout::default(), socket: "socket".into(), joints: joint_columns(robot) };
    let table = rows_csv("contact", (&mapping.joints, "socket"), &simulated.rows, |row| {
        simulated.truth.sockets[row.part].clone()
    });
    simulated.write(directory, ["contacts.csv", "contact.toml", "sockets.toml"], table, &mapping)
}
