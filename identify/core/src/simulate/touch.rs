//! Simulates a robot with known errors that touches the faces of a block with a tip on its flange. The flange is on the
//! outer side of the touched face. The result is the input of a calibration by touch, and the true parameters (`identify
//! simulate touch`).

use std::path::{Path, PathBuf};

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use shared::config::RobotConfig;

use super::SimulationWriteError;
use super::arm::ArmErrors;
use super::probing::{BALL_M, Probing, TRIES_FEW};
use super::rows::{RowSimulationError, RowTruth, SimulatedRows, check_sizes, rows_csv};
use crate::instrument::{FaceTable, KnownAngle, Spacing, Touched};
use crate::kinematics::Pose;
use crate::logs::{CsvLayout, LengthUnit, ReadingColumn, TipRow, TouchMapping, joint_columns};
use crate::model::{Face, Model, Owner};

/// Diameter of the ball at the tip \[mm\]. Its centre is at [`BALL_M`].
const TIP_DIAMETER_MM: f64 = 4.0;
/// Edges of the block that are tried one after the other, as fractions of the robot's reach.
const EDGES: [f64; 3] = [0.15, 0.1, 0.07];
/// Number of positions on a face that are tried for one touch.
const PLACES: usize = 1000;
/// Faces of the block with their outward normals. The sixth face is the bottom, which is not touched.
const FACES: [(&str, [f64; 3]); 5] = [
    ("right", [1.0, 0.0, 0.0]),
    ("left", [-1.0, 0.0, 0.0]),
    ("back", [0.0, 1.0, 0.0]),
    ("front", [0.0, -1.0, 0.0]),
    ("top", [0.0, 0.0, 1.0]),
];

/// All inputs of a simulated experiment with a touch probe. Equal experiments give equal results.
#[derive(Debug, Clone)]
pub struct TouchExperiment<'a> {
    /// Configuration of the nominal robot.
    pub robot: &'a RobotConfig,
    /// Edge of the block \[mm\]; `None` for an edge scaled to the robot.
    pub block_mm: Option<f64>,
    /// Centre of the block in the robot's base frame \[m\]. If `None`, the block is placed where the robot reaches
    /// it in most postures.
    pub place_m: Option<[f64; 3]>,
    /// Whether the resulting table contains known distances and angles of the block.
    pub known: bool,
    /// Number of touches to simulate.
    pub rows: usize,
    /// Errors of the robot.
    pub errors: ArmErrors,
    /// Standard deviation of the error of a touch \[um\].
    pub touch_um: f64,
    /// Travel of the dial gauge \[mm\]; 0 for a touch probe.
    pub gauge_mm: f64,
    /// Seed of poses, noise and the block's errors.
    pub seed: u64,
}

impl<'a> TouchExperiment<'a> {
    /// The default experiment with this robot.
    pub fn new(robot: &'a RobotConfig) -> Self {
        Self {
            robot,
            block_mm: None,
            place_m: None,
            known: true,
            rows: 300,
            errors: ArmErrors::default(),
            touch_um: 2.0,
            gauge_mm: 0.0,
            seed: 1,
        }
    }
}

/// Result of a simulated experiment.
pub type SimulatedTouches = SimulatedRows<FaceTable>;

/// Table of the faces of a cube with edge `block_mm`.
fn block_table(block_mm: f64) -> FaceTable {
    let pair = |one: &str, other: &str| [one.to_owned(), other.to_owned()];
    let distance = |(one, other)| Spacing {
        between: pair(one, other),
        distance_mm: block_mm,
        touched: Touched::Outside,
        u_um: None,
    };
    let angle = |(one, other, angle_deg)| KnownAngle { between: pair(one, other), angle_deg, u_urad: None };
    FaceTable {
        u_um: 5.0,
        u_urad: 50.0,
        tip_diameter_mm: TIP_DIAMETER_MM,
        tip_mm: None,
        distances: [("right", "left"), ("back", "front")].map(distance).to_vec(),
        angles: [
            ("right", "left", 0.0),
            ("back", "front", 0.0),
            ("right", "back", 90.0),
            ("right", "top", 90.0),
            ("back", "top", 90.0),
        ]
        .map(angle)
        .to_vec(),
    }
}

/// Simulates an experiment with a touch probe.
///
/// # Errors
/// [`RowSimulationError`].
pub fn run(experiment: &TouchExperiment<'_>) -> Result<SimulatedTouches, RowSimulationError> {
    let TouchExperiment { robot, seed, errors, touch_um, gauge_mm, .. } = *experiment;
    let block_mm = experiment.block_mm.unwrap_or(1.0);
    check_sizes(&errors, &[("touch_um", touch_um), ("gauge_mm", gauge_mm), ("block_mm", block_mm)])?;
    let mut probing = Probing::new(robot, errors, seed);
    let (block_mm, pose) = place(experiment, &mut probing)?;
    let table = block_table(block_mm);
    let block = TouchBlock::new(pose, block_mm, &table, &mut probing);
    let row = |row: usize| -> Result<TipRow, RowSimulationError> {
        let part = row % FACES.len();
        // The error of a touch: a probe triggers too late or too early, or a gauge reads too much or too little.
        let error_m = probing.noise(touch_um);
        let [out_m, reading_m] = if gauge_mm > 0.0 {
            let pushed_m = 1e-3 * probing.random.random_range(0.0..gauge_mm);
            [-pushed_m, pushed_m + error_m]
        } else {
            [error_m, 0.0]
        };
        // The robot may not reach every position on a face from outside, even if it reaches the centre. Several
        // positions are therefore tried.
        let joints = (0..PLACES).find_map(|_| {
            let tip_m = block.random_tip_m(part, out_m, &mut probing.random);
            probing.joints_at(tip_m, &block.faces[part].normal, TRIES_FEW)
        });
        let joints = joints.ok_or_else(|| unreachable(FACES[part].0))?;
        Ok(TipRow { joints_rad: probing.reported(&joints), part, reading_m, ..TipRow::default() })
    };
    let rows = (0..experiment.rows).map(row).collect::<Result<Vec<_>, _>>()?;
    let model =
        Model::alone(&probing.arm.chain).with_set_ups(Owner::Touch, [block.faces.len(), 1]).without_clocks();
    let mut geometry = model.geometry(&[]);
    geometry.touch.tip_m = BALL_M.into();
    for (to, face) in geometry.touch.faces.iter_mut().zip(&block.faces) {
        // Normals are scaled as in a calibration: their largest component is one.
        let scale = face.normal.amax();
        *to = Face { normal: face.normal / scale, distance_m: face.distance_m / scale };
    }
    let truth = RowTruth {
        faces: FACES.map(|(name, _)| name.to_owned()).to_vec(),
        ..RowTruth::new(robot, seed, &model, geometry, &probing.arm)
    };
    let table = if experiment.known { table } else { FaceTable::default() };
    Ok(SimulatedRows { rows, table, truth, robot: probing.arm.chain })
}

fn unreachable(face: &str) -> RowSimulationError {
    RowSimulationError::Unreachable { place: format!("the outer side of face `{face}`"), size: "--block-mm" }
}

/// Edge of the block \[mm\], and pose of the block in the robot's base frame. The robot reaches the centres of all faces,
/// each from its outer side.
fn place(experiment: &TouchExperiment<'_>, probing: &mut Probing) -> Result<(f64, Pose), RowSimulationError> {
    let scaled_mm = |edge: f64| (edge * probing.reach_m * 1e3).round();
    let edges_mm =
        experiment.block_mm.map_or_else(|| EDGES.map(scaled_mm).to_vec(), |block_mm| vec![block_mm]);
    let mut out_of_reach = "";
    for block_mm in edges_mm {
        let centres = FACES.map(|(name, normal)| {
            let outward = Vector3::from(normal);
            (name, outward * 0.5e-3 * block_mm, outward)
        });
        match probing.place(experiment.place_m, Vector3::zeros(), &centres) {
            Ok(block) => return Ok((block_mm, block)),
            Err(face) => out_of_reach = face,
        }
    }
    Err(unreachable(out_of_reach))
}

/// The block with the errors of its faces, in the robot's base frame.
struct TouchBlock {
    pose: Pose,
    /// Half of the nominal edge \[m\].
    half_m: f64,
    /// For each face, the plane of the tip's centre when the tip touches the face.
    faces: Vec<Face>,
}

impl TouchBlock {
    fn new(pose: Pose, block_mm: f64, table: &FaceTable, probing: &mut Probing) -> Self {
        let half_m = 0.5e-3 * block_mm;
        let radius_m = 0.5e-3 * TIP_DIAMETER_MM;
        // The table contains the uncertainty of a distance or angle between two faces. Half of its variance is
        // assigned to each face.
        let sigma_part = 0.5_f64.sqrt();
        let face = |(_, normal): (&str, [f64; 3])| {
            let tilt = Vector3::from_fn(|_, _| probing.noise(sigma_part * table.u_urad));
            let normal = (probing.turn * (Rotation3::new(tilt) * Vector3::from(normal))).normalize();
            let from_centre_m = half_m + probing.noise(sigma_part * table.u_um) + radius_m;
            Face { normal, distance_m: normal.dot(&pose.translation.vector) + from_centre_m }
        };
        let faces = FACES.map(face).to_vec();
        Self { pose, half_m, faces }
    }

    /// A random position of the tip's centre in front of a face \[m\]. It is within nine tenths of the face. `out_m` is its
    /// distance, outwards, from the position at which the tip touches the face.
    fn random_tip_m(&self, face: usize, out_m: f64, random: &mut ChaCha8Rng) -> Vector3<f64> {
        let ((_, outward), face) = (FACES[face], self.faces[face]);
        let place = Vector3::from_fn(|axis, _| {
            let along = random.random_range(-0.9..0.9);
            self.half_m * if outward[axis] == 0.0 { along } else { outward[axis] }
        });
        let place_m = self.pose.transform_point(&place.into()).coords;
        let on_plane_m = place_m - face.normal * (face.normal.dot(&place_m) - face.distance_m);
        on_plane_m + face.normal * out_m
    }
}

/// Writes `touches.csv`, its mapping `touch.toml`, `faces.toml` and `truth.toml` to `directory`. Creates the directory if
/// it does not exist. Returns the paths of the files.
///
/// # Errors
/// [`SimulationWriteError`].
pub fn write(
    directory: &Path,
    simulated: &SimulatedTouches,
    robot: &RobotConfig,
) -> Result<[PathBuf; 4], SimulationWriteError> {
    // A touch probe has no readings.
    let with_readings = simulated.rows.iter().any(|row| row.reading_m != 0.0);
    let reading = ReadingColumn { column: "reading_mm".into(), unit: LengthUnit::Mm };
    let mapping = TouchMapping {
        csv: CsvLayout::default(),
        face: "face".into(),
        reading: with_readings.then_some(reading),
        joints: joint_columns(robot),
    };
    let columns = if with_readings { "reading_mm,face" } else { "face" };
    let table = rows_csv("touch", (&mapping.joints, columns), &simulated.rows, |row| {
        let reading = if with_readings { format!("{:.6},", row.reading_m * 1e3) } else { String::new() };
        reading + &simulated.truth.faces[row.part]
    });
    simulated.write(directory, ["touches.csv", "touch.toml", "faces.toml"], table, &mapping)
}
