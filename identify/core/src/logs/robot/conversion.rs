//! Converts the numbers that a controller logs to the joint variables of the model, and back.

use nalgebra::DMatrix;
use shared::config::{AngleUnit, JointKind, LogConversion, RobotConfig};

use crate::kinematics::{AXES_MAX, Joints};
use crate::logs::LogError;

/// The conversion `q = (raw * unit - offset) * T` of a row `raw` of the log to joint variables `q`, and its inverse. `raw`,
/// `offset` and `q` are row vectors.
///
/// The matrix `T` contains signs, gear ratios, and the contribution of a motor to another joint (parallel rod, wrist gears).
#[derive(Debug, Clone, PartialEq)]
pub struct JointConversion {
    /// Unit of the columns with angles.
    unit: AngleUnit,
    /// Whether each column is in metres instead of `unit`.
    prismatic: [bool; AXES_MAX],
    /// Values of the columns at the model's zero \[rad, m\].
    raw_offset: Joints,
    /// The rows of `T`.
    raw_to_joint: Vec<Joints>,
    /// The rows of the inverse of `T`.
    joint_to_raw: Vec<Joints>,
}

fn row_times_matrix(row: &[f64], matrix: &[Joints]) -> Joints {
    let column = |j: usize| row.iter().zip(matrix).map(|(value, matrix_row)| value * matrix_row[j]).sum();
    Joints::from_fn(matrix.len(), column)
}

impl JointConversion {
    /// A conversion for a log in which all columns are angles in the unit of `config`, or in SI units.
    ///
    /// # Errors
    /// [`LogError::SingularConversion`] if the columns of the log do not determine all joints.
    pub fn new(config: &LogConversion) -> Result<Self, LogError> {
        let axes = config.raw_to_joint.len();
        let square = config.raw_to_joint.iter().all(|row| row.len() == axes) && axes <= AXES_MAX;
        // A matrix that is not square is replaced by zeros, so that it is reported as singular.
        let matrix = DMatrix::from_fn(axes, axes, |i, j| {
            config.raw_to_joint[i].get(j).copied().filter(|_| square).unwrap_or_default()
        });
        let inverse = matrix.clone().try_inverse().ok_or(LogError::SingularConversion)?;
        let rows =
            |matrix: &DMatrix<f64>| matrix.row_iter().map(|row| row.iter().copied().collect()).collect();
        Ok(Self {
            unit: config.unit,
            prismatic: [false; AXES_MAX],
            raw_offset: (0..axes)
                .map(|i| config.raw_offset_rad.get(i).copied().unwrap_or_default())
                .collect(),
            raw_to_joint: rows(&matrix),
            joint_to_raw: rows(&inverse),
        })
    }

    /// A conversion for the robot's own log, in which the columns of prismatic axes are in metres.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn from_robot(robot: &RobotConfig) -> Result<Self, LogError> {
        Ok(Self::new(&robot.log)?.with_prismatic(robot))
    }

    /// The same conversion, but with the columns of the robot's prismatic axes in metres.
    #[must_use]
    pub(in crate::logs) fn with_prismatic(mut self, robot: &RobotConfig) -> Self {
        for (prismatic, kind) in self.prismatic.iter_mut().zip(robot.joint_kinds()) {
            *prismatic = kind == JointKind::Prismatic;
        }
        self
    }

    /// Number of axes, which is also the number of columns.
    pub fn axes(&self) -> usize {
        self.raw_offset.len()
    }

    /// Converts the columns of one row to radians and metres, with angles in `unit`.
    fn to_si(&self, raw: &[f64], unit: AngleUnit) -> Joints {
        let factor = |axis: usize| if self.prismatic[axis] { 1.0 } else { unit.to_rad() };
        raw.iter().take(self.axes()).enumerate().map(|(axis, value)| value * factor(axis)).collect()
    }

    /// Converts one row of the log, in the log's units, to joint variables \[rad, m\].
    pub fn to_joint(&self, raw: &[f64]) -> Joints {
        self.to_joint_with_unit(raw, self.unit)
    }

    /// Like [`Self::to_joint`], but as if the log's angles were in `unit`, to test whether a log is in the other unit.
    pub(in crate::logs) fn to_joint_with_unit(&self, raw: &[f64], unit: AngleUnit) -> Joints {
        let mut from_offset = self.to_si(raw, unit);
        from_offset.iter_mut().zip(self.raw_offset).for_each(|(value, offset)| *value -= offset);
        row_times_matrix(&from_offset, &self.raw_to_joint)
    }

    /// Converts the speeds of one row, in the log's units per second, to joint rates \[rad/s, m/s\].
    pub fn to_joint_rate(&self, raw_per_s: &[f64]) -> Joints {
        row_times_matrix(&self.to_si(raw_per_s, self.unit), &self.raw_to_joint)
    }

    /// Converts the torques in one row of the log \[N m\], which act on the axes of the log, to torques of the joints.
    /// The power is the same on both sides, so the vector of joint torques is the inverse of `T` times the vector of
    /// torques in the log, both as column vectors.
    pub fn to_joint_torque(&self, raw_nm: &[f64]) -> Joints {
        self.joint_to_raw
            .iter()
            .map(|row| row.iter().zip(raw_nm).map(|(factor, torque)| factor * torque).sum())
            .collect()
    }

    /// Converts joint variables \[rad, m\] to one row of the log, in the log's units.
    pub fn to_raw(&self, joint: &[f64]) -> Joints {
        let mut raw = row_times_matrix(joint, &self.joint_to_raw);
        for (axis, value) in raw.iter_mut().enumerate() {
            let factor = if self.prismatic[axis] { 1.0 } else { self.unit.to_rad() };
            *value = (*value + self.raw_offset[axis]) / factor;
        }
        raw
    }
}
