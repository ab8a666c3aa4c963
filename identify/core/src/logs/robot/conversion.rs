//! From the numbers that a controller logs to the joint variables of the model, and back.

use nalgebra::DMatrix;
use shared::config::{AngleUnit, JointKind, LogConversion, RobotConfig};

use crate::kinematics::{AXES_MAX, Joints};
use crate::logs::LogError;

/// `q = (raw * unit - offset) * T`, row vector times matrix, and its inverse.
///
/// `T` contains signs, gear ratios and the contribution of a motor to another joint (parallel rod, wrist gears).
#[derive(Debug, Clone, PartialEq)]
pub struct JointConversion {
    unit: AngleUnit,
    /// Whether a column is in metres; the others are in `unit`.
    prismatic: [bool; AXES_MAX],
    raw_offset: Joints,
    raw_to_joint: Vec<Joints>,
    joint_to_raw: Vec<Joints>,
}

fn row_times_matrix(row: &[f64], matrix: &[Joints]) -> Joints {
    let column = |j: usize| row.iter().zip(matrix).map(|(value, matrix_row)| value * matrix_row[j]).sum();
    Joints::from_fn(matrix.len(), column)
}

impl JointConversion {
    /// For a log whose columns are all angles, or in SI units.
    ///
    /// # Errors
    /// [`LogError::SingularConversion`] if a joint does not follow from the log.
    pub fn new(config: &LogConversion) -> Result<Self, LogError> {
        let axes = config.raw_to_joint.len();
        let square = config.raw_to_joint.iter().all(|row| row.len() == axes) && axes <= AXES_MAX;
        // A matrix that is not square becomes zero, and therefore singular.
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

    /// For the robot's own log, with columns of prismatic axes in metres.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn of(robot: &RobotConfig) -> Result<Self, LogError> {
        Ok(Self::new(&robot.log)?.with_prismatic(robot))
    }

    /// With the columns of the robot's prismatic axes in metres.
    #[must_use]
    pub(in crate::logs) fn with_prismatic(mut self, robot: &RobotConfig) -> Self {
        for (prismatic, kind) in self.prismatic.iter_mut().zip(robot.joint_kinds()) {
            *prismatic = kind == JointKind::Prismatic;
        }
        self
    }

    /// Number of columns and of axes.
    pub fn axes(&self) -> usize {
        self.raw_offset.len()
    }

    fn to_si(&self, raw: &[f64], unit: AngleUnit) -> Joints {
        let factor = |axis: usize| if self.prismatic[axis] { 1.0 } else { unit.to_rad() };
        raw.iter().take(self.axes()).enumerate().map(|(axis, value)| value * factor(axis)).collect()
    }

    /// One row of the log, in the log's units, to joint variables \[rad, m\].
    pub fn to_joint(&self, raw: &[f64]) -> Joints {
        self.to_joint_with_unit(raw, self.unit)
    }

    /// [`Self::to_joint`] as if the log's angles were in `unit`: to test whether a log is in the other unit.
    pub(in crate::logs) fn to_joint_with_unit(&self, raw: &[f64], unit: AngleUnit) -> Joints {
        let mut from_offset = self.to_si(raw, unit);
        from_offset.iter_mut().zip(self.raw_offset).for_each(|(value, offset)| *value -= offset);
        row_times_matrix(&from_offset, &self.raw_to_joint)
    }

    /// Speeds of one row, in the log's units per second, to joint rates \[rad/s, m/s\].
    pub fn to_joint_rate(&self, raw_per_s: &[f64]) -> Joints {
        row_times_matrix(&self.to_si(raw_per_s, self.unit), &self.raw_to_joint)
    }

    /// Torques \[N m\] on the axes of one row of the log to torques of the joints. Both do the same work, so that those of the
    /// joints are the inverse of `T` times the column vector of those of the log.
    pub fn to_joint_torque(&self, raw_nm: &[f64]) -> Joints {
        self.joint_to_raw
            .iter()
            .map(|row| row.iter().zip(raw_nm).map(|(factor, torque)| factor * torque).sum())
            .collect()
    }

    /// Joint variables \[rad, m\] to one row of the log, in the log's units.
    pub fn to_raw(&self, joint: &[f64]) -> Joints {
        let mut raw = row_times_matrix(joint, &self.joint_to_raw);
        for (axis, value) in raw.iter_mut().enumerate() {
            let factor = if self.prismatic[axis] { 1.0 } else { self.unit.to_rad() };
            *value = (*value + self.raw_offset[axis]) / factor;
        }
        raw
    }
}
