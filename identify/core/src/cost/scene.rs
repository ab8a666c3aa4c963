//! One sample with all quantities that residuals need.

use nalgebra::Vector3;

use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter, ROD_LINK, Trace, Tracer, Turn, Twist};
use crate::model::{Axis, Geometry, MovingJoints, Observation, ParameterId};

/// Effect of a parameter on the ends of the chains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Movement {
    /// Moves the robot's end by this twist.
    Robot(Twist),
    /// Moves the bar's end by this twist, as given by the bar's joints and links.
    Bar(Twist),
    /// Moves neither end; the parameter may occur in the residual itself.
    None,
}

/// Both chains at one sample.
#[derive(Debug)]
pub struct Scene<'a> {
    /// Parameter values of the solve.
    pub geometry: &'a Geometry,
    /// Index of the sample, from 0.
    pub sample: usize,
    /// Measurement of the bar or wire at this sample.
    pub observation: &'a Observation,
    /// Sines and cosines of the bar's readings.
    pub readings: &'a [Turn; BAR_JOINTS],
    /// Bar joints corrected for encoder harmonics and counter origin \[rad\]; offsets (`btheta`) not yet added.
    pub bar_rad: [f64; BAR_JOINTS],
    /// The bar on its base, its rod elongated by force and direction, and its tracer for forward passes.
    pub bar_chain: (&'a Chain, &'a Tracer),
    /// Joint states of the robot.
    pub joints: &'a MovingJoints,
    /// Trace of the robot at its corrected joints.
    pub robot: &'a Trace,
    /// Trace of the bar at its encoder angles; meaningless for a cost without encoders.
    pub bar: &'a Trace,
    /// Twist of the robot's end by its motion, per second of the robot's clock.
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
            ParameterId::EncoderWave { joint, order, phase } => {
                match (self.bar.twist(joint, LinkParameter::Theta), self.readings.get(joint)) {
                    (Some(twist), Some(&reading)) => Movement::Bar(twist.scaled(-phase.wave(order, reading))),
                    _ => Movement::None,
                }
            }
            ParameterId::EncoderOffset { origin, joint } => {
                let twist = self.bar.twist(joint, LinkParameter::Theta);
                twist.filter(|_| origin == self.observation.origin).map_or(Movement::None, Movement::Bar)
            }
            ParameterId::ClockShift => Movement::Robot(self.robot_rate),
            ParameterId::ClockSkew => {
                let t_s = self.observation.t_s;
                Movement::Robot(self.robot_rate.scaled(t_s))
            }
            // Parameters of other instruments.
            _ => Movement::None,
        }
    }

    /// Twist of the bar's end per unit rate of a parameter of its links or base, with the joints as in `bar`.
    #[inline(always)]
    pub fn bar_twist(&self, bar: &Trace, id: ParameterId) -> Option<Twist> {
        match id {
            ParameterId::Bar { link, parameter } => bar.twist(link, parameter),
            ParameterId::Base { axis } => Some(Twist::translation(unit(axis))),
            ParameterId::BaseRotation { axis } => Some(self.base_rotation(axis, bar.position_m())),
            ParameterId::BarCompliance | ParameterId::BarPlay | ParameterId::BarWave { .. } => {
                bar.twist(ROD_LINK, LinkParameter::D).map(|twist| twist.scaled(self.elongation(id)))
            }
            _ => None,
        }
    }

    /// Elongation of the bar per unit of a parameter: rod length, force response, or bearing waves.
    #[inline]
    pub fn elongation(&self, id: ParameterId) -> f64 {
        match id {
            ParameterId::BarCompliance => self.observation.force.along_n,
            ParameterId::BarPlay => self.observation.force.side,
            ParameterId::BarWave { joint, order, phase } => {
                self.readings.get(joint).map_or(0.0, |reading| phase.wave(order, *reading))
            }
            id => f64::from(u8::from(id == ParameterId::ROD)),
        }
    }

    /// Length of the bar under this sample's force and in its direction \[m\].
    #[inline]
    pub fn rod_m(&self) -> f64 {
        self.bar_chain.0.links.get(ROD_LINK).map_or(0.0, |rod| rod.d_m)
    }

    /// `T(o) Rx(rx) Ry(ry)`: the first rotation carries the axis of the second.
    fn base_rotation(&self, axis: Axis, end_m: Vector3<f64>) -> Twist {
        let axis = match axis {
            Axis::X => Vector3::x(),
            Axis::Y => self.base_y,
            Axis::Z => Vector3::zeros(),
        };
        Twist::rotation(axis, self.geometry.base.origin_m, end_m)
    }
}

/// Unit vector along a coordinate axis.
pub(super) fn unit(axis: Axis) -> Vector3<f64> {
    Vector3::ith(axis.index(), 1.0)
}

/// Whether a cost with these encoders can depend on the parameter. Harmonics and offsets of an encoder, and waves over its
/// reading, need that encoder; all other parameters return true.
pub(super) fn encoders_suffice(id: ParameterId, encoders: &[usize]) -> bool {
    match id {
        ParameterId::EncoderWave { joint, .. }
        | ParameterId::EncoderOffset { joint, .. }
        | ParameterId::BarWave { joint, .. } => encoders.contains(&joint),
        _ => true,
    }
}

/// A cost function: a residual vector per sample and its derivatives by the parameters.
pub trait Residual: Sync {
    /// Intermediate results of a sample, computed once for its residual and all derivatives.
    type Local;
    /// Name in reports and on the command line.
    const NAME: &'static str;
    /// Number of residual entries per sample.
    const ROWS: usize;
    /// Joints (from 0) whose encoders are required.
    const ENCODERS: &'static [usize];
    /// Whether a measured length is required.
    const NEEDS_LENGTH: bool = false;

    /// Whether the parameter changes the residual; parameters that do not need not be free.
    fn depends_on(id: ParameterId) -> bool;

    /// Whether named selections free the parameter with this cost: the residual depends on it and separates it from the others.
    fn identifies(id: ParameterId) -> bool {
        Self::depends_on(id)
    }

    /// Computes the intermediate results of a sample; `None` if the residual has no value there.
    fn local(&self, scene: &Scene<'_>) -> Option<Self::Local>;

    /// Writes the residual, `ROWS` entries.
    fn residual(&self, scene: &Scene<'_>, local: &Self::Local, out: &mut [f64]);

    /// Writes the derivative by one parameter, `ROWS` entries that are zero on entry.
    fn derivative(&self, scene: &Scene<'_>, local: &Self::Local, id: ParameterId, out: &mut [f64]);
}

impl<R: Residual> Residual for &R {
    type Local = R::Local;

    const NAME: &'static str = R::NAME;
    const ROWS: usize = R::ROWS;
    const ENCODERS: &'static [usize] = R::ENCODERS;
    const NEEDS_LENGTH: bool = R::NEEDS_LENGTH;

    fn depends_on(id: ParameterId) -> bool {
        R::depends_on(id)
    }

    fn identifies(id: ParameterId) -> bool {
        R::identifies(id)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<R::Local> {
        R::local(self, scene)
    }

    #[inline]
    fn residual(&self, scene: &Scene<'_>, local: &R::Local, out: &mut [f64]) {
        R::residual(self, scene, local, out);
    }

    #[inline]
    fn derivative(&self, scene: &Scene<'_>, local: &R::Local, id: ParameterId, out: &mut [f64]) {
        R::derivative(self, scene, local, id, out);
    }
}

/// Index (from 0) of the joint whose axis is the rod. Without its encoder only the rotation about the rod is unknown.
pub(crate) const TORSION: usize = ROD_LINK;
/// Bar encoders without that of [`TORSION`].
pub(super) const ALL_BUT_TORSION: &[usize] = &[0, 1, 3, 4];

/// Indices of all five bar encoders.
pub(super) const ALL_ENCODERS: &[usize] = &{
    let mut all = [0; BAR_JOINTS];
    let mut i = 0;
    while i < BAR_JOINTS {
        all[i] = i;
        i += 1;
    }
    all
};
