//! The path of the experiments, before errors are added. It is random, planned, or computed from the log of a real robot
//! that was connected to the bar. In a log, the longest section is used in which the end of the nominal robot stays on a
//! sphere. The joints of the bar along this section follow from inverse kinematics.

use nalgebra::{Translation3, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{BallBarConfig, RobotConfig};

use crate::kinematics::{
    BAR_JOINTS, Chain, Configuration, InverseError, Joints, Pose, ball_bar_chain, first_ball_bar_inverse,
    nearest_turn, robot_chain,
};
use crate::logs::{RobotLog, Stream};
use crate::plan::PlannedPath;
use crate::prepare::fit_sphere;
use crate::simulate::{BarPath, Experiment, SimulateError};

/// Least time between two rows of a log that are used \[s\]. Rows in between are skipped.
const ROW_S: f64 = 0.02;
/// A position is on the sphere if its distance from the sphere is below this \[m\].
const ON_SPHERE_M: f64 = 0.02;
/// Least number of consecutive rows on the sphere.
const ROWS_MIN: usize = 100;
/// Longest time between two rows of one section \[s\].
const GAP_S: f64 = 0.5;

/// Source of the path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reference {
    /// A different random path for each seed.
    Random,
    /// The random path of this seed, the same for all experiments.
    Same(u64),
    /// The path of a file `path.toml` written by `identify plan`.
    Planned(PlannedPath),
    /// The path of a real robot.
    Driven(Driven),
}

/// Why a log contains no path.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// The robot was not connected to the bar for long enough.
    #[error(
        "the robot's positions in the log lie on no sphere for long ({rows} rows without a break, {ROWS_MIN} are needed); \
         give the log of a run on the bar"
    )]
    NoSphere {
        /// Largest number of consecutive rows on the sphere.
        rows: usize,
    },
    /// The bar's inverse kinematics has no solution.
    #[error(transparent)]
    Inverse(#[from] InverseError),
}

/// The path of a real robot, as joints of the bar. These joints are computed from the pose of the nominal robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Driven {
    /// Centre of the gimbal \[m\].
    pub base_m: [f64; 3],
    /// Joints of the nominal robot at the start \[rad\].
    pub start_rad: [f64; 6],
    /// Time since the start \[s\].
    pub t_s: Vec<f64>,
    /// Joints of the bar at these times, without jumps by whole turns \[rad\].
    pub bar_rad: Vec<[f64; BAR_JOINTS]>,
}

impl Driven {
    /// Finds the longest section of a log in which the end of the nominal robot stays on a sphere, and computes the joints
    /// of a bar whose base is at the centre of this sphere.
    ///
    /// # Errors
    /// [`ReferenceError`].
    pub fn from_bytes(
        log: &RobotLog,
        robot: &RobotConfig,
        bar: &BallBarConfig,
    ) -> Result<Self, ReferenceError> {
        let (arm, mut bar) = (robot_chain(robot, bar), ball_bar_chain(bar));
        let mut last_s = f64::NEG_INFINITY;
        let rows = log.q_rad.filter_map(0..log.q_rad.len(), |row, q_rad| {
            let t_s = log.q_rad.t_s[row];
            (t_s - last_s >= ROW_S).then(|| {
                last_s = t_s;
                *q_rad
            })
        });
        let positions: Vec<Vector3<f64>> =
            rows.iter().map(|q_rad| arm.forward(q_rad).translation.vector).collect();
        let sphere = fit_sphere(&positions, ON_SPHERE_M).ok_or(ReferenceError::NoSphere { rows: 0 })?;
        let is_on_sphere =
            |row: usize| ((positions[row] - sphere.centre_m).norm() - sphere.radius_m).abs() < ON_SPHERE_M;
        let mut longest = 0..0;
        for part in rows.parts_within(GAP_S) {
            let indices: Vec<usize> = part.collect();
            let runs = indices.chunk_by(|a, b| is_on_sphere(*a) == is_on_sphere(*b));
            for run in runs.filter(|run| is_on_sphere(run[0])) {
                if run.len() > longest.len() {
                    longest = run[0]..run[0] + run.len();
                }
            }
        }
        if longest.len() < ROWS_MIN {
            return Err(ReferenceError::NoSphere { rows: longest.len() });
        }
        bar.root_from_base = Translation3::from(sphere.centre_m).into();
        let driven = rows.slice(longest);
        let bar_rad = bar_joints(&bar, driven.iter().map(|q_rad| arm.forward(q_rad)))?;
        let start_rad = std::array::from_fn(|joint| driven[0][joint]);
        Ok(Self { base_m: sphere.centre_m.into(), start_rad, t_s: driven.t_s, bar_rad })
    }
}

/// Joints of the bar at each pose of its end \[rad\]. Of all solutions (four configurations, and whole turns of joints), the
/// one nearest to the solution for the previous pose is used.
fn bar_joints(
    bar: &Chain,
    poses: impl Iterator<Item = Pose>,
) -> Result<Vec<[f64; BAR_JOINTS]>, InverseError> {
    let mut bar_rad: Vec<[f64; BAR_JOINTS]> = Vec::new();
    for pose in poses {
        let first = first_ball_bar_inverse(bar, &pose)?;
        let previous = bar_rad.last().copied().unwrap_or(first);
        let in_configurations = Configuration::ALL.map(|configuration| {
            let joints = configuration.carry(&bar.links, &first);
            std::array::from_fn(|i| nearest_turn(joints[i], previous[i]))
        });
        let squared_distance = |joints: &[f64; BAR_JOINTS]| {
            joints.iter().zip(&previous).map(|(a, b)| (a - b).powi(2)).sum::<f64>()
        };
        let nearest =
            in_configurations.into_iter().min_by(|a, b| squared_distance(a).total_cmp(&squared_distance(b)));
        bar_rad.extend(nearest);
    }
    Ok(bar_rad)
}

/// A path of the bar, and the joints of the nominal robot at the start of the path \[rad\].
pub(super) type Drive = (Box<dyn BarPath>, Joints);

impl Reference {
    /// Moves the bar of an experiment to the base of the path. Returns the path and the robot's joints at the
    /// start of the path.
    ///
    /// # Errors
    /// [`SimulateError`] if no random path is found, or if a path from a log has too few rows to interpolate.
    pub(super) fn drive(&self, experiment: &mut Experiment<'_>) -> Result<Drive, SimulateError> {
        let random = |experiment: &Experiment<'_>| -> Result<Drive, SimulateError> {
            let (path, start_rad) = experiment.drive()?;
            Ok((Box::new(path), start_rad))
        };
        match self {
            Self::Random => random(experiment),
            Self::Same(seed) => random(&Experiment { seed: *seed, ..experiment.clone() }),
            Self::Planned(planned) => {
                experiment.design.base_m = planned.base_m;
                Ok((Box::new(planned.path.clone()), planned.robot_start_rad))
            }
            Self::Driven(driven) => {
                experiment.design.base_m = driven.base_m;
                let rows = Stream::new(0, driven.t_s.clone(), driven.bar_rad.clone());
                let spline = rows.with_gap_limit(f64::INFINITY).spline();
                Ok((Box::new(spline.ok_or(SimulateError::Empty)?), driven.start_rad.into()))
            }
        }
    }
}
