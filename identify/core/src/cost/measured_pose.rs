//! Cost for a pose that is measured at each pose of the robot, by a tracker with a six-degree-of-freedom probe on the flange.

use nalgebra::{Matrix3, Vector3};

use super::bar::pose::inverse_left_jacobian;
use super::measured_position::Sighting;
use super::{Residual, Scene};
use crate::kinematics::rotation_vector;
use crate::logs::PoseRow;
use crate::model::{Owner, ParameterId};

/// Noise of a measured pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseNoise {
    /// Standard deviation of each position coordinate \[m\].
    pub position_m: f64,
    /// Standard deviation of each component of the rotation vector \[rad\].
    pub rotation_rad: f64,
}

/// The residual compares two poses of the probe. `H = R probe` is predicted by the robot (`held`). `S = T measured` is
/// observed by the tracker (`seen`), where `T` is the tracker's pose and the measured position is divided by `1 + scale`.
/// The first three entries are the position of `H` minus the position of `S`, in the robot's base. The other three are the
/// rotation vector of `S^-1 H`. Each entry is divided by its standard deviation.
///
/// Samples without a row or a rotation are ignored.
#[derive(Debug, Clone, Copy)]
pub struct MeasuredPose<'a> {
    /// Each sample with its pose and set-up.
    pub rows: &'a [PoseRow],
    /// Noise of each measurement.
    pub noise: &'a [PoseNoise],
}

/// Predicted and observed pose of the probe, and the rotation between them.
#[derive(Debug, Clone, Copy)]
pub struct TurnedSighting {
    sighting: Sighting,
    /// Rotation vector of `S^-1 H` \[rad\].
    turn_rad: Vector3<f64>,
    /// Derivative of `turn_rad` with respect to the angular velocity of `H` relative to `S`, in the robot's base.
    by_angular: Matrix3<f64>,
}

impl Residual for MeasuredPose<'_> {
    type Local = TurnedSighting;

    const NAME: &'static str = "measured_pose";
    const ROWS: usize = 6;
    const OWNER: Owner = Owner::Tracker;

    fn local(&self, scene: &Scene<'_>) -> Option<TurnedSighting> {
        let row = self.rows.get(scene.sample).filter(|row| row.rotation.is_some())?;
        let sighting = Sighting::new(scene, row, *self.noise.get(scene.sample)?)?;
        let seen_from_root = sighting.seen.rotation.matrix().transpose();
        let turn_rad = rotation_vector(&(seen_from_root * sighting.held.rotation.matrix()));
        let by_angular = inverse_left_jacobian(&turn_rad) * seen_from_root;
        Some(TurnedSighting { sighting, turn_rad, by_angular })
    }

    fn residual(&self, _: &Scene<'_>, local: &TurnedSighting, out: &mut [f64]) {
        local.write(&local.sighting.position_error_m(), &local.turn_rad, out);
    }

    fn derivative(&self, scene: &Scene<'_>, local: &TurnedSighting, id: ParameterId, out: &mut [f64]) {
        if let Some(twist) = local.sighting.parting(scene, id) {
            local.write(&twist.linear, &(local.by_angular * twist.angular), out);
        }
    }
}

impl TurnedSighting {
    /// Writes position and rotation in units of their standard deviations.
    fn write(&self, linear_m: &Vector3<f64>, angular_rad: &Vector3<f64>, out: &mut [f64]) {
        let linear = linear_m / self.sighting.noise.position_m;
        let angular = angular_rad / self.sighting.noise.rotation_rad;
        for (out, value) in out.iter_mut().zip(linear.iter().chain(angular.iter())) {
            *out = *value;
        }
    }
}
