//! Lengths of a draw-wire between the cell and the flange.

use nalgebra::{Point3, Vector3};
use rand::Rng;
use rand_distr::StandardNormal;

use super::{Experiment, SimulateError, Stream, Truth, random};
use crate::instrument::LengthRow;
use crate::kinematics::{Joints, flange_chain};

/// Where the wire is held, in the flange's frame \[m\].
pub const ATTACHMENT_M: [f64; 3] = [0.12, 0.03, 0.05];
/// The wire comes out of the instrument there, in the robot's base \[m\].
const ANCHOR_M: [f64; 3] = [0.6, -1.1, 0.1];
/// The instrument shows so much more than the wire's length \[m\].
const OFFSET_M: f64 = 0.15;

/// `count` random postures within the joint limits, each with the length that an instrument with this noise \[m\] shows; and what
/// is true of the robot to its flange.
///
/// # Errors
/// [`SimulateError`] where the experiment makes no sense.
pub fn wire_rows(
    experiment: &Experiment<'_>,
    count: usize,
    noise_m: f64,
) -> Result<(Vec<LengthRow>, Truth), SimulateError> {
    experiment.check()?;
    let (flange, [_, bar]) = (flange_chain(experiment.robot), experiment.nominal());
    let truth = Truth::new(experiment, &flange, &bar);
    let robot = truth.robot_chain(&flange);
    let limits = experiment.robot.joint_limits();
    let mut postures = random(experiment.seed, Stream::Postures);
    let mut noise = random(experiment.seed, Stream::Wire);
    let mut reading = experiment.robot_reading();
    let row = |_| {
        let q_rad = Joints::from_fn(limits.len(), |joint| {
            let [low, high] = limits[joint];
            low + (high - low) * postures.random::<f64>()
        });
        let held: Vector3<f64> = (robot.forward(&q_rad) * Point3::from(ATTACHMENT_M)).coords;
        let error_m = noise_m * noise.sample::<f64, _>(StandardNormal);
        let length_m = (held - Vector3::from(ANCHOR_M)).norm() + OFFSET_M + error_m;
        LengthRow { joints_rad: reading.of(&q_rad), length_m, ..LengthRow::default() }
    };
    Ok(((0..count).map(row).collect(), truth))
}
