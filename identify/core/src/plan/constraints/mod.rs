//! Constraints of a path: singular postures, joint limits, speed, acceleration, and collisions. All planners and the check
//! of a path use these constraints. For each posture of the bar, inverse kinematics provides the robot's joints.

mod bodies;

use nalgebra::{Matrix6, Vector3, Vector6};

pub use bodies::{Bodies, Skeleton};

use super::{Design, Path};
use crate::kinematics::{
    Chain, InverseError, Joints, Pose, Trace, Tracer, robot_inverse_centred, singularity_margin_rad,
};
use crate::statistics::largest_size;

/// Time between two checked poses of a path during planning \[s\].
pub const LOOK_S: f64 = 0.05;

/// Violated constraint of a pose or a motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Obstacle {
    /// The bar is near a singular pose.
    BarSingularity,
    /// The robot's inverse kinematics has no solution.
    Reach,
    /// A robot joint is outside its limits, or too close to them.
    JointLimit,
    /// The robot's wrist is nearly straight.
    Wrist,
    /// The robot is near another singular posture.
    RobotSingularity,
    /// A robot joint would exceed its speed limit.
    Speed,
    /// A robot joint would exceed its acceleration limit.
    Acceleration,
    /// The clearance between rod or plate and the robot or the cell is too small.
    Collision,
    /// An encoder cable is wound up too far.
    Cable,
    /// The gap between the end of the robot and the end of the bar is too large.
    OffSphere,
}

impl std::fmt::Display for Obstacle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::BarSingularity => "singular poses of the bar",
            Self::Reach => "the robot's reach",
            Self::JointLimit => "joint limits of the robot",
            Self::Wrist => "the straight wrist",
            Self::RobotSingularity => "singular postures of the robot",
            Self::Speed => "the robot's joint speed",
            Self::Acceleration => "the robot's joint acceleration",
            Self::Collision => "collisions",
            Self::Cable => "the encoder cables",
            Self::OffSphere => "the bar's sphere",
        })
    }
}

/// Nominal robot and bar, and the constraints of their motion.
#[derive(Debug, Clone)]
pub struct Constraints<'a> {
    /// Chain of the nominal robot.
    pub robot: &'a Chain,
    tracer: Tracer,
    /// Chain of the nominal bar.
    pub bar: &'a Chain,
    /// Joint limits of the robot \[rad, m\].
    pub limits: Vec<[f64; 2]>,
    /// Joint limits of the robot after subtraction of the design's margin \[rad, m\].
    limits_with_margin: Vec<[f64; 2]>,
    /// Ranges, margins and highest speeds of the motion.
    pub design: &'a Design,
    /// Highest acceleration of a robot joint \[rad/s², m/s²\]; infinite if there is no limit.
    pub acceleration_rad_s2: f64,
    /// Bodies for the computation of collisions; `None` if collisions are not checked.
    pub bodies: Option<Bodies>,
}

impl<'a> Constraints<'a> {
    /// Constraints from the margins and speeds of a design. They include no bodies and no limit of acceleration. The base of
    /// `bar` is at the design's position.
    pub fn new(robot: &'a Chain, bar: &'a Chain, limits: &[[f64; 2]], design: &'a Design) -> Self {
        Self {
            robot,
            tracer: Tracer::new(robot),
            bar,
            limits: limits.to_vec(),
            limits_with_margin: design.limits_with_margin(robot, limits),
            design,
            acceleration_rad_s2: f64::INFINITY,
            bodies: None,
        }
    }

    /// Sets the bodies for the computation of collisions, and the highest acceleration of a robot joint \[rad/s², m/s²\].
    #[must_use]
    pub fn with(self, bodies: Option<Bodies>, acceleration_rad_s2: f64) -> Self {
        Self { bodies, acceleration_rad_s2, ..self }
    }

    /// The robot's joints at a bar posture, if bar and robot satisfy the constraints. If several solutions exist, the one
    /// nearest to `near_rad` is returned.
    ///
    /// # Errors
    /// The constraint that is violated first, in the order of the checks.
    pub fn robot_at(&self, bar_rad: &[f64; 5], near_rad: &[f64]) -> Result<Joints, Obstacle> {
        if singularity_margin_rad(&self.bar.links, bar_rad) < self.design.bar_margin_deg.to_radians() {
            return Err(Obstacle::BarSingularity);
        }
        let robot = self.inverse(&self.bar.forward(bar_rad), near_rad).map_err(|_| Obstacle::Reach)?;
        self.robot_is_comfortable(&robot).map(|()| robot)
    }

    /// The robot's joints at a pose of its end. If several solutions exist, the one nearest to `near_rad` is returned. If
    /// the arm has more axes than a pose needs, the solution nearest to the middle of its limits is returned instead.
    ///
    /// # Errors
    /// Errors of the inverse kinematics.
    pub fn inverse(&self, target: &Pose, near_rad: &[f64]) -> Result<Joints, InverseError> {
        robot_inverse_centred(self.robot, target, near_rad, &self.limits)
    }

    /// Checks the robot's joint limits, the distance from singular postures, and collisions.
    ///
    /// # Errors
    /// The constraint that is violated first, in the order of the checks.
    pub fn robot_is_comfortable(&self, robot_rad: &Joints) -> Result<(), Obstacle> {
        if !robot_rad.iter().zip(&self.limits_with_margin).all(|(q, [low, high])| (*low..=*high).contains(q))
        {
            return Err(Obstacle::JointLimit);
        }
        if !self.design.wrist_is_bent(robot_rad) {
            return Err(Obstacle::Wrist);
        }
        if self.dexterity(robot_rad) < self.design.dexterity_min {
            return Err(Obstacle::RobotSingularity);
        }
        match &self.bodies {
            Some(bodies) if bodies.clearance_m(self.robot, self.bar, robot_rad) < bodies.clearance_m_min => {
                Err(Obstacle::Collision)
            }
            _ => Ok(()),
        }
    }

    /// Configuration of wrist, elbow and shoulder of an arm with six axes, as three signs: the sign of joint 5, the side of
    /// the upper arm on which the wrist is, and the sign of the Jacobian's determinant. The determinant changes its sign
    /// when one of the three configurations changes. On a path that avoids singular postures, all three signs stay the same.
    /// For arms with another number of axes, the result is always the same.
    pub(super) fn bent(&self, robot_rad: &[f64]) -> [bool; 3] {
        let &[_, _, _, _, wrist, _] = robot_rad else { return [true; 3] };
        let mut trace = Trace::default();
        self.tracer.trace(robot_rad, &mut trace);
        let columns: Vec<Vector6<f64>> = trace.joint_twists().map(|twist| twist.column()).collect();
        let jacobian = Matrix6::from_columns(&columns);
        let axes: Vec<(Vector3<f64>, Vector3<f64>)> = trace.joint_axes().collect();
        // For each axis, a point on the axis and its direction.
        let [(shoulder_m, shoulder_axis), (elbow_m, _), (wrist_m, _)] = [axes[1], axes[2], axes[4]];
        let side = shoulder_axis.dot(&(elbow_m - shoulder_m).cross(&(wrist_m - elbow_m)));
        [wrist.sin() > 0.0, side > 0.0, jacobian.determinant() > 0.0]
    }

    /// Smallest singular value of the robot's Jacobian, with positions in metres and rotations in radians.
    pub fn dexterity(&self, robot_rad: &[f64]) -> f64 {
        let mut trace = Trace::default();
        self.tracer.trace(robot_rad, &mut trace);
        let columns = trace.joint_twists().map(|twist| twist.column());
        // The singular values of J are the square roots of the eigenvalues of J J^T.
        let squares: Matrix6<f64> = columns.map(|column| column * column.transpose()).sum();
        squares.symmetric_eigenvalues().min().max(0.0).sqrt()
    }

    /// The robot's joints along a path from `from_s` to `until_s`, at equal time steps of at most [`LOOK_S`]. The first
    /// joints are the solution nearest to `near_rad`. Checks all constraints, including speed and acceleration.
    ///
    /// # Errors
    /// The constraint that is violated first.
    pub fn follow(
        &self,
        path: &Path,
        from_s: f64,
        until_s: f64,
        near_rad: &[f64],
    ) -> Result<Vec<Joints>, Obstacle> {
        let steps = ((until_s - from_s) / LOOK_S).ceil().max(1.0);
        let step_s = (until_s - from_s) / steps;
        let mut robot = vec![self.robot_at(&path.at(from_s), near_rad)?];
        for step in 1..=steps as usize {
            let before = robot[step - 1];
            let now = self.robot_at(&path.at(from_s + step_s * step as f64), &before)?;
            let moved = now.iter().zip(before.iter()).map(|(now, before)| (now - before).abs());
            if moved.zip(self.design.speeds_max(self.robot)).any(|(moved, speed)| moved > speed * step_s) {
                return Err(Obstacle::Speed);
            }
            if let Some(earlier) = step.checked_sub(2).and_then(|index| robot.get(index)) {
                let second_differences = (0..now.len()).map(|i| now[i] - 2.0 * before[i] + earlier[i]);
                if largest_size(second_differences) > self.acceleration_rad_s2 * step_s * step_s {
                    return Err(Obstacle::Acceleration);
                }
            }
            robot.push(now);
        }
        Ok(robot)
    }
}
