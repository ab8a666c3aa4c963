//! Random poses that robot and bar can reach together. Joint angles of the bar are random, and the robot's joint
//! positions follow by inverse kinematics.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use crate::kinematics::{BAR_JOINTS, Chain, robot_inverse, singularity_margin_rad};
use crate::model::{Observation, PerObservation};
use crate::simulate::Design;

/// Average number of random bar postures that are tried for each pose before the search gives up.
const TRIES_PER_POSE: usize = 2000;

/// Robot and bar have too few poses in common.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "only {found} of {wanted} random poses of the bar at {base_m:?} m are in the robot's reach and away from singular \
     ones; choose another place or length of the bar"
)]
pub struct TooFewPoses {
    /// Number of poses found.
    pub found: usize,
    /// Number of poses needed.
    pub wanted: usize,
    /// Position of the bar in the robot's base frame \[m\].
    pub base_m: [f64; 3],
}

/// Joint positions of bar and robot in each pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Poses {
    /// Bar joints of each pose.
    pub observations: Vec<Observation>,
    /// Robot joints of each pose.
    pub joints: PerObservation,
}

impl Poses {
    /// Selects `count` poses that are spread over all joints of the bar, within the robot's limits \[rad\] and the
    /// margins of the design.
    ///
    /// # Errors
    /// [`TooFewPoses`].
    pub fn spread(
        robot: &Chain,
        bar: &Chain,
        limits: &[[f64; 2]],
        design: &Design,
        count: usize,
        seed: u64,
    ) -> Result<Self, TooFewPoses> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let limits_with_margin = design.limits_with_margin(robot, limits);
        let mut poses = Self { observations: Vec::with_capacity(count), joints: PerObservation(Vec::new()) };
        for _ in 0..count * TRIES_PER_POSE {
            if poses.observations.len() == count {
                break;
            }
            let bar_rad: [f64; BAR_JOINTS] =
                std::array::from_fn(|_| random.random_range(-std::f64::consts::PI..std::f64::consts::PI));
            if singularity_margin_rad(&bar.links, &bar_rad) < design.bar_margin_deg.to_radians() {
                continue;
            }
            let near_rad = design.posture_rad(robot, limits, &mut random);
            let Ok(q) = robot_inverse(robot, &bar.forward(&bar_rad), &near_rad) else { continue };
            if is_regular(&q, &limits_with_margin, design) {
                let index = poses.joints.0.len();
                poses.observations.push(Observation::bar(PerObservation::time_s(index), bar_rad));
                poses.joints.0.push(q);
            }
        }
        let found = poses.observations.len();
        if found < count || count == 0 {
            return Err(TooFewPoses { found, wanted: count, base_m: design.base_m });
        }
        Ok(poses)
    }
}

/// Whether the robot's joints are within these limits and the wrist is not near a singular pose.
fn is_regular(q: &[f64], limits: &[[f64; 2]], design: &Design) -> bool {
    let within = |(q, [low, high]): (&f64, &[f64; 2])| (*low..*high).contains(q);
    q.iter().zip(limits).all(within) && design.wrist_is_bent(q)
}
