//! A robot with known errors that seats the ball on its flange in the sockets of a plate: what a calibration by contact should find.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use shared::config::RobotConfig;

use super::effects::{GEAR_PERIODS, Wave};
use super::{Stream, WriteError, random};
use crate::instrument::{ContactRow, KnownDistance, PlacedSocket, SocketTable};
use crate::kinematics::{Chain, DhLink, Joints, Pose, Trace, Tracer, flange_chain};
use crate::logs::{ContactMapping, CsvLayout, LogError, SIMULATED, joint_columns};
use crate::model::{DriveTrain, Model, ParameterId};

/// Centre of the ball in the flange frame \[m\].
const BALL_M: [f64; 3] = [0.02, -0.03, 0.12];
/// The ball's stem comes from above, within this of the plate's normal: cosine.
const STEM_COSINE: f64 = 0.4;
/// Part of the joints' travel that is used.
const TRAVEL: f64 = 0.9;
/// Starts that are tried for a row.
const TRIES: usize = 3000;
/// Places that are tried for the plate.
const PLACES: usize = 20;

/// Everything that decides a simulated experiment with a ball in sockets. Equal experiments give equal results.
#[derive(Debug, Clone)]
pub struct ContactExperiment<'a> {
    /// The robot, nominal.
    pub robot: &'a RobotConfig,
    /// Its sockets by their places; none: six on two levels, by the robot's size. The true ones differ by their uncertainty.
    pub sockets: Option<SocketTable>,
    /// Where the plate's frame stands in the robot's base \[m\]; none: where the robot reaches it in most ways.
    pub place_m: Option<[f64; 3]>,
    /// The calibration gets the sockets' distances instead of their places.
    pub distances: bool,
    /// Rows.
    pub rows: usize,
    /// Standard deviation of the error of each number of each link \[mm|mrad\].
    pub errors_mm_mrad: f64,
    /// White noise of each joint \[urad|um\].
    pub robot_noise_urad: f64,
    /// Sine of twice the angle of each drive's output, amplitude \[urad\]: an eccentric gear.
    pub gear_sine_urad: f64,
    /// How well the ball finds its seat, standard deviation along each axis \[um\].
    pub seating_um: f64,
    /// Seed of the robot's errors: another plate of one robot has the same.
    pub robot_seed: u64,
    /// Seed of poses, noise and the sockets' errors.
    pub seed: u64,
}

impl<'a> ContactExperiment<'a> {
    /// The usual one with this robot.
    pub fn new(robot: &'a RobotConfig) -> Self {
        Self {
            robot,
            sockets: None,
            place_m: None,
            distances: false,
            rows: 200,
            errors_mm_mrad: 1.0,
            robot_noise_urad: 15.0,
            gear_sine_urad: 30.0,
            seating_um: 5.0,
            robot_seed: 1,
            seed: 1,
        }
    }
}

/// Everything that is true of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ContactTruth {
    /// The robot's name.
    pub robot: String,
    /// Seed of errors, poses and noise.
    pub seed: u64,
    /// Names of the sockets in the order of their parameters.
    pub sockets: Vec<String>,
    /// True parameters by name \[m|rad\].
    pub parameters: BTreeMap<String, f64>,
}

/// What a simulated experiment gives.
#[derive(Debug, Clone)]
pub struct SimulatedContacts {
    /// Rows in the order of the robot's motion.
    pub rows: Vec<ContactRow>,
    /// What is known of the sockets.
    pub table: SocketTable,
    /// What a calibration should find.
    pub truth: ContactTruth,
    /// The true robot.
    pub robot: Chain,
}

/// Why a ball in sockets cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum ContactSimulationError {
    /// Places are needed.
    #[error(
        "a table of distances does not say where the sockets are; give one with a [[socket]] block for each of at least two"
    )]
    NoPlaces,
    /// A size that is none.
    #[error("{name} is {value}; give a finite number that is not negative")]
    Size {
        /// Option.
        name: &'static str,
        /// As given.
        value: f64,
    },
    /// The robot does not get there.
    #[error(
        "the robot does not reach socket `{socket}` from above within its limits; give another --place or a smaller plate"
    )]
    Unreachable {
        /// Its name.
        socket: String,
    },
}

/// The robot with its errors, and how it moves.
struct Arm<'a> {
    tracer: Tracer,
    limits: &'a [[f64; 2]],
    ball_m: Vector3<f64>,
}

impl Arm<'_> {
    fn random(&self, random: &mut ChaCha8Rng) -> Joints {
        let joint = |[low, high]: &[f64; 2]| {
            let (middle, half) = (0.5 * (low + high), 0.5 * TRAVEL * (high - low));
            random.random_range(middle - half..=middle + half)
        };
        self.limits.iter().map(joint).collect()
    }

    /// The ball with joints there, and whether its stem comes from above.
    fn ball(&self, joints: &Joints, trace: &mut Trace) -> (Vector3<f64>, bool) {
        self.tracer.trace(joints, trace);
        let stem = trace.rotation() * self.ball_m;
        (trace.position_m() + stem, -stem.z > STEM_COSINE * stem.norm())
    }

    /// Joints near `start` that put the ball there; none within the limits and from above.
    fn seat(&self, start: Joints, there_m: Vector3<f64>) -> Option<Joints> {
        const STEPS: usize = 60;
        const STEP_MAX: f64 = 0.3;
        const MISS_M: f64 = 1e-12;
        let (mut joints, mut trace) = (start, Trace::default());
        for _ in 0..STEPS {
            let (held_m, from_above) = self.ball(&joints, &mut trace);
            let miss = there_m - held_m;
            if miss.norm() < MISS_M {
                let within = joints.iter().zip(self.limits).all(|(q, [low, high])| low <= q && q <= high);
                return (within && from_above).then_some(joints);
            }
            let by: Vec<Vector3<f64>> =
                trace.point_twists(held_m, joints.len()).map(|twist| twist.linear).collect();
            let square: Matrix3<f64> = by.iter().map(|column| column * column.transpose()).sum();
            let pull = (square + Matrix3::identity() * 1e-12).try_inverse()? * miss;
            let longest = by.iter().map(|column| column.dot(&pull).abs()).fold(0.0, f64::max);
            let part = (STEP_MAX / longest).min(1.0);
            joints.iter_mut().zip(&by).for_each(|(q, column)| *q += part * column.dot(&pull));
        }
        None
    }

    /// Balls of random postures, those that most of the others are near first, and how far the ball gets.
    fn places(&self, random: &mut ChaCha8Rng) -> (Vec<Vector3<f64>>, f64) {
        const POSTURES: usize = 600;
        const NEAR: f64 = 0.2;
        /// Where the robot itself stands there is no plate.
        const BESIDE: f64 = 0.45;
        let mut trace = Trace::default();
        let balls: Vec<(Vector3<f64>, bool)> =
            (0..POSTURES).map(|_| self.ball(&self.random(random), &mut trace)).collect();
        let reach_m = balls.iter().map(|(ball_m, _)| ball_m.norm()).fold(0.0, f64::max);
        let beside = |ball_m: &Vector3<f64>| ball_m.xy().norm() > BESIDE * reach_m;
        let from_above: Vec<Vector3<f64>> =
            balls.iter().filter(|(at, above)| *above && beside(at)).map(|(ball_m, _)| *ball_m).collect();
        let near = |at: &Vector3<f64>| {
            from_above.iter().filter(|other| (*other - at).norm() < NEAR * reach_m).count()
        };
        let mut places = from_above.clone();
        places.sort_by_cached_key(|at| std::cmp::Reverse(near(at)));
        (places, reach_m)
    }

    /// The first try of so many that seats the ball there.
    fn seated(&self, there_m: Vector3<f64>, tries: usize, random: &mut ChaCha8Rng) -> Option<Joints> {
        (0..tries).find_map(|_| self.seat(self.random(random), there_m))
    }
}

/// Six sockets on two levels.
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

/// All distances of a table of places.
fn distances(table: &SocketTable) -> Vec<KnownDistance> {
    let pairs =
        table.sockets.iter().enumerate().flat_map(|(i, a)| table.sockets[..i].iter().map(move |b| (b, a)));
    let of = |(a, b): (&PlacedSocket, &PlacedSocket)| KnownDistance {
        between: [a.name.clone(), b.name.clone()],
        distance_mm: (Vector3::from(a.position_mm) - Vector3::from(b.position_mm)).norm(),
        u_um: None,
    };
    pairs.map(of).collect()
}

fn check(experiment: &ContactExperiment<'_>) -> Result<(), ContactSimulationError> {
    for (name, value) in [
        ("errors_mm_mrad", experiment.errors_mm_mrad),
        ("robot_noise_urad", experiment.robot_noise_urad),
        ("gear_sine_urad", experiment.gear_sine_urad),
        ("seating_um", experiment.seating_um),
    ] {
        if !(value.is_finite() && value >= 0.0) {
            return Err(ContactSimulationError::Size { name, value });
        }
    }
    Ok(())
}

/// Runs an experiment.
///
/// # Errors
/// [`ContactSimulationError`].
pub fn run(experiment: &ContactExperiment<'_>) -> Result<SimulatedContacts, ContactSimulationError> {
    check(experiment)?;
    let ContactExperiment { robot, seed, .. } = *experiment;
    let mut errors = random(experiment.robot_seed, Stream::StaticErrors);
    let by = experiment.errors_mm_mrad * 1e-3;
    let mut chain = flange_chain(robot);
    for link in &mut chain.links {
        let DhLink { a_m, d_m, alpha_rad, theta_rad, .. } = link;
        for number in [a_m, d_m, alpha_rad, theta_rad] {
            *number += by * errors.sample::<f64, _>(StandardNormal);
        }
    }
    let gear = |_: &DhLink| Wave {
        amplitude_rad: experiment.gear_sine_urad * 1e-6,
        periods: GEAR_PERIODS,
        phase_rad: errors.random_range(0.0..TAU),
    };
    let gears: Vec<Wave> = chain.links.iter().map(gear).collect();
    let limits = robot.joint_limits();
    let arm = Arm { tracer: Tracer::new(&chain), limits: &limits, ball_m: BALL_M.into() };
    let mut poses = random(seed, Stream::Path);
    let (places_m, reach_m) = arm.places(&mut poses);
    /// Side of the plate, part of the robot's reach.
    const SIDE: f64 = 0.2;
    let table = experiment.sockets.clone().unwrap_or_else(|| usual_sockets(SIDE * reach_m * 1e3));
    if table.sockets.len() < 2 {
        return Err(ContactSimulationError::NoPlaces);
    }
    let centre_mm = table.sockets.iter().map(|one| Vector3::from(one.position_mm)).sum::<Vector3<f64>>()
        / table.sockets.len() as f64;
    let turn = Rotation3::from_euler_angles(0.02, -0.01, poses.random_range(-0.5..0.5));
    let origins_m = match experiment.place_m {
        Some(place_m) => vec![Vector3::from(place_m)],
        None => places_m.into_iter().take(PLACES).map(|at| at - turn * centre_mm * 1e-3).collect(),
    };
    let mut out_of_reach = None;
    let plate = origins_m.into_iter().map(|origin_m| Pose::from_parts(origin_m.into(), turn)).find(|plate| {
        let there_m = |one: &PlacedSocket| {
            plate.transform_point(&(Vector3::from(one.position_mm) * 1e-3).into()).coords
        };
        out_of_reach = table
            .sockets
            .iter()
            .find(|one| arm.seated(there_m(one), TRIES / 10, &mut poses).is_none())
            .map(|one| one.name.clone());
        out_of_reach.is_none()
    });
    let Some(plate) = plate else {
        return Err(ContactSimulationError::Unreachable { socket: out_of_reach.unwrap_or_default() });
    };
    let mut effects = random(seed, Stream::RobotEffects);
    let mut noise = |sigma: f64| -> f64 { sigma * 1e-6 * effects.sample::<f64, _>(StandardNormal) };
    let sockets_m: Vec<Vector3<f64>> = table
        .sockets
        .iter()
        .map(|one| {
            let off_m = Vector3::from_fn(|_, _| noise(one.u_um.unwrap_or(table.u_um)));
            (plate * Point3::from(Vector3::from(one.position_mm) * 1e-3 + off_m)).coords
        })
        .collect();
    let drives = DriveTrain::of(robot, &chain);
    let mut rows = Vec::with_capacity(experiment.rows);
    for row in 0..experiment.rows {
        let socket = row % sockets_m.len();
        let there_m = sockets_m[socket] + Vector3::from_fn(|_, _| noise(experiment.seating_um));
        let Some(stands) = arm.seated(there_m, TRIES, &mut poses) else {
            return Err(ContactSimulationError::Unreachable { socket: table.sockets[socket].name.clone() });
        };
        let mut joints_rad =
            Joints::from_fn(limits.len(), |joint| stands[joint] + noise(experiment.robot_noise_urad));
        for (drive, gear) in gears.iter().enumerate().filter(|(drive, _)| drives.turns(*drive)) {
            let error = gear.at(drives.of_drive(drive, &stands));
            let turned = joints_rad.iter_mut().zip(&drives.joint_from_drive[drive]);
            turned.for_each(|(q, part)| *q += part * error);
        }
        rows.push(ContactRow { joints_rad, socket });
    }
    let mut truth = truth(experiment, &table, &chain, &sockets_m);
    if experiment.gear_sine_urad > 0.0 {
        let turning = gears.iter().enumerate().filter(|(drive, _)| drives.turns(*drive));
        let terms = turning.flat_map(|(drive, gear)| gear.terms(&gear.periods.to_string(), drive));
        truth.parameters.extend(terms);
    }
    let table = if experiment.distances {
        SocketTable { distances: distances(&table), sockets: Vec::new(), ..table }
    } else {
        table
    };
    Ok(SimulatedContacts { rows, table, truth, robot: chain })
}

fn truth(
    experiment: &ContactExperiment<'_>,
    table: &SocketTable,
    chain: &Chain,
    sockets_m: &[Vector3<f64>],
) -> ContactTruth {
    let mut geometry = Model::alone(chain).with_sockets(sockets_m.len()).without_clocks().geometry(&[]);
    geometry.contact.ball_m = BALL_M.into();
    geometry.contact.sockets_m = sockets_m.to_vec();
    let model = Model::alone(chain).with_sockets(sockets_m.len()).without_clocks();
    let of_geometry = model.ids().into_iter();
    let of_geometry = of_geometry.filter(|id| id.term().is_none());
    let value = |id: ParameterId| Some((id.to_string(), *geometry.parameter_mut(id)?));
    ContactTruth {
        robot: experiment.robot.name.clone(),
        seed: experiment.seed,
        sockets: table.sockets.iter().map(|one| one.name.clone()).collect(),
        parameters: of_geometry.filter_map(value).collect(),
    }
}

/// How the columns of simulated rows are called.
fn mapping(robot: &RobotConfig) -> ContactMapping {
    ContactMapping { csv: CsvLayout::default(), socket: "socket".into(), joints: joint_columns(robot) }
}

/// Writes `contacts.csv`, its mapping `contact.toml`, `sockets.toml` and `truth.toml` into `directory`, which is made where it is
/// missing; returns where they are.
///
/// # Errors
/// [`WriteError`].
pub fn write(
    directory: &Path,
    simulated: &SimulatedContacts,
    robot: &RobotConfig,
) -> Result<[PathBuf; 4], WriteError> {
    let mapping = mapping(robot);
    let mut table = format!("# {SIMULATED}: identify simulate contact\n");
    table.extend(mapping.joints.iter().map(|joint| format!("{},", joint.column)));
    table += "socket\n";
    for row in &simulated.rows {
        for (q, joint) in row.joints_rad.iter().zip(&mapping.joints) {
            // Writing to a string cannot fail.
            let _ = write!(table, "{:.9},", q / joint.unit.to_si());
        }
        let _ = writeln!(table, "{}", simulated.truth.sockets[row.socket]);
    }
    let files = [
        ("contacts.csv", table),
        ("contact.toml", toml::to_string(&mapping)?),
        ("sockets.toml", toml::to_string(&simulated.table)?),
        ("truth.toml", toml::to_string(&simulated.truth)?),
    ];
    let unwritable = |path: &Path| {
        let path = path.to_owned();
        move |source| LogError::Unwritable { path, source }
    };
    std::fs::create_dir_all(directory).map_err(unwritable(directory))?;
    for (name, text) in &files {
        let path = directory.join(name);
        std::fs::write(&path, text).map_err(unwritable(&path))?;
    }
    Ok(files.map(|(name, _)| directory.join(name)))
}
