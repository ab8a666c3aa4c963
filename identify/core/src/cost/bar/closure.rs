//! Closure errors of a fitted geometry at each sample. A closure error is the difference between the end of the robot's
//! chain and the end of the bar's chain. Used by [`crate::evaluate`] and for the deviations of a ball-bar run.

use nalgebra::Vector3;

use crate::cost::problem::{LoopPoint, readings};
use crate::kinematics::{Twist, rotation_vector, singularity_margin_rad};
use crate::model::{BarForce, Geometry, JointState, Observation, RobotMotion};

/// The closed chain at one sample.
#[derive(Debug, Clone)]
pub struct Closure {
    /// Time on the bar's clock, since the reference time \[s\].
    pub t_s: f64,
    /// Robot joints as reported, at that instant.
    pub joints: JointState,
    /// Position of the robot's end minus position of the bar's end, in the robot's base \[m\].
    pub position_error_m: Vector3<f64>,
    /// Rotation from the bar's end to the robot's end, as a rotation vector in the robot's base \[rad\].
    pub turned_rad: Vector3<f64>,
    /// Distance of the robot's end from the centre of the gimbal, minus the length of the bar under its force and
    /// in its direction \[m\].
    pub off_sphere_m: f64,
    /// Elongation of the bar by the force \[m\].
    pub by_force_m: f64,
    /// Axial force on the bar.
    pub force: BarForce,
    /// Unit vector from the centre of the gimbal to the robot's end, in the robot's base.
    pub direction: Vector3<f64>,
    /// Distance from the nearest singular pose of the bar \[rad\].
    pub margin_rad: f64,
    /// Twist of the robot's end per unit rate of each joint.
    pub joint_twists: Vec<Twist>,
}

impl Closure {
    /// Distance between the two ends \[m\]. Without encoders at the first two joints (`by_encoders` is false), the
    /// bar's end is unknown, and this is the distance of the robot's end from the sphere of the bar.
    pub fn gap_m(&self, by_encoders: bool) -> f64 {
        if by_encoders { self.position_error_m.norm() } else { self.off_sphere_m.abs() }
    }
}

/// Closures at all observations, for one geometry. Angles of joints without encoder must have been filled in.
/// Observations outside the robot's log are omitted.
pub fn loop_closures(
    geometry: &Geometry,
    motion: &impl RobotMotion,
    observations: &[Observation],
) -> Vec<Closure> {
    let mut point = LoopPoint::new(geometry.clone());
    let closure = |(sample, observation): (usize, &Observation)| {
        let readings = readings(observation);
        let scene = point.scene(motion, sample, observation, &readings)?;
        let base_to_end_m = scene.robot.position_m() - geometry.base.origin_m;
        Some(Closure {
            t_s: observation.t_s,
            joints: scene.joints.reported,
            position_error_m: scene.robot.position_m() - scene.bar.position_m(),
            turned_rad: rotation_vector(&(scene.robot.rotation() * scene.bar.rotation().transpose())),
            off_sphere_m: base_to_end_m.norm() - scene.rod_m(),
            by_force_m: geometry.elongation.extension_m(&observation.force),
            force: observation.force,
            direction: base_to_end_m / base_to_end_m.norm().max(f64::MIN_POSITIVE),
            margin_rad: singularity_margin_rad(&geometry.bar_links, &scene.bar_rad),
            joint_twists: scene.robot.joint_twists().collect(),
        })
    };
    observations.iter().enumerate().filter_map(closure).collect()
}
