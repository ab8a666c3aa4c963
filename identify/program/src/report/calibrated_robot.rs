//! A robot as a calibration file describes it: the pose of its end at reported joints, the reported joints for a pose, and the
//! covariance of the pose, `J C J'` with the covariance `C` of the parameters and the derivatives `J` of the pose. For programs
//! that use a calibration, and the Python package.

use nalgebra::{DMatrix, Matrix6, Matrix6xX};
use shared::config::{BallBarConfig, RobotConfig};

use super::result::file::CalibrationFile;
use super::result::knowledge::CovarianceEntry;
use crate::kinematics::{
    InverseError, Joints, Pose, Trace, Tracer, Twist, flange_chain, robot_chain, robot_inverse,
};
use crate::model::{DriveTrain, Geometry, JointErrors, JointState, Owner, ParameterId};

/// Joints have converged if they change by less \[rad, m\]: a hundredth of the resolution of any encoder.
const CONVERGED: f64 = 1e-10;
/// Each iteration multiplies the error by the slope of the joint errors over the angle, a few thousandths.
const ITERATIONS_MAX: usize = 20;

/// Why a calibrated robot gives no pose, joints or covariance.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibratedRobotError {
    /// The calibration is of another robot.
    #[error(
        "the calibration's parameter `{name}` is none of {robot}; give the robot's configuration that it was made with"
    )]
    Parameter {
        /// Such as `ra1`.
        name: String,
        /// Name of the configured robot.
        robot: String,
    },
    /// A posture has another number of joints.
    #[error("a posture has {found} joints, the robot has {expected}; give one number for each axis")]
    Joints {
        /// Joints in the posture.
        found: usize,
        /// Axes of the robot.
        expected: usize,
    },
    /// A number is not finite.
    #[error("joint {joint} of a posture is not a finite number; correct it")]
    NotFinite {
        /// Number of the joint, from 1.
        joint: usize,
    },
    /// No joints bring it there.
    #[error(transparent)]
    Inverse(#[from] InverseError),
    /// The file has no covariance.
    #[error(
        "the calibration has no covariance, as in calibration.toml; give calibration.json or its directory"
    )]
    NoCovariance,
    /// The file has a covariance, but not of this parameter of the robot.
    #[error(
        "the calibration has no uncertainty of `{name}`: its measurements do not determine it; calibrate with more poses"
    )]
    NotIdentified {
        /// Such as `ra1`.
        name: String,
    },
}

/// A robot as calibrated, its end where the calibration's last link ends: the flange, or the end of the ball-bar's plate.
#[derive(Debug, Clone)]
pub struct CalibratedRobot {
    geometry: Geometry,
    /// The uncertain parameters and their covariance, or why it is unknown.
    covariance: Result<(Vec<ParameterId>, DMatrix<f64>), CalibratedRobotError>,
}

impl CalibratedRobot {
    /// From a calibration and what it was made with; `bar` where a ball-bar was.
    ///
    /// # Errors
    /// [`CalibratedRobotError::Parameter`].
    pub fn new(
        file: &CalibrationFile,
        robot: &RobotConfig,
        bar: Option<&BallBarConfig>,
    ) -> Result<Self, CalibratedRobotError> {
        let nominal = bar.map_or_else(|| flange_chain(robot), |bar| robot_chain(robot, bar));
        let drives = DriveTrain::of(robot, &nominal);
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

    /// Axes of the robot.
    pub fn axes(&self) -> usize {
        self.geometry.robot.links.len()
    }

    /// Where the robot's end is when it stands still and reports these joints \[rad, m\].
    ///
    /// # Errors
    /// [`CalibratedRobotError::Joints`], [`CalibratedRobotError::NotFinite`].
    pub fn forward(&self, reported: &[f64]) -> Result<Pose, CalibratedRobotError> {
        Ok(self.geometry.robot_end(&self.at_rest(reported)?))
    }

    /// The joints that the robot reports at a pose, of all solutions the one nearest to `near` \[rad, m\].
    ///
    /// # Errors
    /// [`CalibratedRobotError::Joints`], [`CalibratedRobotError::NotFinite`], [`CalibratedRobotError::Inverse`].
    pub fn inverse(&self, target: &Pose, near: &[f64]) -> Result<Joints, CalibratedRobotError> {
        // Joints without their errors; those reported follow by fixed-point iteration.
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

    /// Covariance of position \[m\] and rotation vector \[rad\] of the robot's end in its base frame, at rest at reported
    /// joints, as far as the calibration's own parameters make it uncertain: first-order propagation (JCGM 100:2008, 5.2).
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

    /// The state of the joints at standstill; an error if their number is wrong or one is not finite.
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

/// Uncertain parameters of the robot and their covariance. One that is not identified is an error: as zero, its covariance would
/// make it exact.
fn robot_covariance(all: &CovarianceEntry) -> Result<(Vec<ParameterId>, DMatrix<f64>), CalibratedRobotError> {
    let names = all.names.iter().enumerate();
    let (columns, ids): (Vec<usize>, Vec<ParameterId>) =
        names.filter_map(|(column, name)| Some((column, robot_parameter(name)?))).unzip();
    let mut covariance = DMatrix::zeros(columns.len(), columns.len());
    for (i, &a) in columns.iter().enumerate() {
        // From the diagonal, so that an error names the parameter that is not identified.
        for (j, &b) in columns[..=i].iter().enumerate().rev() {
            let not_identified = || CalibratedRobotError::NotIdentified { name: all.names[a].clone() };
            let entry = all.between(a, b).ok_or_else(not_identified)?;
            (covariance[(i, j)], covariance[(j, i)]) = (entry, entry);
        }
    }
    Ok((ids, covariance))
}

/// A parameter of the robot itself by its name; none for those of instruments and of other runs.
fn robot_parameter(name: &str) -> Option<ParameterId> {
    name.parse().ok().filter(|id: &ParameterId| id.owner() == Owner::Robot)
}
