//! A robot as described by a calibration file, for programs that use a calibration and for the Python package.
//! [`CalibratedRobot`] computes three quantities: the pose of the robot's end at reported joint positions, the joint
//! positions that the robot reports at a given pose, and the covariance of the pose. The covariance is `J C J'`, where `C`
//! is the covariance of the parameters and `J` contains the derivatives of the pose with respect to the parameters.

use nalgebra::{DMatrix, Matrix6, Matrix6xX};
use shared::config::{BallBarConfig, RobotConfig};

use super::result::file::CalibrationFile;
use super::result::knowledge::CovarianceEntry;
use crate::kinematics::{
    InverseError, Joints, Pose, Trace, Tracer, Twist, flange_chain, robot_chain, robot_inverse,
};
use crate::model::{DriveTrain, Geometry, JointErrors, JointState, Owner, ParameterId};

/// The iteration in [`CalibratedRobot::inverse`] has converged if every joint changes by less than this in one step
/// \[rad, m\]. The limit is a hundredth of the resolution of the finest encoders.
const CONVERGED: f64 = 1e-10;
/// Largest number of iterations in [`CalibratedRobot::inverse`]. Few iterations suffice, because each one multiplies the
/// error by the derivative of the joint errors with respect to the joint angle, which is a few thousandths.
const ITERATIONS_MAX: usize = 20;

/// Reasons why a pose, joint positions or a covariance cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibratedRobotError {
    /// The calibration contains a parameter that the configured robot does not have.
    #[error(
        "the calibration's parameter `{name}` is none of {robot}; give the robot's configuration that it was made with"
    )]
    Parameter {
        /// Name of the parameter, such as `ra1`.
        name: String,
        /// Name of the configured robot.
        robot: String,
    },
    /// The number of joints in a posture differs from the number of axes of the robot.
    #[error("a posture has {found} joints, the robot has {expected}; give one number for each axis")]
    Joints {
        /// Number of joints in the posture.
        found: usize,
        /// Number of axes of the robot.
        expected: usize,
    },
    /// A joint position is not finite.
    #[error("joint {joint} of a posture is not a finite number; correct it")]
    NotFinite {
        /// Number of the joint, from 1.
        joint: usize,
    },
    /// No joint positions were found for the pose.
    #[error(transparent)]
    Inverse(#[from] InverseError),
    /// The file has no covariance.
    #[error(
        "the calibration has no covariance, as in calibration.toml; give calibration.json or its directory"
    )]
    NoCovariance,
    /// The file has a covariance, but this parameter of the robot was not identified.
    #[error(
        "the calibration has no uncertainty of `{name}`: its measurements do not determine it; calibrate with more poses"
    )]
    NotIdentified {
        /// Name of the parameter, such as `ra1`.
        name: String,
    },
}

/// A calibrated robot. The robot's end is the frame at the end of the calibration's last link: the flange or, if a ball-bar
/// was used, the end of the bar's plate and tool.
#[derive(Debug, Clone)]
pub struct CalibratedRobot {
    geometry: Geometry,
    /// Uncertain parameters of the robot and their covariance, or the reason why the covariance is unknown.
    covariance: Result<(Vec<ParameterId>, DMatrix<f64>), CalibratedRobotError>,
}

impl CalibratedRobot {
    /// Creates the robot from a calibration file and the configurations of robot and ball-bar with which the calibration was
    /// made. `bar` is `None` if no ball-bar was used.
    ///
    /// # Errors
    /// [`CalibratedRobotError::Parameter`].
    pub fn new(
        file: &CalibrationFile,
        robot: &RobotConfig,
        bar: Option<&BallBarConfig>,
    ) -> Result<Self, CalibratedRobotError> {
        let nominal = bar.map_or_else(|| flange_chain(robot), |bar| robot_chain(robot, bar));
        let drives = DriveTrain::from_robot(robot, &nominal);
        let mut geometry = Geometry { joints: JointErrors::none(drives), ..Geometry::new(nominal, None) };
        for entry in &file.parameters {
            let Some(id) = robot_parameter(&entry.name) else { continue };
            *geometry.parameter_mut(id).ok_or_else(|| CalibratedRobotError::Parameter {
                name: entry.name.clone(),
                robot: robot.name.clone(),
            })? = entry.value;
        }
        let covariance =
            file.covariance.as_ref().ok_or(CalibratedRobotError::NoCovariance).and_then(robot_covariance);
        Ok(Self { geometry, covariance })
    }

    /// Number of axes of the robot.
    pub fn axes(&self) -> usize {
        self.geometry.robot.links.len()
    }

    /// Pose of the robot's end when the robot stands still and reports these joint positions \[rad, m\].
    ///
    /// # Errors
    /// [`CalibratedRobotError::Joints`], [`CalibratedRobotError::NotFinite`].
    pub fn forward(&self, reported: &[f64]) -> Result<Pose, CalibratedRobotError> {
        Ok(self.geometry.robot_end(&self.at_rest(reported)?))
    }

    /// Computes the joint positions \[rad, m\] that the robot reports when its end is at the pose `target`. If several
    /// solutions exist, the solution nearest to `near` is returned.
    ///
    /// # Errors
    /// [`CalibratedRobotError::Joints`], [`CalibratedRobotError::NotFinite`], [`CalibratedRobotError::Inverse`].
    pub fn inverse(&self, target: &Pose, near: &[f64]) -> Result<Joints, CalibratedRobotError> {
        // `wanted` are the true joint positions, from inverse kinematics. A fixed-point iteration then finds the reported
        // joint positions that are equal to `wanted` after the correction of joint errors.
        let wanted = robot_inverse(&self.geometry.robot, target, &self.at_rest(near)?.q)?;
        let (mut reported, mut largest_error) = (wanted, f64::INFINITY);
        for _ in 0..ITERATIONS_MAX {
            let corrected = self.geometry.corrected(&JointState::at_rest(reported)).q;
            largest_error = 0.0;
            for ((reported, wanted), corrected) in reported.iter_mut().zip(&wanted).zip(&corrected) {
                *reported += wanted - corrected;
                largest_error = largest_error.max((wanted - corrected).abs());
            }
            if largest_error < CONVERGED {
                return Ok(reported);
            }
        }
        Err(InverseError::NotConverged { iterations: ITERATIONS_MAX, step_rad: largest_error }.into())
    }

    /// Computes the covariance of the pose of the robot's end when the robot stands still and reports these joint positions:
    /// position \[m\], then rotation vector \[rad\], in the robot's base frame. The covariance results from the uncertainty
    /// of the robot's parameters alone, propagated to first order (JCGM 100:2008, 5.2).
    ///
    /// # Errors
    /// [`CalibratedRobotError::Joints`], [`CalibratedRobotError::NotFinite`], [`CalibratedRobotError::NoCovariance`],
    /// [`CalibratedRobotError::NotIdentified`].
    pub fn covariance(&self, reported: &[f64]) -> Result<Matrix6<f64>, CalibratedRobotError> {
        let (ids, covariance) = self.covariance.as_ref().map_err(Clone::clone)?;
        let joints = self.geometry.at_rest(self.at_rest(reported)?);
        let mut trace = Trace::default();
        Tracer::new(&self.geometry.robot).trace(&joints.corrected.q, &mut trace);
        let derivative = |id: &ParameterId| {
            let twist = self.geometry.end_twist(&joints, &trace, *id);
            twist.map_or_else(Default::default, |twist: Twist| twist.column())
        };
        let jacobian = Matrix6xX::from_columns(&ids.iter().map(derivative).collect::<Vec<_>>());
        Ok(&jacobian * covariance * jacobian.transpose())
    }

    /// State of the joints at standstill. Returns an error if the number of joints is wrong or a joint
    /// position is not finite.
    fn at_rest(&self, reported: &[f64]) -> Result<JointState, CalibratedRobotError> {
        if reported.len() != self.axes() {
            return Err(CalibratedRobotError::Joints { found: reported.len(), expected: self.axes() });
        }
        if let Some(joint) = reported.iter().position(|joint| !joint.is_finite()) {
            return Err(CalibratedRobotError::NotFinite { joint: joint + 1 });
        }
        Ok(JointState::at_rest(reported.iter().copied().collect::<Joints>()))
    }
}

/// Selects the uncertain parameters of the robot and their covariance. If one of these parameters was not identified, an
/// error is returned, because a covariance of zero would mean that the parameter is known exactly.
fn robot_covariance(all: &CovarianceEntry) -> Result<(Vec<ParameterId>, DMatrix<f64>), CalibratedRobotError> {
    let names = all.names.iter().enumerate();
    let (columns, ids): (Vec<usize>, Vec<ParameterId>) =
        names.filter_map(|(column, name)| Some((column, robot_parameter(name)?))).unzip();
    let mut covariance = DMatrix::zeros(columns.len(), columns.len());
    for (i, &a) in columns.iter().enumerate() {
        // The inner loop starts at the diagonal element, so that the error names the parameter that was not identified.
        for (j, &b) in columns[..=i].iter().enumerate().rev() {
            let not_identified = || CalibratedRobotError::NotIdentified { name: all.names[a].clone() };
            let entry = all.between(a, b).ok_or_else(not_identified)?;
            (covariance[(i, j)], covariance[(j, i)]) = (entry, entry);
        }
    }
    Ok((ids, covariance))
}

/// Parses the name of a parameter of the robot. Returns `None` for parameters of instruments and for parameters with the
/// number of a run, such as `ox@2`.
fn robot_parameter(name: &str) -> Option<ParameterId> {
    name.parse().ok().filter(|id: &ParameterId| id.owner() == Owner::Robot)
}
