//! From the numbers that a controller logs to the joint variables of the model, and back.

use nalgebra::{Matrix6, RowVector6, Vector6};
use shared::config::{AngleUnit, LogConversion};

use super::LogError;

/// `q = (raw * unit - offset) * T`, row vector times matrix, and its inverse.
///
/// `T` holds signs, gear ratios and what one motor contributes to another joint (parallel rod, wrist gears).
#[derive(Debug, Clone, PartialEq)]
pub struct JointConversion {
    unit: AngleUnit,
    raw_offset_rad: RowVector6<f64>,
    raw_to_joint: Matrix6<f64>,
    joint_to_raw: Matrix6<f64>,
}

impl JointConversion {
    /// From a robot's configuration.
    ///
    /// # Errors
    /// [`LogError::SingularConversion`] where some joint does not follow from the log.
    pub fn new(config: &LogConversion) -> Result<Self, LogError> {
        let raw_to_joint = Matrix6::from_fn(|row, column| config.raw_to_joint[row][column]);
        let joint_to_raw = raw_to_joint.try_inverse().ok_or(LogError::SingularConversion)?;
        Ok(Self {
            unit: config.unit,
            raw_offset_rad: RowVector6::from(config.raw_offset_rad),
            raw_to_joint,
            joint_to_raw,
        })
    }

    /// One row of the log, in the log's unit, to joint variables \[rad\].
    pub fn to_joint(&self, raw: &[f64; 6]) -> [f64; 6] {
        self.to_joint_with_unit(raw, self.unit)
    }

    /// [`Self::to_joint`] as if the log were in `unit`: tells whether a log makes sense in the other unit.
    pub(super) fn to_joint_with_unit(&self, raw: &[f64; 6], unit: AngleUnit) -> [f64; 6] {
        let raw_rad = RowVector6::from(*raw) * unit.to_rad();
        let joint: RowVector6<f64> = (raw_rad - self.raw_offset_rad) * self.raw_to_joint;
        std::array::from_fn(|index| joint[index])
    }

    /// Speeds of one row, in the log's unit per second, to joint rates \[rad/s\].
    pub fn to_joint_rate(&self, raw_per_s: &[f64; 6]) -> [f64; 6] {
        let joint: RowVector6<f64> = RowVector6::from(*raw_per_s) * self.unit.to_rad() * self.raw_to_joint;
        std::array::from_fn(|index| joint[index])
    }

    /// Torques \[N m\] on the axes of one row of the log to torques of the joints: both do the same work.
    pub fn to_joint_torque(&self, raw_nm: &[f64; 6]) -> [f64; 6] {
        let joint: Vector6<f64> = self.joint_to_raw * Vector6::from(*raw_nm);
        joint.into()
    }

    /// Joint variables \[rad\] to one row of the log, in the log's unit.
    pub fn to_raw(&self, joint_rad: &[f64; 6]) -> [f64; 6] {
        let raw_rad: RowVector6<f64> = RowVector6::from(*joint_rad) * self.joint_to_raw + self.raw_offset_rad;
        std::array::from_fn(|index| raw_rad[index] / self.unit.to_rad())
    }
}
