//! A robot with random errors that moves a point of its flange to a given position, from above and within its joint limits.
//! The flange is on the outer side of the touched surface. The simulations of contacts (`contact`) and touches (`touch`) use
//! this robot.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use shared::config::RobotConfig;

use super::effects::{GEAR_PERIODS, Wave};
use super::{RandomStream, random};
use crate::kinematics::{Chain, DhLink, Joints, Trace, Tracer, flange_chain};
use crate::model::DriveTrain;
use crate::statistics::largest_size;

/// Smallest cosine of the angle between the stem and the downward vertical. The stem is the line from the
/// flange to the point.
const STEM_COSINE_MIN: f64 = 0.4;
/// Smallest cosine of the angle between the stem and the inward normal of the touched surface. The distance of the flange
/// from the surface is then a fifth of the stem's length or more.
const OUTER_COSINE_MIN: f64 = 0.2;
/// Postures are drawn from this fraction of the joints' travel.
const TRAVEL: f64 = 0.9;

/// Errors of a simulated robot.
#[derive(Debug, Clone, Copy)]
pub struct ArmErrors {
    /// Standard deviation of the error of each link parameter \[mm|mrad\].
    pub errors_mm_mrad: f64,
    /// Standard deviation of the white noise of each joint \[urad|um\].
    pub robot_noise_urad: f64,
    /// Amplitude of the gear errors \[urad\]. The error has two periods per turn of each drive's output, as
    /// from an eccentric gear.
    pub gear_sine_urad: f64,
    /// Seed of the robot's errors. Experiments with the same seed have the same robot.
    pub robot_seed: u64,
}

impl Default for ArmErrors {
    fn default() -> Self {
        Self { errors_mm_mrad: 1.0, robot_noise_urad: 15.0, gear_sine_urad: 30.0, robot_seed: 1 }
    }
}

impl ArmErrors {
    /// All sizes of errors, with the names of their options.
    pub(super) fn sizes(&self) -> [(&'static str, f64); 3] {
        [
            ("errors_mm_mrad", self.errors_mm_mrad),
            ("robot_noise_urad", self.robot_noise_urad),
            ("gear_sine_urad", self.gear_sine_urad),
        ]
    }
}

/// A robot with errors of links and gears, and a point on its flange.
pub(super) struct Arm {
    /// Chain with the true links.
    pub(super) chain: Chain,
    errors: ArmErrors,
    drives: DriveTrain,
    gears: Vec<Wave>,
    tracer: Tracer,
    limits: Vec<[f64; 2]>,
    /// Position of the point in the flange frame \[m\].
    point_m: Vector3<f64>,
}

impl Arm {
    pub(super) fn new(robot: &RobotConfig, errors: ArmErrors, point_m: Vector3<f64>) -> Self {
        let mut drawn = random(errors.robot_seed, RandomStream::StaticErrors);
        let sigma = errors.errors_mm_mrad * 1e-3;
        let mut chain = flange_chain(robot);
        for link in &mut chain.links {
            let DhLink { a_m, d_m, alpha_rad, theta_rad, .. } = link;
            for number in [a_m, d_m, alpha_rad, theta_rad] {
                *number += sigma * drawn.sample::<f64, _>(StandardNormal);
            }
        }
        let gear = |_: &DhLink| Wave {
            amplitude_rad: errors.gear_sine_urad * 1e-6,
            periods: GEAR_PERIODS,
            phase_rad: drawn.random_range(0.0..TAU),
        };
        let gears = chain.links.iter().map(gear).collect();
        let drives = DriveTrain::from_robot(robot, &chain);
        Self {
            tracer: Tracer::new(&chain),
            errors,
            drives,
            gears,
            limits: robot.joint_limits(),
            point_m,
            chain,
        }
    }

    /// Joints that the controller reports at the joints `true_joints`. `noise(s)` returns a random number with the standard
    /// deviation `s`; `s` is in urad or um, the result in rad or m.
    pub(super) fn reported(&self, true_joints: &Joints, mut noise: impl FnMut(f64) -> f64) -> Joints {
        let mut joints = Joints::from_fn(true_joints.len(), |joint| {
            true_joints[joint] + noise(self.errors.robot_noise_urad)
        });
        for (drive, gear) in self.turning() {
            let error = gear.at(self.drives.of_drive(drive, true_joints));
            let turned = joints.iter_mut().zip(&self.drives.joint_from_drive[drive]);
            turned.for_each(|(q, part)| *q += part * error);
        }
        joints
    }

    /// Gear errors of the revolute drives, each with the index of its drive.
    fn turning(&self) -> impl Iterator<Item = (usize, &Wave)> {
        self.gears.iter().enumerate().filter(|(drive, _)| self.drives.turns(*drive))
    }

    /// Parameters of a calibration that correct the errors of the gears, by name \[rad\].
    pub(super) fn gear_terms(&self) -> Vec<(String, f64)> {
        if self.errors.gear_sine_urad == 0.0 {
            return Vec::new();
        }
        self.turning().flat_map(|(drive, gear)| gear.terms(&gear.periods.to_string(), drive)).collect()
    }

    /// Random joints, uniform over the middle [`TRAVEL`] of their limits.
    fn random(&self, random: &mut ChaCha8Rng) -> Joints {
        let joint = |[low, high]: &[f64; 2]| {
            let (middle, half) = (0.5 * (low + high), 0.5 * TRAVEL * (high - low));
            random.random_range(middle - half..=middle + half)
        };
        self.limits.iter().map(joint).collect()
    }

    /// Position of the point at these joints, and the stem \[m\].
    fn point(&self, joints: &Joints, trace: &mut Trace) -> (Vector3<f64>, Vector3<f64>) {
        self.tracer.trace(joints, trace);
        let stem_m = trace.rotation() * self.point_m;
        (trace.position_m() + stem_m, stem_m)
    }

    /// Finds joints near `start` that move the point to `there_m`. Newton steps of least norm are used:
    /// `J^T (J J^T)^-1 miss`, where `miss` is the remaining distance. `None` if the steps do not converge, if the result is
    /// outside the limits, or if the stem does not approach from above and from the side to which `outward` points.
    fn joints_near(&self, start: Joints, there_m: Vector3<f64>, outward: &Vector3<f64>) -> Option<Joints> {
        const STEPS: usize = 60;
        /// Largest change of a joint in one step \[rad, m\].
        const STEP_MAX: f64 = 0.3;
        const MISS_M: f64 = 1e-12;
        let (mut joints, mut trace) = (start, Trace::default());
        for _ in 0..STEPS {
            let (reached_m, stem_m) = self.point(&joints, &mut trace);
            let miss = there_m - reached_m;
            if miss.norm() < MISS_M {
                let within = joints.iter().zip(&self.limits).all(|(q, [low, high])| low <= q && q <= high);
                let from_outside = -stem_m.dot(outward) > OUTER_COSINE_MIN * stem_m.norm();
                return (within && is_from_above(&stem_m) && from_outside).then_some(joints);
            }
            let columns: Vec<Vector3<f64>> =
                trace.point_twists(reached_m, joints.len()).map(|twist| twist.linear).collect();
            let jjt: Matrix3<f64> = columns.iter().map(|column| column * column.transpose()).sum();
            let multiplier = (jjt + Matrix3::identity() * 1e-12).try_inverse()? * miss;
            let longest = largest_size(columns.iter().map(|column| column.dot(&multiplier)));
            let part = (STEP_MAX / longest).min(1.0);
            joints.iter_mut().zip(&columns).for_each(|(q, column)| *q += part * column.dot(&multiplier));
        }
        None
    }

    /// Positions of the point in random postures from above, sorted by decreasing number of neighbours, and the largest
    /// reach of the arm.
    pub(super) fn places(&self, random: &mut ChaCha8Rng) -> (Vec<Vector3<f64>>, f64) {
        const POSTURES: usize = 600;
        /// Positions within this distance are neighbours \[fraction of the reach\].
        const NEAR: f64 = 0.2;
        /// Positions within this distance of the first axis are excluded, because the robot itself is there
        /// \[fraction of the reach\].
        const BESIDE: f64 = 0.45;
        let mut trace = Trace::default();
        let points: Vec<(Vector3<f64>, Vector3<f64>)> =
            (0..POSTURES).map(|_| self.point(&self.random(random), &mut trace)).collect();
        let reach_m = points.iter().map(|(at, _)| at.norm()).fold(0.0, f64::max);
        let beside = |at: &Vector3<f64>| at.xy().norm() > BESIDE * reach_m;
        let from_above: Vec<Vector3<f64>> = points
            .iter()
            .filter(|(at, stem_m)| is_from_above(stem_m) && beside(at))
            .map(|(at, _)| *at)
            .collect();
        let near = |at: &Vector3<f64>| {
            from_above.iter().filter(|other| (*other - at).norm() < NEAR * reach_m).count()
        };
        let mut places = from_above.clone();
        places.sort_by_cached_key(|at| std::cmp::Reverse(near(at)));
        (places, reach_m)
    }

    /// Finds joints that move the point to the position `there_m` on a surface with the unit normal `outward`. Up to `tries`
    /// random start postures are tried, and the first that succeeds is used.
    pub(super) fn joints_at(
        &self,
        there_m: Vector3<f64>,
        outward: &Vector3<f64>,
        tries: usize,
        random: &mut ChaCha8Rng,
    ) -> Option<Joints> {
        (0..tries).find_map(|_| self.joints_near(self.random(random), there_m, outward))
    }
}

/// Whether a stem approaches its point from above.
fn is_from_above(stem_m: &Vector3<f64>) -> bool {
    -stem_m.z > STEM_COSINE_MIN * stem_m.norm()
}
