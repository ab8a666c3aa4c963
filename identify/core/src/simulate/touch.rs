//! A robot with known errors that touches the faces of a block with a tip on its flange: input and truth of a calibration by
//! touch, for `identify simulate touch`.

use std::path::{Path, PathBuf};

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_distr::StandardNormal;
use shared::config::{self, RobotConfig};

use super::arm::{Arm, ArmErrors};
use super::rows::{RowSimulationError, RowTruth, SimulatedRows, check_sizes, rows_csv, write_texts};
use super::{Stream, WriteError, random};
use crate::instrument::{FaceTable, KnownAngle, Spacing, TouchRow, Touched};
use crate::kinematics::Pose;
use crate::logs::{CsvLayout, LengthUnit, ReadingColumn, TouchMapping, joint_columns};
use crate::model::{Face, Model};

/// Centre of the tip's ball in the flange frame \[m\], and the ball's diameter \[mm\].
const TIP_M: [f64; 3] = [0.02, -0.03, 0.12];
const TIP_DIAMETER_MM: f64 = 4.0;
/// Number of start postures to try for a row.
const TRIES: usize = 3000;
/// Number of positions to try for the block.
const PLACES: usize = 20;
/// Faces of the block with their outward normals; the sixth is at the bottom.
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
    /// Edge of the block \[mm\]; `None`: scaled to the robot.
    pub block_mm: Option<f64>,
    /// Centre of the block in the robot's base \[m\]; `None`: where the robot reaches it in most postures.
    pub place_m: Option<[f64; 3]>,
    /// Whether the calibration gets distances and angles of the block.
    pub known: bool,
    /// Number of touches to simulate.
    pub rows: usize,
    /// Errors of the robot.
    pub errors: ArmErrors,
    /// Standard deviation of a touch \[um\].
    pub touch_um: f64,
    /// Travel of a dial gauge \[mm\]; 0: a touch probe instead.
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
pub type SimulatedTouches = SimulatedRows<TouchRow, FaceTable>;

/// Table of a block with these edges.
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
    let arm = Arm::new(robot, errors, TIP_M.into());
    let mut pose_random = random(seed, Stream::Path);
    let (places_m, reach_m) = arm.places(&mut pose_random);
    /// Edges of the block to try, as parts of the robot's reach.
    const EDGES: [f64; 3] = [0.15, 0.1, 0.07];
    let edges_mm = experiment
        .block_mm
        .map_or_else(|| EDGES.map(|edge| (edge * reach_m * 1e3).round()).to_vec(), |block_mm| vec![block_mm]);
    let turn = Rotation3::from_euler_angles(0.02, -0.01, pose_random.random_range(-0.5..0.5));
    let centres_m = match experiment.place_m {
        Some(place_m) => vec![Vector3::from(place_m)],
        None => places_m.into_iter().take(PLACES).collect(),
    };
    let mut out_of_reach = "";
    let blocks = edges_mm.iter().flat_map(|edge| centres_m.iter().map(move |centre| (*edge, *centre)));
    let found = blocks.map(|(block_mm, centre_m)| (block_mm, Pose::from_parts(centre_m.into(), turn))).find(
        |(block_mm, block)| {
            let centre_of_face_m = |normal: [f64; 3]| {
                block.transform_point(&(Vector3::from(normal) * 0.5e-3 * *block_mm).into()).coords
            };
            let unreached = FACES.iter().find(|(_, normal)| {
                arm.joints_at(centre_of_face_m(*normal), TRIES / 10, &mut pose_random).is_none()
            });
            out_of_reach = unreached.map_or("", |(name, _)| *name);
            out_of_reach.is_empty()
        },
    );
    let unreachable =
        |face: &str| RowSimulationError::Unreachable { place: format!("face `{face}`"), size: "--block-mm" };
    let (block_mm, block) = found.ok_or_else(|| unreachable(out_of_reach))?;
    let half_m = 0.5e-3 * block_mm;
    let table = block_table(block_mm);
    let mut noise_random = random(seed, Stream::RobotEffects);
    let mut noise = |sigma: f64| -> f64 { sigma * 1e-6 * noise_random.sample::<f64, _>(StandardNormal) };
    let radius_m = 0.5e-3 * TIP_DIAMETER_MM;
    // Each of the two faces of a distance or angle has half of the variance that the table states.
    let faces: Vec<Face> = FACES
        .iter()
        .map(|(_, normal)| {
            let part = 0.5_f64.sqrt();
            let tilt = Vector3::from_fn(|_, _| noise(part * table.u_urad));
            let normal = (turn * (Rotation3::new(tilt) * Vector3::from(*normal))).normalize();
            let from_centre_m = half_m + noise(part * table.u_um) + radius_m;
            Face { normal, distance_m: normal.dot(&block.translation.vector) + from_centre_m }
        })
        .collect();
    let mut rows = Vec::with_capacity(experiment.rows);
    for row in 0..experiment.rows {
        let number = row % FACES.len();
        let (face, (name, outward)) = (faces[number], FACES[number]);
        // A probe triggers too late or too early, a gauge reads too much or too little.
        let error_m = noise(touch_um);
        let [out_m, reading_m] = if gauge_mm > 0.0 {
            let pushed_m = 1e-3 * pose_random.random_range(0.0..gauge_mm);
            [-pushed_m, pushed_m + error_m]
        } else {
            [error_m, 0.0]
        };
        // The robot may not reach every corner of a face that it reaches.
        let joints = (0..PLACES).find_map(|_| {
            // A position within nine tenths of the face, projected onto the plane of the tip's centre.
            let place = Vector3::from_fn(|axis, _| {
                let along = pose_random.random_range(-0.9..0.9);
                half_m * if outward[axis] == 0.0 { along } else { outward[axis] }
            });
            let place_m = block.transform_point(&place.into()).coords;
            let on_plane_m = place_m - face.normal * (face.normal.dot(&place_m) - face.distance_m);
            arm.joints_at(on_plane_m + face.normal * out_m, TRIES / 10, &mut pose_random)
        });
        let joints = joints.ok_or_else(|| unreachable(name))?;
        rows.push(TouchRow { joints_rad: arm.reported(&joints, &mut noise), face: number, reading_m });
    }
    let model = Model::alone(&arm.chain).with_faces(faces.len()).without_clocks();
    let mut geometry = model.geometry(&[]);
    geometry.touch.tip_m = TIP_M.into();
    for (to, face) in geometry.touch.faces.iter_mut().zip(&faces) {
        // Scaled as in a calibration: the largest component of a normal is one.
        let scale = face.normal.amax();
        *to = Face { normal: face.normal / scale, distance_m: face.distance_m / scale };
    }
    let truth = RowTruth {
        faces: FACES.map(|(name, _)| name.to_owned()).to_vec(),
        ..RowTruth::new(robot, seed, &model, geometry, &arm)
    };
    let table = if experiment.known { table } else { FaceTable::default() };
    Ok(SimulatedRows { rows, table, truth, robot: arm.chain })
}

/// Writes `touches.csv`, its mapping `touch.toml`, `faces.toml` and `truth.toml` into `directory`, which is created if it is
/// missing; returns their paths.
///
/// # Errors
/// [`WriteError`].
pub fn write(
    directory: &Path,
    simulated: &SimulatedTouches,
    robot: &RobotConfig,
) -> Result<[PathBuf; 4], WriteError> {
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
        (&row.joints_rad, reading + &simulated.truth.faces[row.face])
    });
    let files = [
        ("touches.csv", table),
        ("touch.toml", config::to_toml(&mapping)?),
        ("faces.toml", config::to_toml(&simulated.table)?),
        ("truth.toml", config::to_toml(&simulated.truth)?),
    ];
    write_texts(directory, files)
}
