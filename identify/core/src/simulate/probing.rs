//! Code shared by the simulations of a ball in sockets (`contact`) and of a touch probe (`touch`). In both, a robot with
//! known errors moves the ball on its flange to points of an object. This module places the object within the robot's reach,
//! computes the robot's joints at the points, and generates the random numbers of poses and noise.

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use shared::config::RobotConfig;

use super::arm::{Arm, ArmErrors};
use super::{RandomStream, random};
use crate::kinematics::{Joints, Pose};

/// Centre of the ball in the flange frame \[m\].
pub(super) const BALL_M: [f64; 3] = [0.02, -0.03, 0.12];
/// Number of start postures to try for a point that must be reached.
pub(super) const TRIES: usize = 3000;
/// Number of start postures to try for a point that another point can replace.
pub(super) const TRIES_FEW: usize = TRIES / 10;
/// Number of positions to try for the object.
const PLACES: usize = 60;

/// A robot in front of an object.
pub(super) struct Probing {
    pub(super) arm: Arm,
    /// Largest reach of the robot \[m\].
    pub(super) reach_m: f64,
    /// Orientation of the object in the robot's base frame.
    pub(super) turn: Rotation3<f64>,
    /// Generator for the poses.
    pub(super) random: ChaCha8Rng,
    /// Positions that the robot reaches, by decreasing number of neighbours \[m\].
    places_m: Vec<Vector3<f64>>,
    noise: ChaCha8Rng,
}

impl Probing {
    pub(super) fn new(robot: &RobotConfig, errors: ArmErrors, seed: u64) -> Self {
        let arm = Arm::new(robot, errors, BALL_M.into());
        let mut pose_random = random(seed, RandomStream::Path);
        let (places_m, reach_m) = arm.places(&mut pose_random);
        let turn = Rotation3::from_euler_angles(0.02, -0.01, pose_random.random_range(-0.5..0.5));
        let noise = random(seed, RandomStream::RobotEffects);
        Self { arm, reach_m, turn, random: pose_random, places_m, noise }
    }

    /// Finds a pose of the object in the robot's base frame at which the robot reaches all `points`. `points` are names,
    /// positions \[m\] and outward unit normals of points on the object's surface, in the object's frame. If `place_m` is
    /// given, the object's origin is there. Otherwise the object's centre (`centre_mm` in its frame) is placed at the
    /// positions that the robot reaches, one after the other, until all points are reached.
    ///
    /// # Errors
    /// Name of a point that the robot did not reach at the last tried position.
    pub(super) fn place<'n>(
        &mut self,
        place_m: Option<[f64; 3]>,
        centre_mm: Vector3<f64>,
        points: &[(&'n str, Vector3<f64>, Vector3<f64>)],
    ) -> Result<Pose, &'n str> {
        let places_m: Vec<Vector3<f64>> = match place_m {
            Some(place_m) => vec![place_m.into()],
            None => self.places_m.iter().take(PLACES).map(|at| at - self.turn * centre_mm * 1e-3).collect(),
        };
        let mut out_of_reach = "";
        for place_m in places_m {
            let object = Pose::from_parts(place_m.into(), self.turn);
            let unreached = points.iter().find(|(_, point_m, outward)| {
                let point_m = object.transform_point(&(*point_m).into()).coords;
                self.joints_at(point_m, &(self.turn * outward), TRIES_FEW).is_none()
            });
            match unreached {
                Some((name, ..)) => out_of_reach = *name,
                None => return Ok(object),
            }
        }
        Err(out_of_reach)
    }

    /// True joints that move the ball to position `there_m` on a surface. `outward` is the unit normal of the surface. Both
    /// are in the robot's base frame.
    pub(super) fn joints_at(
        &mut self,
        there_m: Vector3<f64>,
        outward: &Vector3<f64>,
        tries: usize,
    ) -> Option<Joints> {
        self.arm.joints_at(there_m, outward, tries, &mut self.random)
    }

    /// Joints that the controller reports when the robot is at `true_joints`.
    pub(super) fn reported(&mut self, true_joints: &Joints) -> Joints {
        let Self { arm, noise, .. } = self;
        arm.reported(true_joints, |sigma| normal(noise, sigma))
    }

    /// A random error with standard deviation `sigma` \[um|urad\]. The result is in m or rad.
    pub(super) fn noise(&mut self, sigma: f64) -> f64 {
        normal(&mut self.noise, sigma)
    }
}

fn normal(random: &mut ChaCha8Rng, sigma: f64) -> f64 {
    sigma * 1e-6 * random.sample::<f64, _>(StandardNormal)
}
