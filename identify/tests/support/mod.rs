//! Helpers that the tests share: configurations of the repository, an independent kinematics, and the reference set-up.
#![allow(dead_code, reason = "each test file uses its part")]
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "a test without its data states so")]

pub mod browser;
pub mod campaign;
pub mod command;
pub mod gears;
pub mod independent;
pub mod laboratory;
pub mod lengths;
pub mod minute;
pub mod other_solver;
pub mod refused;
pub mod rows;
pub mod stamped;
pub mod tracker_log;
pub mod truth;

use std::path::{Path, PathBuf};

use identify::kinematics::{Chain, ball_bar_chain, robot_chain, robot_inverse, singularity_margin_rad};
use identify::model::{Model, Observation, PerObservation};
use nalgebra::Vector3;
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config::{self, BallBarConfig, RobotConfig};

pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Folder of measured data that may not be copied into the repository. Without it, tests of these
/// data return without a check.
pub fn measured_data() -> Option<PathBuf> {
    let folder = std::env::var_os("BALLBAR_DATA").map(PathBuf::from);
    if folder.is_none() {
        println!("BALLBAR_DATA does not name the folder of the measured data: nothing is tested");
    }
    folder
}

pub fn irb2400() -> RobotConfig {
    config::load(&repository("config/robots/irb2400_16.toml")).unwrap()
}

pub fn nj220() -> RobotConfig {
    config::load(&repository("config/robots/nj220_2_7.toml")).unwrap()
}

pub fn irb120() -> RobotConfig {
    config::load(&repository("config/robots/irb120_3.toml")).unwrap()
}

pub fn ur10() -> RobotConfig {
    config::load(&repository("config/robots/ur10.toml")).unwrap()
}

pub fn bar() -> BallBarConfig {
    config::load(&repository("config/ball_bar.toml")).unwrap()
}

/// A robot, and a bar at a base from which the robot reaches the sphere in many directions.
pub struct Cell {
    pub robot: Chain,
    pub bar: Chain,
}

impl Cell {
    /// The reference set-up: base of the bar at (1.0, 0.05, 0.35), rod 0.6, plate 0.25 \[m\].
    pub fn irb2400() -> Self {
        Self::new(&irb2400(), Vector3::new(1.0, 0.05, 0.35))
    }

    pub fn nj220() -> Self {
        Self::new(&nj220(), Vector3::new(1.7, 0.05, 0.6))
    }

    fn new(robot: &RobotConfig, origin_m: Vector3<f64>) -> Self {
        let config = bar();
        let mut bar = ball_bar_chain(&config);
        bar.root_from_base.translation.vector = origin_m;
        Self { robot: robot_chain(robot, &config), bar }
    }

    pub fn model(&self) -> Model {
        Model::ball_bar(&self.robot, &self.bar)
    }
}

/// Angles of the bar at regular poses of robot and bar, and the joints of the robot at the same poses.
/// Both follow from the given chains.
pub fn spread_poses(
    robot: &Chain,
    bar: &Chain,
    count: usize,
    seed: u64,
) -> (Vec<Observation>, PerObservation) {
    let mut random = StdRng::seed_from_u64(seed);
    let mut observations = Vec::new();
    let mut joints = Vec::new();
    let home = [0.0, 0.2, 0.2, 0.0, 0.8, 0.0];
    while observations.len() < count {
        let b: [f64; 5] = std::array::from_fn(|_| random.random_range(-3.1..3.1));
        if singularity_margin_rad(&bar.links, &b) < 0.2 {
            continue;
        }
        let Ok(q) = robot_inverse(robot, &bar.forward(&b), &home) else { continue };
        if q[4].sin().abs() < 0.1 || q[2].abs() > 1.2 {
            continue;
        }
        observations.push(Observation::bar(PerObservation::time_s(joints.len()), b));
        joints.push(q);
    }
    (observations, PerObservation(joints))
}

/// Like [`spread_poses`] for the nominal chains, with noise of this standard deviation on all angles
/// of robot and bar \[rad\].
pub fn noisy_poses(
    cell: &Cell,
    count: usize,
    seed: u64,
    sigma_rad: f64,
) -> (Vec<Observation>, PerObservation) {
    let (mut observations, mut motion) = spread_poses(&cell.robot, &cell.bar, count, seed);
    let mut random = StdRng::seed_from_u64(seed);
    let bar = observations.iter_mut().flat_map(|o| &mut o.bar_rad);
    for angle in bar.chain(motion.0.iter_mut().flatten()) {
        *angle += sigma_rad * random.sample::<f64, _>(StandardNormal);
    }
    (observations, motion)
}
