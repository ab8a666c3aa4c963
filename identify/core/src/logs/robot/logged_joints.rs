//! The joints of a robot as a file contains them: their names and units, and their conversion to the joints of the model.

use shared::config::{AngleUnit, JointKind, LogConversion, RobotConfig};

use super::mapping::RobotLogMapping;
use super::table::own_columns;
use crate::kinematics::Joints;
use crate::logs::rows::pose_rows::JointUnit;
use crate::logs::{JointConversion, LogError};

/// Joints as a log or a table of rows contains them, base to flange.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedJoints {
    /// Names of the columns. In formats without columns: names of the joints.
    pub names: Vec<String>,
    /// Units of the columns.
    pub units: Vec<JointUnit>,
    /// Factors that convert the values of the file to the units of `conversion`. The conversion of a mapping is
    /// from radians and metres.
    pub(super) factors: Joints,
    /// Conversion to the joint variables of the model.
    pub(super) conversion: JointConversion,
}

impl LoggedJoints {
    /// The joints of the robot's own log.
    ///
    /// # Errors
    /// [`LogError::SingularConversion`].
    pub fn of_robot(robot: &RobotConfig) -> Result<Self, LogError> {
        Self::own(robot, robot.log.unit, own_columns(robot))
    }

    /// The joints that a mapping names.
    ///
    /// # Errors
    /// [`LogError::SingularConversion`].
    pub fn of_mapping(mapping: &RobotLogMapping) -> Result<Self, LogError> {
        let joints = &mapping.joints;
        Ok(Self {
            names: joints.iter().map(|joint| joint.column.clone()).collect(),
            units: joints.iter().map(|joint| joint.unit).collect(),
            factors: joints.iter().map(|joint| joint.unit.to_si()).collect(),
            conversion: JointConversion::new(&mapping.conversion())?,
        })
    }

    /// Joints with the conversion of the robot's configuration, with angles in `unit` and prismatic joints in metres.
    pub(super) fn own(robot: &RobotConfig, unit: AngleUnit, names: Vec<String>) -> Result<Self, LogError> {
        let unit_of = |kind: JointKind| match (kind, unit) {
            (JointKind::Revolute, AngleUnit::Rad) => JointUnit::Rad,
            (JointKind::Revolute, AngleUnit::Deg) => JointUnit::Deg,
            (JointKind::Prismatic, _) => JointUnit::M,
        };
        let conversion = JointConversion::new(&LogConversion { unit, ..robot.log.clone() })?;
        Ok(Self {
            names,
            units: robot.joint_kinds().map(unit_of).collect(),
            factors: Joints::from_fn(robot.axes(), |_| 1.0),
            conversion: conversion.with_prismatic(robot),
        })
    }

    /// Changes of the columns, in their units, that change the joint variables of the model by `offsets`. The conversion is
    /// affine, so the changes are the same at all joint positions. With `q = (raw - raw_offset) T`, they are the solution of
    /// `q + offsets = (raw + changes - raw_offset) T`.
    pub fn changes(&self, offsets: &Joints) -> Joints {
        let [with, without] =
            [*offsets, Joints::zeros(offsets.len())].map(|joints| self.conversion.to_raw(&joints));
        let changes = with.iter().zip(without).zip(self.factors);
        changes.map(|((with, without), factor)| (with - without) / factor).collect()
    }

    /// Standard deviations of [`Self::changes`], from those of the offsets. `None` if the standard deviation of the offset is
    /// not known, or if the change of the column depends on the offsets of several joints.
    pub fn sigmas(&self, of_offsets: &[Option<f64>]) -> Vec<Option<f64>> {
        let axes = of_offsets.len();
        let unit_offset = |joint: usize| Joints::from_fn(axes, |axis| if axis == joint { 1.0 } else { 0.0 });
        let by_joint: Vec<Joints> = (0..axes).map(|joint| self.changes(&unit_offset(joint))).collect();
        let sigma = |column: usize| {
            let mut causes = by_joint.iter().zip(of_offsets).filter(|(change, _)| change[column] != 0.0);
            let (change, sigma) = causes.next()?;
            let is_only = causes.next().is_none();
            sigma.filter(|_| is_only).map(|sigma| change[column].abs() * sigma)
        };
        (0..axes).map(sigma).collect()
    }
}
