//! Simulates lengths that a draw-wire measures at random postures of a robot with known errors.

use nalgebra::{Point3, Vector3};
use rand::Rng;
use rand_distr::StandardNormal;

use super::{Experiment, RandomStream, SimulateError, Truth, random};
use crate::kinematics::{Joints, flange_chain};
use crate::logs::LengthRow;

/// Attachment of the wire in the flange frame \[m\].
pub const ATTACHMENT_M: [f64; 3] = [0.12, 0.03, 0.05];
/// Anchor of the wire, where it leaves the instrument, in the robot's base frame \[m\].
const ANCHOR_M: [f64; 3] = [0.6, -1.1, 0.1];
/// Reading of the instrument minus the length of the wire \[m\].
const OFFSET_M: f64 = 0.15;

/// Simulates `count` random postures within the joint limits. Each row has the joints that the robot reports and the
/// measured length: the distance between attachment and anchor, plus an offset and white noise with standard deviation
/// `noise_m`. Also returns the true parameters up to the flange.
///
/// # Errors
/// [`SimulateError`] if the experiment is invalid.
pub fn wire_rows(
    experiment: &Experiment<'_>,
    count: usize,
    noise_m: f64,
) -> Result<(Vec<LengthRow>, Truth), SimulateError> {
    experiment.check()?;
    let (flange, [_, bar]) = (flange_chain(experiment.robot), experiment.nominal());
    let mut robot_reading = experiment.robot_reading();
    let mut truth = Truth::new(experiment, &flange, &bar);
    truth.parameters.extend(robot_reading.terms());
    let robot = truth.robot_chain(&flange);
    let limits = experiment.robot.joint_limits();
    let mut postures = random(experiment.seed, RandomStream::Postures);
    let mut noise = random(experiment.seed, RandomStream::Wire);
    let row = |_| {
        let q_rad = Joints::random(&limits, &mut postures);
        let attachment_in_base_m: Vector3<f64> = (robot.forward(&q_rad) * Point3::from(ATTACHMENT_M)).coords;
        let error_m = noise_m * noise.sample::<f64, _>(StandardNormal);
        let length_m = (attachment_in_base_m - Vector3::from(ANCHOR_M)).norm() + OFFSET_M + error_m;
        LengthRow { joints_rad: robot_reading.read(&q_rad), length_m, ..LengthRow::default() }
    };
    Ok(((0..count).map(row).collect(), truth))
}
