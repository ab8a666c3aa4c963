//! Where a tracker stands and what it follows: two unknown rigid transforms between it and the robot.

use nalgebra::{Rotation3, Vector3};

use super::Axis;
use crate::kinematics::Pose;

/// A rigid transform in six numbers: position and rotation vector, so that no orientation of a real set-up is singular
/// (a rotation vector is regular up to a whole turn, and none longer than half a turn is needed).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Placement {
    /// Origin \[m\].
    pub position_m: Vector3<f64>,
    /// Axis times angle \[rad\].
    pub rotation_rad: Vector3<f64>,
}

impl Placement {
    /// The six numbers of a transform.
    pub fn of(pose: &Pose) -> Self {
        // Through the quaternion: the matrix' own logarithm loses digits near zero and near half a turn.
        let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&pose.rotation);
        Self { position_m: pose.translation.vector, rotation_rad: rotation.scaled_axis() }
    }

    /// The transform.
    pub fn pose(&self) -> Pose {
        Pose::from_parts(self.position_m.into(), Rotation3::new(self.rotation_rad))
    }

    /// Angular velocity, in the frame that the placement is given in, when one entry of the rotation vector grows at
    /// unit speed: a column of the left Jacobian `1 + (1 - cos t)/t^2 [w] + (t - sin t)/t^3 [w]^2`, `t = |w|`.
    pub fn turning(&self, axis: Axis) -> Vector3<f64> {
        let w = self.rotation_rad;
        let squared = w.norm_squared();
        // Both quotients cancel for small angles; their series there.
        let (once, twice) = if squared < 1e-4 {
            (
                0.5 - squared / 24.0 + squared * squared / 720.0,
                1.0 / 6.0 - squared / 120.0 + squared * squared / 5040.0,
            )
        } else {
            let angle = squared.sqrt();
            ((1.0 - angle.cos()) / squared, (angle - angle.sin()) / (squared * angle))
        };
        let unit = Vector3::ith(axis.index(), 1.0);
        let across = w.cross(&unit);
        unit + across * once + w.cross(&across) * twice
    }
}

/// A tracker that follows a probe on the flange.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tracker {
    /// `root_from_tracker`: where the tracker stands.
    pub place: Placement,
    /// `flange_from_probe`: how the probe is mounted.
    pub probe: Placement,
}
