//! A [`Scene`] contains both chains at one sample. From the scene, every cost computes the twist of each chain's end per
//! unit rate of a parameter. [`super::LoopProblem`] creates the scene from the parameter values, the observation, and the
//! robot's motion at the time of the observation.

use nalgebra::Vector3;

use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter, ROD_LINK, Trace, Tracer, Turn, Twist};
use crate::model::{Axis, Geometry, MovingJoints, Observation, ParameterId};

/// Effect of a parameter on the ends of the chains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Movement {
    /// Moves the robot's end by this twist.
    Robot(Twist),
    /// Moves the bar's end by this twist. The bar's end is computed from the bar's joints and links.
    Bar(Twist),
    /// Moves neither end. The parameter may nevertheless change the residual; parameters of other instruments do.
    None,
}

/// Both chains at one sample.
#[derive(Debug)]
pub struct Scene<'a> {
    /// Parameter values of the solve.
    pub geometry: &'a Geometry,
    /// Index of the sample, from 0.
    pub sample: usize,
    /// Measurement of the bar at this sample. For other instruments only its time is valid.
    pub observation: &'a Observation,
    /// Sines and cosines of the bar's readings.
    pub readings: &'a [Turn; BAR_JOINTS],
    /// Bar joints, corrected for encoder harmonics and for the offset of the counter origin \[rad\]. The joint offsets
    /// `btheta` are not added.
    pub bar_rad: [f64; BAR_JOINTS],
    /// Chain of the bar on its base. The length of its rod includes the elongation by force and direction of this sample.
    pub bar_chain: &'a Chain,
    /// Computes the bar's chain at other joint angles, such as those that the robot's pose implies.
    pub bar_tracer: &'a Tracer,
    /// Joint states of the robot.
    pub joints: &'a MovingJoints,
    /// Trace of the robot's chain at its corrected joints.
    pub robot: &'a Trace,
    /// Trace of the bar's chain at its encoder angles. Meaningless for a cost without encoders.
    pub bar: &'a Trace,
    /// Twist of the robot's end due to the robot's motion, per second of the robot's clock.
    pub robot_rate: Twist,
    /// Axis of the base's second rotation, in the root frame.
    pub(super) base_y: Vector3<f64>,
}

impl Scene<'_> {
    /// Twist of the robot's end or the bar's end per unit rate of a parameter.
    #[inline(always)]
    pub fn movement(&self, id: ParameterId) -> Movement {
        match id {
            ParameterId::Robot { .. } | ParameterId::Joint { .. } | ParameterId::JointWave { .. } => {
                self.geometry.end_twist(self.joints, self.robot, id).map_or(Movement::None, Movement::Robot)
            }
            ParameterId::Bar { .. }
            | ParameterId::Base { .. }
            | ParameterId::BaseRotation { .. }
            | ParameterId::BarCompliance
            | ParameterId::BarPlay
            | ParameterId::BarWave { .. } => {
                self.bar_twist(self.bar, id).map_or(Movement::None, Movement::Bar)
            }
            // Encoder harmonics are subtracted from the reading.
            ParameterId::EncoderWave { joint, order, phase } => {
                match (self.bar.twist(joint, LinkParameter::Theta), self.readings.get(joint)) {
                    (Some(twist), Some(&reading)) => Movement::Bar(twist.scaled(-phase.wave(order, reading))),
                    _ => Movement::None,
                }
            }
            // The offset applies only to samples with this counter origin.
            ParameterId::EncoderOffset { origin, joint } => {
                let twist = self.bar.twist(joint, LinkParameter::Theta);
                twist.filter(|_| origin == self.observation.origin).map_or(Movement::None, Movement::Bar)
            }
            // Robot time is `t + shift + skew t`.
            ParameterId::ClockShift => Movement::Robot(self.robot_rate),
            ParameterId::ClockSkew => Movement::Robot(self.robot_rate.scaled(self.observation.t_s)),
            // Parameters of other instruments.
            _ => Movement::None,
        }
    }

    /// Twist of the bar's end per unit rate of a parameter of its links or base, for the joint angles of the trace `bar`.
    #[inline(always)]
    pub fn bar_twist(&self, bar: &Trace, id: ParameterId) -> Option<Twist> {
        match id {
            ParameterId::Bar { link, parameter } => bar.twist(link, parameter),
            ParameterId::Base { axis } => Some(Twist::translation(axis.unit())),
            ParameterId::BaseRotation { axis } => Some(self.base_rotation(axis, bar.position_m())),
            ParameterId::BarCompliance | ParameterId::BarPlay | ParameterId::BarWave { .. } => {
                bar.twist(ROD_LINK, LinkParameter::D).map(|twist| twist.scaled(self.elongation(id)))
            }
            _ => None,
        }
    }

    /// Derivative of the bar's length with respect to a parameter \[m per unit of the parameter\].
    #[inline]
    pub fn elongation(&self, id: ParameterId) -> f64 {
        match id {
            ParameterId::BarCompliance => self.observation.force.along_n,
            // The sign of the force, smoothed around zero: from -1 to 1.
            ParameterId::BarPlay => self.observation.force.side,
            ParameterId::BarWave { joint, order, phase } => {
                self.readings.get(joint).map_or(0.0, |reading| phase.wave(order, *reading))
            }
            ParameterId::ROD => 1.0,
            _ => 0.0,
        }
    }

    /// Length of the bar under the force of this sample and in its direction \[m\].
    #[inline]
    pub fn rod_m(&self) -> f64 {
        self.bar_chain.links.get(ROD_LINK).map_or(0.0, |rod| rod.d_m)
    }

    /// Twist of the bar's end per radian of base tilt. The base has the pose `T(origin) Rx(rx) Ry(ry)`, so `rx`
    /// rotates the axis of `ry`. The base has no parameter for the rotation about z, because the offset of encoder 1
    /// has the same effect.
    fn base_rotation(&self, axis: Axis, end_m: Vector3<f64>) -> Twist {
        let axis = match axis {
            Axis::X => Vector3::x(),
            Axis::Y => self.base_y,
            Axis::Z => Vector3::zeros(),
        };
        Twist::rotation(axis, self.geometry.base.origin_m, end_m)
    }
}
